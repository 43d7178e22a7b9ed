"""Free tumbling boxes next to MuJoCo's MJX, which is JAX as well: the same boxes, steps and precision, in one process.

    python benchmarks/rigid.py [--quick] [--out DIR]

4096 boxes of 1 kg with sides of 0.5 to 2 m fly and tumble under gravity, float32, steps of 2 ms, by semi-implicit Euler
and by RK4, on one core if the process may use one (taskset -c 0). MJX (pip install mujoco-mjx) has a free joint and a
box each, contacts and constraints disabled; its Euler is semi-implicit, like ours. Before anything is timed, both must
have moved the same boxes to the same place and orientation. A scene here pays only for what it uses; MJX's step
does all that a tree of joints may need (kinematics, mass matrix, its factorisation) for every body.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, Missing, print_progress

from physjax import RigidBodies, Scene, forces, inertia, methods, rigid, simulate

OURS, OTHER, _ = harness.COLOURS
DT = 0.002
LAWS = {"semi-implicit Euler": (methods.semi_implicit_euler, "Euler"), "RK4": (methods.rk4, "RK4")}
TIMES_FASTER, COMPILE_SECONDS = 50.0, 2.0
ALLOWED_DIFFERENCE = {"semi-implicit Euler": 2e-3, "RK4": 2e-5}
"""How far the two may be from each other after the run [m and 1]: the Euler methods have errors of their own."""


class Settings(NamedTuple):
    """Sizes of the runs; MJX does its steps in fewer, since a step of it is so long."""

    lanes: int
    steps: int
    steps_of_mjx: int
    repeats: int


FULL, QUICK = Settings(4096, 1000, 25, 7), Settings(64, 50, 25, 1)


class Boxes(NamedTuple):
    """Where boxes begin: sides [m], orientation, velocity [m/s], angular velocity in the box's frame [rad/s]."""

    sides: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    @classmethod
    def sample(cls, lanes: int) -> "Boxes":
        rng = np.random.default_rng(0)
        q = rng.normal(size=(lanes, 4))
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
        numbers = (rng.uniform(0.5, 2.0, (lanes, 3)), q, rng.normal(size=(lanes, 3)), 3 * rng.normal(size=(lanes, 3)))
        return cls(*(a.astype(np.float32) for a in numbers))


def build_scene(boxes: Boxes) -> Scene:
    """The boxes, as a scene of ours; MuJoCo's z is up."""
    body = inertia.box(1.0, boxes.sides)
    zeros = np.zeros_like(boxes.velocity)
    state = rigid.bodies(body, zeros, boxes.orientation, boxes.velocity, boxes.spin, frame="body")
    return Scene(state, body, (forces.Gravity(9.8, up=2),))


def run_physjax(scene: Scene, method: Callable, steps: int) -> RigidBodies:
    """The boxes after `steps` steps."""
    return simulate(scene, method, dt=DT, steps=steps, save_every=steps).final_scene.state


def build_mjx_run(boxes: Boxes, integrator: str, steps: int) -> Callable:
    """A function that takes `steps` steps of the boxes in MJX and returns positions and orientations."""
    mujoco, mjx = harness.import_optional("mujoco"), harness.import_optional("mujoco.mjx", "mujoco-mjx")
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{DT}" integrator="{integrator}" gravity="0 0 -9.8">'
        '<flag contact="disable" constraint="disable"/></option><worldbody><body><freejoint/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom type="box" size=".5 .5 .5"/></body></worldbody></mujoco>'
    )
    model = mjx.put_model(model)
    start = mjx.make_data(model)
    moments = np.asarray(inertia.box(1.0, boxes.sides).principal)

    def one(moments, orientation, velocity, spin):
        body = model.replace(body_inertia=model.body_inertia.at[1].set(moments))
        data = start.replace(
            qpos=start.qpos.at[:3].set(0).at[3:7].set(orientation), qvel=jnp.concatenate([velocity, spin])
        )
        return jax.lax.scan(lambda data, _: (mjx.step(body, data), None), data, None, length=steps)[0].qpos

    run = jax.jit(jax.vmap(one))
    return partial(run, *map(jnp.asarray, (moments, boxes.orientation, boxes.velocity, boxes.spin)))


def check_agreement(scene: Scene, method: Callable, law: str, qpos: jax.Array, steps: int) -> float:
    """The largest difference between ours and MJX's boxes after its steps; SystemExit if it is more than it may be."""
    state = run_physjax(scene, method, steps)
    apart = np.abs(np.asarray(qpos[:, :3]) - state.position).max()
    sign = np.sign(np.sum(np.asarray(qpos[:, 3:]) * state.orientation, axis=-1, keepdims=True))
    apart = max(apart, np.abs(sign * np.asarray(qpos[:, 3:]) - state.orientation).max())
    if not apart <= ALLOWED_DIFFERENCE[law]:
        raise SystemExit(f"{law}: ours and MJX's boxes are {apart:.3g} apart after {steps} steps")
    return float(apart)


def main() -> None:
    """Run both, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    boxes = Boxes.sample(size.lanes)
    scene = build_scene(boxes)
    studies, bars, panels = [], [], []
    for law, (method, integrator) in LAWS.items():
        print_progress(law)
        contenders = {"physjax": partial(run_physjax, scene, method, size.steps)}
        try:
            contenders["MJX"] = build_mjx_run(boxes, integrator, size.steps_of_mjx)
        except Missing as why:
            print_progress(f"  MJX: {why}")
        apart = []

        def same(name, found, method=method, law=law, apart=apart):
            if name == "MJX":
                apart.append(check_agreement(scene, method, law, found, size.steps_of_mjx))

        timings, failed = harness.time_side_by_side(contenders, size.repeats, check=same)
        if failed:
            raise SystemExit(f"{law}: {failed}")
        steps = {"physjax": size.steps, "MJX": size.steps_of_mjx}
        rows = [
            harness.make_row(name, OURS if name == "physjax" else OTHER, size.lanes * steps[name] / 1e6, timing)
            for name, timing in timings.items()
        ]
        studies.append({"law": law, "apart": apart, "runs": rows})
        panels.append((law, "million body-steps per second (logarithmic)", rows))
        bars.append(Bar(f"{law}: seconds to compile", timings["physjax"].compiling, "<=", COMPILE_SECONDS))
        if "MJX" in timings:
            bars.append(Bar(f"{law}: physjax / MJX", rows[0]["rate"] / rows[1]["rate"], ">=", TIMES_FASTER))

    print(harness.format_caption(about))
    for study in studies:
        harness.print_rates(
            f"{study['law']}, {size.lanes} boxes", "million body-steps a second", study["runs"], "physjax"
        )
        print(f"  boxes of the two apart by at most {study['apart']} after {size.steps_of_mjx} steps")
    harness.print_bars(bars, quick)
    record = {"benchmark": "rigid", "quick": quick, "machine": about, "settings": size._asdict(), "studies": studies}
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "rigid", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    harness.draw_bar_chart(drawn, panels, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
