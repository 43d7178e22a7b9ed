"""It must fail here, and here is the figure: each failure happens, and is explained by its right cause."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, lattices, methods, simulate, stability
from physjax.scenes import SCENES


def spring(k=15.0, b=None):
    drag = () if b is None else (forces.StokesDrag(b),)
    return Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=k), *drag))


def cloth(damping):
    stiff = {"structural": 1e3, "shear": 1e3, "bend": 1e3, "damping": damping}
    sheet = lattices.cloth(0.4, 0.4, 5, 5, mass=2.5, down=(0, 0, 1), **stiff)
    pinned = sheet.nodes["top"] & sheet.nodes["corners"]
    return Scene(sheet.state, mass=0.1, forces=(forces.Gravity(), sheet.springs), pinned=pinned)


OMEGA = np.sqrt(15.0)


@pytest.mark.parametrize(
    ("method", "b", "dt", "grown"),
    [
        (methods.euler, None, 0.1, np.sqrt(1 + 0.15)),
        (methods.euler, None, 1e-3, np.sqrt(1 + 15e-6)),
        (methods.midpoint, None, 0.1, np.sqrt(1 + 0.15**2 / 4)),
        (methods.semi_implicit_euler, None, 2.02 / OMEGA, 1.3266),
        (methods.rk4, None, 1.01 * 2 * np.sqrt(2) / OMEGA, 1.073),
        (methods.euler, 0.1, 7e-3, np.sqrt(1 - 0.7e-3 + 15 * 49e-6)),
        (methods.semi_implicit_euler, 0.1, 0.515, 1.30),
    ],
)
def test_a_spring_stepped_too_far(method, b, dt, grown):
    told = stability.explain(spring(b=b), method, dt)
    assert (told.cause, told.force) == ("stiffness", "Anchor")
    assert told.limit < dt
    assert told.growth - 1 == pytest.approx(
        grown - 1, rel=0.15 if method in (methods.rk4, methods.semi_implicit_euler) else 1e-5
    )
    assert len(told.cures) == 2
    if told.limit:
        assert simulate(spring(b=b), method, dt=0.9 * told.limit, steps=2000).ok
        assert "times the cost" in told.cures[0]


def test_rk4_loses_energy_below_its_limit():
    dt, steps = 2.5 / OMEGA, 100
    flight = simulate(spring(), methods.rk4, dt=dt, steps=steps)
    energy = 0.5 * flight.velocity[:, 0] ** 2 + 7.5 * flight.position[:, 0] ** 2
    kept = (1 - 2.5**6 / 72 + 2.5**8 / 576) ** steps
    np.testing.assert_allclose(energy[-1] / energy[0], kept, rtol=1e-6)


@pytest.mark.parametrize(
    ("damping", "dt", "cause"), [pytest.param(None, 8e-3, "stiffness", marks=pytest.mark.slow), (10.0, 4e-3, "damping")]
)
def test_a_stiff_cloth_and_one_limited_by_its_damping(damping, dt, cause):
    told = stability.explain(cloth(damping), methods.semi_implicit_euler, dt)
    assert (told.cause, told.force) == (cause, "Springs")
    assert told.first_bad_step > 0
    assert told.spring is not None
    assert f"{cause} of Springs (the spring between nodes" in str(told)
    assert f"Not finite after step {told.first_bad_step}, node {told.node[0]} first" in str(told)
    assert simulate(cloth(damping), methods.semi_implicit_euler, dt=0.9 * told.limit, steps=600).ok


def test_drag_that_turns_a_fast_body_around_within_a_step():
    drag = forces.QuadraticDrag(area=0.01, coefficient=0.5)
    scene = Scene(Particles(jnp.zeros(2), jnp.asarray([1000.0, 0.0])), mass=0.01, forces=(forces.Gravity(), drag))
    flight = simulate(scene, methods.euler, dt=0.01, steps=20)
    assert flight.velocity[1, 0] < 0
    told = stability.explain(flight)
    assert (told.cause, told.force) == ("damping", "QuadraticDrag")
    assert told.limit == pytest.approx(2 * 0.01 / (1.225 * 0.5 * 0.01 * 1000.0), rel=1e-6)


def test_a_close_approach_is_too_fast_for_the_step_though_no_limit_is_broken():
    told = stability.explain(SCENES["kepler"]().scene, methods.verlet, 0.02)
    assert (told.cause, told.force) == ("resolution", "Gravitation")
    assert "adaptive" in told.cures[1]


def test_float32_far_from_the_origin_stands_still():
    ball = Particles(jnp.asarray([1e7, 0.0], jnp.float32), jnp.asarray([1.0, 0.0], jnp.float32))
    flight = simulate(Scene(ball), methods.rk4, dt=0.01, steps=100)
    assert flight.position[-1, 0] == ball.position[0]  # a metre on, in truth
    assert stability.explain(flight).cause == "rounding"


def test_the_lectures_error_by_velocity_alone():
    ball = Scene(Particles(jnp.zeros(2), jnp.asarray([3.0, 10.0])), forces=(forces.Gravity(),))
    blind = methods.adaptive(methods.euler, 1e-3, 1e-3, error="velocity")
    told = stability.explain(ball, blind, 2.0, steps=1)
    assert told.cause == "error measure"


def test_a_sound_run_is_not_accused():
    told = stability.explain(spring(), methods.rk4, 0.01)
    assert told.cause == "nothing"
    assert "Nothing was found wrong" in str(told)
    with pytest.raises(ValueError, match="its method and dt"):
        stability.explain(spring())
