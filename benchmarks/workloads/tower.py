"""Towers of ten boxes of 1 m in space, each box up to 2 % of its width off, that stand for a second, float32."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from harness import COLOURS, import_optional
from jax import lax
from measures import Peer, Run, Size, Workload

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

OURS, JAX, OTHER = COLOURS
DT, G, FRICTION, BOXES, SUBSTEPS, OFFSET = 1 / 60, 9.8, 0.5, 10, 4, 0.02
F = np.float32


def start(size: Size) -> np.ndarray:
    """How far each box of each tower is off in both directions along the ground [m]."""
    return np.random.default_rng(7).uniform(-OFFSET, OFFSET, (size.lanes, BOXES, 2)).astype(F)


def follow_truth(size: Size, offset: np.ndarray) -> np.ndarray:
    """Statics: every centre of mass is above the box below, so that all stay where they are."""
    heights = np.broadcast_to(np.arange(BOXES) + 0.5, (size.lanes, BOXES))
    return np.stack([offset[..., 0], heights, offset[..., 1]], axis=-1).astype(float)


def with_physjax(size: Size) -> Run:
    """rigid.Solids with neighbours as pairs, four sub-steps."""
    rough, crate = contacts.Coulomb(FRICTION, FRICTION), inertia.box(1.0, (1.0, 1.0, 1.0))
    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=0.0, coulomb=rough)
    pairs = [(i, i + 1) for i in range(BOXES - 1)]
    solids = rigid.Solids(rigid.Shape.box((1, 1, 1)), (floor,), coulomb=rough, pairs=pairs, substeps=SUBSTEPS)
    place = jnp.asarray(follow_truth(size, start(size)), F)
    scene = Scene(rigid.bodies(crate, place), crate, (forces.Gravity(G),), contacts=(solids,))
    return Run(lambda: simulate(scene, methods.verlet, dt=DT, steps=size.steps, save_every=size.steps).position[-1])


def with_mjx(size: Size) -> Run:
    """Free joints, pyramidal cones, Newton, sub-steps."""
    mujoco, mjx = import_optional("mujoco"), import_optional("mujoco.mjx", "mujoco-mjx")
    bodies = "".join(
        f'<body pos="0 0 {i + 0.5}"><freejoint/><geom type="box" size=".5 .5 .5" mass="1" friction="{FRICTION}"/></body>'
        for i in range(BOXES)
    )
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{DT / SUBSTEPS}" gravity="0 0 -{G}" iterations="10" ls_iterations="16"/><worldbody>'
            f'<geom type="plane" size="50 50 1" friction="{FRICTION}"/>{bodies}</worldbody></mujoco>'
        )
    )
    data = mjx.make_data(model)

    def solve(offset):
        q = data.qpos.reshape(BOXES, 7).at[:, :2].set(offset)
        begun = data.replace(qpos=q.reshape(-1))
        end = lax.scan(lambda d, _: (mjx.step(model, d), None), begun, None, length=size.steps * SUBSTEPS)[0]
        x, y, z = jnp.moveaxis(end.qpos.reshape(BOXES, 7)[:, :3], -1, 0)
        return jnp.stack([x, z, y], axis=-1)

    return Run(partial(jax.jit(jax.vmap(solve)), jnp.asarray(start(size))))


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "rigid.Solids, four sub-steps", with_physjax)
    yield Peer(
        "MJX",
        JAX,
        "free joints, Newton with 10 iterations, four sub-steps",
        with_mjx,
        64 * 60,
        "boxes on boxes take minutes to compile",
    )


WORK = Workload(
    name="tower",
    about="Towers of ten boxes of 1 m in space, each up to 2 % of its width off, that stand for a second, float32, steps of "
    "1/60 s in four sub-steps.",
    exact="statics: all stay where they are",
    unit="m",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(16, 60),
    horizons=(30, 60),
    costs=(Size(16, 60), Size(1024, 60)),
)
