"""Compile time follows the size of a program: it is counted for typical scenes, and must not grow unnoticed.

Programs are lowered and not compiled. The counts they are held to are those of `data/program_counts.json`, which
`python -m benchmarks counts --update` writes anew, on purpose; without `--update` it shows what has changed.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import COUNTED, count_operations, count_program

from physjax import Particles, Scene, contacts, forces, inertia, methods, ode_scene, rigid, simulate
from physjax.scenes import SCENES

GROWTH = 1.1
"""By how much a program may grow before its counts are written anew, on purpose."""
COUNTS = Path(__file__).parent / "data" / "program_counts.json"
FLIGHT = (forces.Gravity(), forces.QuadraticDrag(0.01, 0.5))


def balls_among(*surfaces, lanes=64):
    """Balls in space, above and between surfaces."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.9, 0.9, (lanes, 3)) + np.array([0.0, 1.0, 0.0])
    return Scene(Particles(jnp.asarray(position), jnp.asarray(rng.normal(size=(lanes, 3)))), 1.0, FLIGHT, surfaces)


def around(count):
    """Planes around the origin."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    inward = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return [contacts.Plane(tuple(-3 * normal), tuple(normal), restitution=0.8) for normal in inward]


def among_spheres():
    """Five planes and three spheres."""
    centers = ((0.0, -1.0, 0.0), (0.0, -1.5, 1.0), (1.0, -1.2, 0.0))
    return balls_among(*around(5), *(contacts.Sphere(center, 0.3, restitution=0.7) for center in centers))


def attracting_bodies():
    """Bodies that attract each other."""
    position, velocity = np.random.default_rng(0).normal(size=(2, 64, 3))
    return Scene(Particles(position, velocity), forces=(forces.Gravitation(G=1.0, softening=0.2),))


def stacked_boxes():
    """Three boxes on rough ground, in the plane."""
    rough, crate = contacts.Coulomb(0.2, 0.2), inertia.planar_plate(1.0, (1.0, 1.0))
    floor, box = contacts.Plane((0, 0), (0, 1), restitution=0.0, coulomb=rough), rigid.PlanarShape.box((1, 1))
    solids = rigid.Solids(box, (floor,), coulomb=rough, pairs=[(0, 1), (1, 2)], substeps=4)
    stack = rigid.planar_bodies(crate, np.array([[0.0, 0.5], [0.0, 1.5], [0.0, 2.5]]))
    return Scene(stack, crate, (forces.Gravity(),), contacts=(solids,))


def lorenz(t, y, rho):
    return jnp.stack([10.0 * (y[1] - y[0]), y[0] * (rho - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]])


BUILDERS = {
    "plane": lambda: balls_among(contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.8)),
    "room of 6": lambda: balls_among(*around(6)),
    "room of 60": lambda: balls_among(*around(60)),
    "planes and spheres": among_spheres,
    "bodies": attracting_bodies,
    "stack": stacked_boxes,
    "lorenz": lambda: ode_scene(lorenz, np.ones((64, 3)), np.linspace(0.0, 21.0, 64)),
    **{
        name: lambda name=name: SCENES[name]().scene
        for name in ("fall_with_drag", "flag", "bouncing_ball", "tumbling_box", "ragdoll", "car")
    },
}


def end(velocity, scene):
    """What eight steps of the scene are to a velocity: of rk4, of bodies that touch verlet."""
    start = scene.replace(state=scene.state._replace(**{velocity_of(scene): velocity}))
    method = methods.verlet if any(isinstance(contact, rigid.Solids) for contact in scene.contacts) else methods.rk4
    return simulate(start, method, dt=1e-3, steps=8).state


def velocity_of(scene):
    return "momentum" if "momentum" in scene.state._fields else scene.state._fields[-1]


def measure(name, differentiated):
    """The counts of the program of eight steps, or of the gradient of its end; and how often it was traced for two calls."""
    scene, traced = BUILDERS[name](), []
    velocity = getattr(scene.state, velocity_of(scene))

    def loss(velocity, scene):
        traced.append(name)
        last = end(velocity, scene)
        return jnp.sum(last.position[-1] ** 2) if differentiated else last

    run = jax.jit(jax.value_and_grad(loss) if differentiated else loss)
    lowered = run.lower(velocity, scene)
    run.lower(2.0 * velocity, scene)  # other numbers are no other program
    return count_program(lowered) | {"programs": len(traced)}


def read_counts():
    """The committed counts, by kind and name."""
    return json.loads(COUNTS.read_text())


FORWARD = tuple(BUILDERS)
GRADIENT = ("planes and spheres", "fall_with_drag", "flag", "bouncing_ball", "car")


def find_grown(found, allowed):
    """What a program has more of than it may. Versions of jax differ by a few operations; scatters and programs are exact."""
    most = {what: count if what in ("scatters", "programs") else GROWTH * count + 2 for what, count in allowed.items()}
    return {what: (found[what], allowed[what]) for what in allowed if found[what] > most[what]}


@pytest.mark.parametrize("name", FORWARD)
def test_a_program_does_not_grow(name):
    assert not find_grown(measure(name, differentiated=False), read_counts()["forward"][name])


@pytest.mark.slow
@pytest.mark.parametrize("name", GRADIENT)
def test_the_program_of_a_gradient_does_not_grow(name):
    assert not find_grown(measure(name, differentiated=True), read_counts()["gradient"][name])


def test_a_room_of_sixty_walls_costs_what_one_of_six_does():
    counts = [measure(name, differentiated=False)["operations"] for name in ("room of 60", "room of 6")]
    assert counts[0] <= 1.2 * counts[1]


@pytest.mark.parametrize(
    ("kind", "options", "most"),
    [
        (rigid.Hinges, {"limits": (-1.0, 1.0)}, 480),
        (rigid.Hinges, {}, 270),
        (rigid.Joints, {"cone": 1.0}, 195),
    ],
)
def test_the_derivative_of_joints_in_space_which_a_step_takes_many_times_is_small(kind, options, most):
    joints = kind([(0, 1)], np.zeros((1, 2, 3)), axis=(0.0, 0.0, 1.0), **options)
    bodies = rigid.bodies(inertia.box(1.0, (0.1, 0.2, 0.3)), np.zeros((2, 3)))
    reader = joints.coordinates(bodies)
    differentiate = jax.jit(lambda places: joints.differentiate(reader, *joints.find_ends(places)))
    assert count_operations(differentiate.lower(reader.read_places(bodies))) <= most


def test_what_is_counted_is_what_the_program_holds():
    def program(x):
        pair = jnp.concatenate([x, x])
        return jax.jit(jnp.sin)(pair) + jax.jit(jnp.sin)(pair).at[jnp.array([1])].set(0.0)

    lowered = jax.jit(program).lower(jnp.zeros(4))
    found = count_program(lowered)
    assert (found["concatenates"], found["scatters"]) == (1, 1)
    assert found["operations"] == count_operations(lowered) > 4
    assert found["bytes"] >= 4 * 8 * 8  # the pair, two sines, the scattered one
    assert not find_grown(found, found)
    grown = found | {"operations": 2 * found["operations"] + 2, "scatters": 2}
    assert set(find_grown(grown, found)) == {"operations", "scatters"}


def main():
    """Show every count beside the committed one, and write them all with --update."""
    jax.config.update("jax_enable_x64", True)
    committed = read_counts() if COUNTS.exists() else {}
    found = {"forward": {}, "gradient": {}}
    for kind, names in (("forward", FORWARD), ("gradient", GRADIENT)):
        for name in names:
            counts = found[kind][name] = measure(name, differentiated=kind == "gradient")
            before = committed.get(kind, {}).get(name, {})
            told = (f"{what} {counts[what]}" + _describe_change(counts[what], before.get(what)) for what in COUNTED)
            print(f"{kind:8} {name:20} {', '.join(told)}", flush=True)
    if "--update" in sys.argv:
        COUNTS.write_text(json.dumps(found, indent=1) + "\n")
        print(f"written: {COUNTS}")


def _describe_change(now, before):
    return "" if before == now else f" (committed: {before})"


if __name__ == "__main__":
    main()
