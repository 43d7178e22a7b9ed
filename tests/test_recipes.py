"""What a newcomer writes in a file of his own: a force, a method, a scene and a contact shape, each used everywhere at once."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from physjax import (
    Force,
    Particles,
    Scene,
    accuracy,
    contacts,
    energy,
    forces,
    methods,
    quantity,
    scenes,
    simulate,
    sweep,
)
from physjax.physics.contacts import Surface
from physjax.show import auto_plot
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory
from physjax.vectors import norm, scale


class HardSpring(Force):
    """A spring that stiffens: F = -(k + b |x|²) x."""

    stiffness: object = quantity("stiffness", "N/m", at_least=0)
    hardening: object = quantity("hardening", "N/m³", at_least=0)

    def __call__(self, t, state, mass):
        return scale(-(self.stiffness + self.hardening * norm(state.position) ** 2), state.position)

    def potential(self, t, state, mass):
        r = norm(state.position)
        return 0.5 * self.stiffness * r**2 + 0.25 * self.hardening * r**4


def heun(system, t, state, dt):
    """Two slopes, averaged: order 2."""
    start = system.rate(t, state)
    guess = Particles(state.position + dt * start.position, state.velocity + dt * start.velocity)
    end = system.rate(t + dt, guess)
    mean = Particles(*(0.5 * (a + b) for a, b in zip(start, end, strict=True)))
    return Particles(state.position + dt * mean.position, state.velocity + dt * mean.velocity)


class Bowl(Surface):
    """The inside of a parabola y = x²/2, by a distance that is exact on the surface and never too large."""

    def signed_distance(self, t, position):
        height = position[..., 1] - 0.5 * position[..., 0] ** 2
        return height / jnp.sqrt(1.0 + position[..., 0] ** 2 + 2.0 * jnp.abs(height))


def ball(**options):
    state = Particles(jnp.array([1.0, 0.5]), jnp.array([0.0, 0.3]))
    return Scene(state, 2.0, **options)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_a_force_is_stepped_swept_ablated_and_in_the_energy_budget():
    spring = HardSpring(4.0, 2.0)
    flight = simulate(ball(forces=(spring,)), methods.rk4, dt=0.01, steps=200)
    drift = energy.total(flight.final_scene, 0.0, flight.final_scene.state) - energy.total(
        flight.scene, 0.0, flight.scene.state
    )
    assert abs(float(drift)) < 1e-6
    received = energy.ledger(flight).energy.totals
    assert "potential of HardSpring" in received
    assert sum(map(float, received.values())) == pytest.approx(0.0, abs=1e-6)

    def reach(hardening):
        scene = ball(forces=(HardSpring(4.0, hardening),))
        return simulate(scene, methods.rk4, dt=0.01, steps=40).position[-1, 0]

    values = sweep(reach, {"hardening": [0.0, 2.0, 4.0]}, progress=False).values
    assert np.all(np.diff(values) < 0)


def test_a_method_is_charted_next_to_the_others_with_its_order():
    problem = Problem(ball(forces=(forces.Anchor((0.0, 0.0), stiffness=4.0),)), duration=2.0, frames=4)
    study = accuracy.work_precision(problem, [heun, methods.rk4], [0.02, 0.01, 0.005], rivals=())
    errors = [run.path_error for run in study.runs if run.method == "heun"]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.15)
    assert any("heun" in text.get_text() for text in study.plot().legends[0].get_texts())


def test_a_scene_is_one_decorated_function_with_its_own_truth():
    @scenes.scene
    def dropped_stone(height: float = 2.0) -> Problem:
        """A stone that is dropped."""
        scene = Scene(Particles(jnp.array([0.0, height]), jnp.zeros(2)), forces=(forces.Gravity(),))
        fall = Truth("falls ½gt² [m]", lambda f: height - f.position[-1, 1], 0.5 * 9.8 * 0.25, 1e-9)
        return Problem(scene, duration=0.5, frames=2, truths=(fall,))

    try:
        assert scenes.title("dropped_stone") == "A stone that is dropped."
        problem = scenes.SCENES["dropped_stone"]()
        run = simulate(problem.scene, methods.verlet, dt=0.01, steps=50)
        (truth,) = problem.truths
        assert abs(float(truth.measure(run)) - truth.expected) < truth.tolerance
    finally:
        del scenes.SCENES["dropped_stone"]


def test_a_shape_is_hit_drawn_and_bounced_off_by_its_distance_alone():
    bowl = Bowl(restitution=0.9, response=contacts.project)
    state = Particles(jnp.array([[0.8, 1.5], [-0.3, 1.0]]), jnp.zeros((2, 2)))
    scene = Scene(state, forces=(forces.Gravity(),), contacts=(bowl,))
    run = simulate(scene, methods.verlet, dt=1 / 400, steps=400, save_every=20)
    assert isinstance(run, Trajectory)
    assert float(jnp.min(bowl.signed_distance(0.0, run.position))) > -0.02
    assert bool(jnp.any(run.velocity[..., 1] > 0.5))
    figure = auto_plot.plot_run(run)
    assert figure is not None
