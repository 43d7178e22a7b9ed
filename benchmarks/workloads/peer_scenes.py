"""Scenes from the tests of others, with the tolerances that they allow themselves: what physjax's figure is beside each.

Newton 1.8 (newton/tests/test_physics_verification.py, test_rigid_friction_ramp.py, examples basic_dzhanibekov and
newton_cradle, tests/kamino), the slop of Box2D and Box3D (5 mm, within which bodies may overlap), and AVBD's heavy rope, whose
authors state no number. The scenes are rebuilt from their dimensions, in float32, with steps no shorter than theirs.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import measures
import numpy as np
from harness import print_progress
from measures import Peer

from physjax import Scene, contacts, energy, forces, inertia, methods, rigid, simulate
from physjax.scenes import SCENES
from physjax.stepping.reference import cast_floats

OURS = "physjax"
PHYSJAX = Peer("physjax", OURS, "", lambda size: None)
F, G, SLOP = np.float32, 9.81, 5e-3
FRAME, STOPPING_SPEED = 1 / 60, 2.0


def measure_free_boxes() -> list[tuple]:
    """Newton: four free cubes of 1 m, a second in steps of 1 ms."""
    cube = inertia.box(1000.0, (1.0, 1.0, 1.0))
    place = np.array([(0, 0, 0), (100, 0, 0), (0, 100, 0), (0, 0, 100)], F)
    velocity = np.array([(1, 0, 0), (0, -1, 0), (0, 0, 1.5), (-0.5, 0.5, -0.5)], F)
    spin = np.array([(0, 0, 0.5), (0.3, 0, 0), (0, -0.2, 0), (0, 0, -0.3)], F)
    scene = Scene(rigid.bodies(cube, place, velocity=velocity, angular_velocity=spin), cube)
    last = simulate(scene, methods.verlet, dt=1e-3, steps=1000, save_every=1000).final_scene.state
    p, angular = ([np.asarray(sum_momenta(s)[i], float) for s in (scene.state, last)] for i in range(2))
    drift = lambda pair: np.linalg.norm(pair[1] - pair[0]) / np.linalg.norm(pair[0])  # noqa: E731
    source = "Newton test_momentum_conservation"
    return [
        ("linear momentum, relative", drift(p), 5e-4, source),
        ("angular momentum, relative", drift(angular), 5e-4, source),
    ]


def sum_momenta(state: Any) -> tuple[np.ndarray, np.ndarray]:
    """Total momentum and angular momentum about the origin."""
    x, p, spin = (np.asarray(a, float) for a in (state.position, state.momentum, state.angular_momentum))
    return p.sum(0), (np.cross(x, p) + spin).sum(0)


def measure_precession() -> list[tuple]:
    """Newton: an asymmetric body without torque, twenty steps of 10 ms."""
    body = inertia.of_tensor(1.0, np.diag([0.2, 0.5, 0.4]))
    scene = Scene(
        rigid.bodies(body, np.zeros(3, F), angular_velocity=np.array([0.7, -0.5, 0.9], F), frame="body"), body
    )
    last = simulate(scene, methods.rk4, dt=1e-2, steps=20, save_every=20).final_scene.state
    before, after = (np.asarray(s.angular_momentum, float) for s in (scene.state, last))
    error = np.linalg.norm(after - before) / np.linalg.norm(before)
    return [("angular momentum, relative", error, 5e-3, "Newton test_torque_free_precession")]


def measure_dzhanibekov() -> list[tuple]:
    """Newton: a T of two cylinders spun about its middle axis, 240 steps a second for five seconds."""
    bar, stem = 2 * math.pi * 0.2**2 * 100, 2 * math.pi * 0.1**2 * 0.5 * 50
    parts = (
        (inertia.cylinder(bar, 0.2, 2.0, axis=0), (0, 0, 0)),
        (inertia.cylinder(stem, 0.1, 1.0, axis=1), (0, -0.7, 0)),
    )
    body = inertia.composite(parts).inertia
    spin = np.array([0.0, 20.0, 0.0], F) + F(1e-3)  # float32 rounding starts the flip there; a thousandth here
    scene = Scene(rigid.bodies(body, np.zeros(3, F), angular_velocity=spin), body)
    run = simulate(scene, methods.rk4, dt=FRAME / 4, steps=1200, save_every=4)
    total = [float(energy.kinetic(scene, 0.0, jnp_state(run, i))) for i in (0, -1)]
    up = [measure_tilt(jnp_state(run, i)) for i in range(0, len(run), 3)]
    source = "Newton example_basic_dzhanibekov"
    return [
        ("rotational energy, relative", abs(total[1] / total[0] - 1), 0.01, source),
        ("drift of the centre [m]", float(np.abs(run.position[-1]).max()), 1e-3, source),
        ("cosine of the stem's largest turn (a flip is < 0)", min(up), 0.0, source),
    ]


def jnp_state(run: Any, frame: int) -> Any:
    """The state at a frame."""
    return type(run.state)(*(leaf[frame] for leaf in run.state))


def measure_tilt(state: Any) -> float:
    """How far the y axis of a body still points up."""
    a, b, c, d = np.asarray(state.orientation, float)
    return float(a * a - b * b + c * c - d * d)


def build_slider(friction: float, angle: float, size: tuple, gap: float = 0.0, substeps: int = 30) -> Scene:
    """A box on ground that is tilted by turning gravity [rad]."""
    rough, crate = contacts.Coulomb(friction, friction), inertia.planar_plate(1.0, size)
    floor = contacts.Plane((0, 0), (0, 1), restitution=0.0, coulomb=rough)
    solids = rigid.Solids(rigid.PlanarShape.box(size), (floor,), coulomb=rough, substeps=substeps)
    state = rigid.planar_bodies(crate, np.array([[0.0, size[1] / 2 + gap]], F))
    along = forces.Constant((G * math.sin(angle), 0.0))
    return Scene(state, crate, (forces.Gravity(G * math.cos(angle)), along), contacts=(solids,))


def measure_friction_grid() -> list[tuple]:
    """Newton: boxes on ramps, five frictions by five angles: those below the angle of friction stay, the others slide."""
    stays, slides = [], []
    for friction in (0.1, 0.3, 0.5, 0.7, 1.0):
        for degrees in (3.0, 10.0, 20.0, 30.0, 40.0):
            scene = build_slider(friction, math.radians(degrees), (0.4, 0.1), gap=1e-3)
            settled = simulate(scene, methods.verlet, dt=FRAME, steps=30, save_every=30).final_scene
            run = simulate(settled, methods.verlet, dt=FRAME, steps=15, save_every=15)
            moved = float(np.linalg.norm(run.position[-1, 0] - run.position[0, 0]))
            beyond = degrees - math.degrees(math.atan(friction))
            if abs(beyond) > 2.0:
                (slides if beyond > 0 else stays).append(moved)
    source = "Newton test_friction_ramp"
    return [
        ("a box that must stay moves by at most [m]", max(stays), 0.02, source),
        ("a box that must slide moves by at least [m]", min(slides), 0.02, source),
    ]


def measure_stopping() -> list[tuple]:
    """Newton: boxes at 2 m/s stop after v²/2μg, 30 sub-steps of a frame."""
    errors = []
    for friction in (0.2, 0.4, 0.7):
        settled = simulate(build_slider(friction, 0.0, (0.5, 0.5)), methods.verlet, dt=FRAME, steps=30).final_scene
        push = settled.state.momentum + jnp.array([STOPPING_SPEED, 0.0], F)
        moving = settled.replace(state=settled.state._replace(momentum=push))
        steps = math.ceil(1.5 * STOPPING_SPEED / (0.2 * G) / FRAME)
        run = simulate(moving, methods.verlet, dt=FRAME, steps=steps, save_every=steps)
        expected = STOPPING_SPEED**2 / (2 * friction * G)
        errors.append(abs(float(run.position[-1, 0, 0] - run.position[0, 0, 0]) - expected) / expected)
    return [("stopping distance, relative", max(errors), 0.01, "Newton test_friction_stopping_distance")]


def measure_five_boxes() -> list[tuple]:
    """Newton (Kamino): a stack of five boxes of 0.2 m in space; how fast the fastest is after a second of 1/60 s."""
    last = run_scene("stack_in_space", {"count": 5}, 1.0, FRAME)
    speed = float(np.abs(last.momentum).max() / 1000.0)
    return [
        (
            "fastest box after a second [m/s]; theirs is a residual of the solve",
            speed,
            7e-4,
            "Newton test_05b five_box_stack",
        )
    ]


def measure_cradle() -> list[tuple]:
    """Newton's cradle, in free space: the last ball leaves as fast as the first came."""
    problem = SCENES["cradle_in_space"]()
    last = run_scene("cradle_in_space", {}, problem.duration, FRAME / 10)
    speed = float(np.linalg.norm(last.momentum[-1]))
    return [
        (
            "speed of the last ball, relative",
            abs(speed - 1.0),
            math.nan,
            "Newton example_newton_cradle: bounded motion only",
        )
    ]


def measure_pyramids() -> list[tuple]:
    """Box2D's and Box3D's pyramids: how far a box moves in a second of 1/60 s."""
    found = []
    for name, given, source in (
        ("pyramid", {"rows": 10}, "Box2D, linear slop"),
        ("pyramid_in_space", {"rows": 4}, "Box3D, linear slop"),
    ):
        start = SCENES[name](**given).scene.state.position
        last = run_scene(name, given, 1.0, FRAME)
        found.append((f"{name}: a box moves by at most [m]", float(np.abs(last.position - start).max()), SLOP, source))
    return found


def measure_heavy_rope() -> list[tuple]:
    """AVBD: twenty links and a load of 1800 times the mass of each, a second: the longest change of a link."""
    problem = SCENES["heavy_rope"]()
    last = run_scene("heavy_rope", {}, problem.duration, FRAME / 2)
    links = np.linalg.norm(np.diff(np.asarray(last.position, float), axis=0), axis=-1)
    return [
        (
            "a link is longer or shorter by at most [m]",
            float(np.abs(links - 0.1).max()),
            math.nan,
            "AVBD sceneHeavyRope: none stated",
        )
    ]


def run_scene(name: str, given: dict, seconds: float, dt: float) -> Any:
    """The end of a scene of the gallery, in float32."""
    scene = cast_floats(SCENES[name](**given).scene, F)
    steps = round(seconds / dt)
    return simulate(scene, methods.verlet, dt=dt, steps=steps, save_every=steps).final_scene.state


SCENARIOS: tuple[Callable[[], list[tuple]], ...] = (
    measure_free_boxes,
    measure_precession,
    measure_dzhanibekov,
    measure_friction_grid,
    measure_stopping,
    measure_five_boxes,
    measure_cradle,
    measure_pyramids,
    measure_heavy_rope,
)


def measure(quick: bool, peers: bool) -> list[dict[str, Any]]:
    """A row for each quantity: physjax's figure, and what its peer allows itself (none: it states no number)."""
    rows = []
    for scenario in SCENARIOS:
        name = scenario.__name__.removeprefix("measure_")
        about = " ".join((scenario.__doc__ or "").split())
        try:
            found = scenario()
        except Exception as error:
            why = f"{type(error).__name__}: {str(error)[:200]}"
            rows.append(measures.make_row("scene", PHYSJAX, scene=name, about=about, failed=why))
            print_progress(f"  {name}: {why}")
            continue
        for quantity, value, allowed, source in found:
            stated = None if math.isnan(allowed) else allowed
            row = {"quantity": quantity, "error": float(value), "allowed": stated, "source": source}
            rows.append(measures.make_row("scene", PHYSJAX, scene=name, about=about, **row))
            print_progress(f"  {name}: {quantity}: {value:.3g}, allowed {stated}")
    return rows
