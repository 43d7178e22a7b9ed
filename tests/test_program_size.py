"""Compile time follows the size of a program: it is counted for typical scenes, and must not grow unnoticed.

`python tests/test_program_size.py` prints the table anew.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import count_operations

from physjax import Particles, Scene, contacts, forces, methods, simulate
from physjax.scenes import SCENES

GROWTH = 1.1
"""By how much a program may grow before the table is written anew, on purpose."""
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


BUILDERS = {
    "plane": lambda: balls_among(contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.8)),
    "room of 6": lambda: balls_among(*around(6)),
    "room of 60": lambda: balls_among(*around(60)),
    "planes and spheres": among_spheres,
    **{
        name: lambda name=name: SCENES[name]().scene
        for name in ("fall_with_drag", "flag", "bouncing_ball", "tumbling_box", "ragdoll", "car")
    },
}


def end(velocity, scene):
    """What eight rk4 steps of the scene are to a velocity."""
    start = scene.replace(state=scene.state._replace(**{velocity_of(scene): velocity}))
    return simulate(start, methods.rk4, dt=1e-3, steps=8).state


def velocity_of(scene):
    return scene.state._fields[-1] if isinstance(scene.state, Particles) else "momentum"


def measure(name, differentiated):
    """Operations of the program of eight rk4 steps, or of the gradient of its end."""
    scene = BUILDERS[name]()
    velocity = getattr(scene.state, velocity_of(scene))
    if not differentiated:
        return count_operations(jax.jit(end).lower(velocity, scene))
    loss = lambda velocity, scene: jnp.sum(end(velocity, scene).position[-1] ** 2)  # noqa: E731
    return count_operations(jax.jit(jax.value_and_grad(loss)).lower(velocity, scene))


FORWARD = {
    "plane": 1339,
    "room of 6": 1751,
    "room of 60": 1873,
    "planes and spheres": 2588,
    "fall_with_drag": 144,
    "flag": 2287,
    "bouncing_ball": 1134,
    "tumbling_box": 2520,
    "ragdoll": 2781,
    "car": 5542,
}
"""Operations of eight rk4 steps."""
GRADIENT = {
    "planes and spheres": 6595,
    "fall_with_drag": 403,
    "flag": 8519,
    "bouncing_ball": 2486,
    "car": 20079,
}
"""Operations of a value and its gradient by velocities."""


@pytest.mark.parametrize("name", FORWARD)
def test_a_program_does_not_grow(name):
    assert measure(name, differentiated=False) <= GROWTH * FORWARD[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", GRADIENT)
def test_the_program_of_a_gradient_does_not_grow(name):
    assert measure(name, differentiated=True) <= GROWTH * GRADIENT[name]


def test_a_room_of_sixty_walls_costs_what_one_of_six_does():
    assert measure("room of 60", differentiated=False) <= 1.2 * measure("room of 6", differentiated=False)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name in BUILDERS:
        print(f"{name:20} {measure(name, differentiated=False):6} {measure(name, differentiated=True):6}", flush=True)
