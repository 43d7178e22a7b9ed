"""Stacks of three boxes that slide on rough ground until they stop: distance v²/2μg, its gradient v/μg, planar, float32."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from harness import COLOURS, import_optional
from jax import lax
from measures import Peer, Run, Size, Workload, weigh

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

OURS, JAX, OTHER = COLOURS
DT, G, FRICTION, BOXES, SUBSTEPS = 1 / 60, 9.8, 0.2, 3, 4
SETTLING = 30
"""Steps at rest before the push, as in Newton's test of stopping distances."""
F = np.float32


def start(size: Size) -> np.ndarray:
    """Speeds of whole stacks, one a world [m/s]."""
    return np.random.default_rng(6).uniform(1.0, 2.0, size.lanes).astype(F)


def follow_truth(size: Size, speed: np.ndarray) -> np.ndarray:
    """Coulomb's friction in closed form: a stack that does not tip stops as one, and its boxes stay at their heights."""
    t = np.minimum(size.steps * DT, speed / (FRICTION * G))
    x = speed * t - FRICTION * G * t * t / 2
    heights = np.broadcast_to(np.arange(BOXES) + 0.5, (size.lanes, BOXES))
    return np.stack([np.broadcast_to(x[:, None], heights.shape), heights], axis=-1)


def with_physjax(size: Size) -> Run:
    """rigid.Solids with neighbours as pairs, four sub-steps."""
    rough, crate = contacts.Coulomb(FRICTION, FRICTION), inertia.planar_plate(1.0, (1.0, 1.0))
    floor = contacts.Plane((0, 0), (0, 1), restitution=0.0, coulomb=rough)
    pairs = [(i, i + 1) for i in range(BOXES - 1)]
    solids = rigid.Solids(rigid.PlanarShape.box((1, 1)), (floor,), coulomb=rough, pairs=pairs, substeps=SUBSTEPS)
    heights = jnp.broadcast_to(jnp.arange(BOXES, dtype=F) + F(0.5), (size.lanes, BOXES))
    place = jnp.stack([jnp.zeros_like(heights), heights], axis=-1)

    stacked = Scene(rigid.planar_bodies(crate, place), crate, (forces.Gravity(G),), contacts=(solids,))
    settled = simulate(stacked, methods.verlet, dt=DT, steps=SETTLING, save_every=SETTLING).final_scene

    def push(speed):
        along = jnp.broadcast_to(speed[:, None], heights.shape)
        momentum = settled.state.momentum + jnp.stack([along, 0 * along], axis=-1)  # each has 1 kg
        return settled.replace(state=settled.state._replace(momentum=momentum))

    speed = jnp.asarray(start(size))
    scene = push(speed)

    def run(scene):
        last = simulate(scene, methods.verlet, dt=DT, steps=size.steps, save_every=size.steps)
        return last.final_scene.state.position

    loss = lambda speed: weigh(run(push(speed)))  # noqa: E731
    return Run(partial(run, scene), partial(jax.jit(jax.grad(loss)), speed))


def with_mjx(size: Size) -> Run:
    """Boxes on slides and a hinge, which keep them in the plane; pyramidal cones, Newton, sub-steps."""
    mujoco, mjx = import_optional("mujoco"), import_optional("mujoco.mjx", "mujoco-mjx")
    bodies = "".join(
        f'<body pos="0 0 {i + 0.5}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
        f'<joint type="hinge" axis="0 1 0"/><geom type="box" size=".5 .5 .5" mass="1" friction="{FRICTION} 0 0"/></body>'
        for i in range(BOXES)
    )
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{DT / SUBSTEPS}" gravity="0 0 -{G}" iterations="4" ls_iterations="8"/><worldbody>'
            f'<geom type="plane" size="50 50 1" friction="{FRICTION} 0 0"/>{bodies}</worldbody></mujoco>'
        )
    )
    data, heights = mjx.make_data(model), jnp.arange(BOXES, dtype=F) + F(0.5)

    def solve(speed):
        def advance(d, steps):
            return lax.scan(lambda d, _: (mjx.step(model, d), None), d, None, length=steps * SUBSTEPS)[0]

        settled = advance(data, SETTLING)
        pushed = settled.replace(qvel=settled.qvel + jnp.tile(jnp.array([1.0, 0.0, 0.0], F), BOXES) * speed)
        q = advance(pushed, size.steps).qpos.reshape(BOXES, 3)
        return jnp.stack([q[:, 0], heights + q[:, 1]], axis=-1)

    many, speed = jax.vmap(solve), jnp.asarray(start(size))
    return Run(partial(jax.jit(many), speed), partial(jax.jit(jax.grad(lambda s: weigh(many(s)))), speed))


def with_pymunk(size: Size) -> Run:
    """Chipmunk in C, a space a world in a Python loop."""
    pymunk = import_optional("pymunk")

    def build():
        space = pymunk.Space()
        space.gravity = 0, -G
        ground = pymunk.Segment(space.static_body, (-100, -1), (100, -1), 1)
        boxes = []
        for i in range(BOXES):
            box = pymunk.Body(1, pymunk.moment_for_box(1, (1, 1)))
            box.position = 0, i + 0.5
            shape = pymunk.Poly.create_box(box, (1, 1))
            # a contact has the product of both
            shape.friction = ground.friction = FRICTION**0.5
            space.add(box, shape)
            boxes.append(box)
        space.add(ground)
        return space, boxes

    def run():
        ends = []
        for speed in start(size):
            space, boxes = build()
            for s in range((SETTLING + size.steps) * SUBSTEPS):
                if s == SETTLING * SUBSTEPS:
                    for box in boxes:
                        box.velocity = box.velocity.x + float(speed), box.velocity.y
                space.step(DT / SUBSTEPS)
            ends.append([tuple(box.position) for box in boxes])
        return np.array(ends)

    return Run(run)


def with_box2d(size: Size) -> Run:
    """Box2D 2.4 in C++, a world in a Python loop."""
    box2d = import_optional("Box2D", "box2d")

    def run():
        ends = []
        for speed in start(size):
            world = box2d.b2World(gravity=(0, -G), doSleep=False)
            world.CreateStaticBody(position=(0, -1), fixtures=_fixture(box2d, (100, 1)))
            boxes = [
                world.CreateDynamicBody(position=(0, i + 0.5), fixtures=_fixture(box2d, (0.5, 0.5)))
                for i in range(BOXES)
            ]
            for s in range((SETTLING + size.steps) * SUBSTEPS):
                if s == SETTLING * SUBSTEPS:
                    for box in boxes:
                        box.linearVelocity += (float(speed), 0)
                world.Step(DT / SUBSTEPS, 8, 3)
            ends.append([tuple(box.position) for box in boxes])
        return np.array(ends)

    return Run(run)


def _fixture(box2d, half: tuple):
    return box2d.b2FixtureDef(shape=box2d.b2PolygonShape(box=half), density=1.0, friction=FRICTION, restitution=0.0)


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "rigid.Solids, four sub-steps; jax.grad of simulate", with_physjax)
    yield Peer(
        "MJX",
        JAX,
        "boxes on slides and hinges, Newton with 4 iterations, four sub-steps",
        with_mjx,
        64 * 90,
        "boxes on boxes take minutes to compile",
    )
    yield Peer("pymunk", OTHER, "Chipmunk in C, a space a world, four sub-steps", with_pymunk, 1024 * 90)
    yield Peer("Box2D", OTHER, "Box2D 2.4 in C++, a world each, four sub-steps", with_box2d, 1024 * 90)


WORK = Workload(
    name="slide",
    about="Stacks of three boxes of 1 m that slide on ground with friction 0.2 until they stop, planar, float32, steps of "
    "1/60 s in four sub-steps; gradient by the speed of each stack.",
    exact="v²/2μg in closed form",
    unit="m",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(16, 90),
    horizons=(30, 90),
    costs=(Size(256, 90), Size(1024, 90)),
)
