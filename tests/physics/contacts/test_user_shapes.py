"""Contact shapes as a user writes them: a signed distance and nothing else, or the names of the first edition."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, methods, simulate
from physjax.scene import as_module
from physjax.stepping.simulate import sample_states

G = 9.8
HEIGHT, WAVE_NUMBER = 0.3, 2.0
RING, TUBE = 1.0, 0.4


class SineHill(contacts.Surface):
    """y = a sin(kx), right to first order: the height above, times the cosine of the slope."""

    def signed_distance(self, t, position):
        x, y = position[..., 0], position[..., 1]
        slope = HEIGHT * WAVE_NUMBER * jnp.cos(WAVE_NUMBER * x)
        return (y - HEIGHT * jnp.sin(WAVE_NUMBER * x)) / jnp.sqrt(1 + slope * slope)


class Brow(contacts.Surface):
    """y = -x⁴, flat on top and ever steeper."""

    def signed_distance(self, t, position):
        x, y = position[..., 0], position[..., 1]
        return (y + x**4) / jnp.sqrt(1 + 16 * x**6)


class Torus(contacts.Surface):
    """A ring about the y axis, exactly."""

    def signed_distance(self, t, position):
        across = jnp.hypot(position[..., 0], position[..., 2]) - RING
        return jnp.hypot(across, position[..., 1]) - TUBE


def above_the_hill():
    x = np.linspace(0.2, 1.4, 24)
    return np.stack([x, np.linspace(0.9, 1.2, 24)], axis=-1), np.array([0.3, 0.0])


def above_the_torus():
    x = np.linspace(0.9, 1.3, 24)
    return np.stack([x, np.linspace(0.9, 1.2, 24), np.linspace(-0.2, 0.2, 24)], axis=-1), np.array([0.1, 0.0, 0.2])


@pytest.mark.parametrize(
    ("shape", "start"),
    [(SineHill, above_the_hill), pytest.param(Torus, above_the_torus, marks=pytest.mark.slow)],
)
def test_rk4_keeps_its_order_through_a_bounce_off_a_users_curved_surface(shape, start):
    position, velocity = start()
    state = Particles(jnp.asarray(position), jnp.broadcast_to(velocity, position.shape))
    drag = forces.QuadraticDrag(area=0.02, coefficient=0.5)
    scene = Scene(state, 0.05, (forces.Gravity(G), drag), (shape(restitution=0.7),))

    def run(steps):
        # the number of steps is traced, so that all these runs are compiled once
        states = sample_states(scene, as_module(methods.rk4), jnp.asarray(0.75 / steps), jnp.asarray(steps), 1)
        return np.asarray(states.position[-1])

    truth, counts = run(2000), np.array([16, 32, 64, 128])
    errors = [np.sqrt(np.mean((run(int(count)) - truth) ** 2)) for count in counts]
    fell = np.asarray(state.position[:, 1]) - 0.5 * G * 0.75**2
    assert np.all(truth[:, 1] > fell + 0.1)  # every one of them has bounced
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] > 3.7


def test_a_particle_leaves_a_users_hill_where_it_must():
    """On y = -x⁴ without friction v² = v₀² + 2gx⁴, and it takes off where -h'' v² = g(1 + h'²): 12v₀²x² + 8gx⁶ = g."""
    speed = 0.6
    scene = Scene(
        Particles(jnp.zeros(2), jnp.array([speed, 0.0])), forces=(forces.Gravity(G),), contacts=(Brow(restitution=0.0),)
    )
    path = np.asarray(simulate(scene, methods.rk4, dt=2e-3, steps=600).position)

    leaves = np.sqrt(next(root.real for root in np.roots([8 * G, 0.0, 12 * speed**2, -G]) if abs(root.imag) < 1e-12))
    slope = -4 * leaves**3
    run = np.sqrt((speed**2 + 2 * G * leaves**4) / (1 + slope**2))  # its horizontal speed in flight
    flies = path[:, 0] > leaves
    ahead = path[flies, 0] - leaves
    distance = np.asarray(Brow().signed_distance(0.0, path))
    assert 0.5 < leaves < 0.8
    assert np.abs(distance[~flies]).max() < 1e-9
    np.testing.assert_allclose(path[flies, 1], -(leaves**4) + slope * ahead - 0.5 * G * (ahead / run) ** 2, atol=1e-4)
    assert distance[-1] > 0.005


@pytest.mark.slow
def test_a_particle_bounces_on_a_users_torus_to_the_height_of_its_restitution():
    """Dropped on the top of the ring it bounces straight up; off the side of the tube it goes where a mirror sends it."""
    drop = 1.0
    fall = np.sqrt(2 * drop / G)
    top = Particles(jnp.array([0.6, TUBE + drop, 0.8]), jnp.zeros(3))
    scene = Scene(top, forces=(forces.Gravity(G),), contacts=(Torus(restitution=0.5),))
    apex = simulate(scene, methods.rk4, dt=1.5 * fall / 40, steps=40).position[-1]
    np.testing.assert_allclose(apex, [0.6, TUBE + 0.25 * drop, 0.8], atol=1e-9)


def test_normal_and_curvature_follow_from_the_distance():
    """Of a torus they are known: towards the tube's middle circle, 1/r along the tube and cos θ/(R + r cos θ) around the ring."""
    angle = np.linspace(0.1, 3.0, 7)
    out = RING + TUBE * np.cos(angle)
    place = jnp.asarray(np.stack([out, TUBE * np.sin(angle), 0 * angle], axis=-1))
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    along = jnp.asarray(np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=-1))
    around = jnp.asarray(np.stack([0 * angle, 0 * angle, 1 + 0 * angle], axis=-1))
    np.testing.assert_allclose(Torus().normal_at(0.0, place), normal, atol=1e-12)
    np.testing.assert_allclose(Torus().curvature_acceleration(0.0, place, 2.0 * along), 4.0 / TUBE, atol=1e-12)
    np.testing.assert_allclose(Torus().curvature_acceleration(0.0, place, 3.0 * around), 9.0 * np.cos(angle) / out)


def test_a_shape_with_the_names_of_the_first_edition_is_served_with_a_note():
    with pytest.warns(FutureWarning) as notes:

        class Globe(contacts.Surface):
            def gap(self, t, position):
                return jnp.sqrt(jnp.sum(position * position, axis=-1)) - 1.0

            def outward(self, t, position):
                return position / jnp.sqrt(jnp.sum(position * position, axis=-1))[..., None]

            def bend(self, t, position, relative):
                return jnp.sum(relative * relative, axis=-1)

    for note, new in zip(notes, ("signed_distance", "normal_at", "curvature_acceleration"), strict=True):
        assert f"now called {new}" in str(note.message)
    place, velocity = jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0])
    globe, ours = Globe(restitution=0.5), contacts.Sphere((0.0, 0.0), 1.0, restitution=0.5)
    for surface in (globe, ours):
        assert float(surface.gap(0.0, 2 * place)) == float(surface.signed_distance(0.0, 2 * place)) == 1.0
        np.testing.assert_array_equal(surface.outward(0.0, place), surface.normal_at(0.0, place))
        assert float(surface.bend(0.0, place, velocity)) == 4.0
    falling = Particles(jnp.array([0.1, 1.2]), jnp.array([0.0, -1.0]))
    scenes = [Scene(falling, forces=(forces.Gravity(G),), contacts=(shape,)) for shape in (globe, ours)]
    served, right = (scene.step(methods.verlet, 0.0, 0.2).state for scene in scenes)
    np.testing.assert_allclose(served.position, right.position, atol=1e-12)
    assert float(right.velocity[1]) > 0  # it has bounced


def test_an_override_of_a_library_shape_may_ask_its_parent_by_either_name():
    class Raised(contacts.Plane):
        def signed_distance(self, t, position):
            return super().signed_distance(t, position) - 0.5

    with pytest.warns(FutureWarning, match="gap"):

        class AlsoRaised(contacts.Plane):
            def gap(self, t, position):
                return super().gap(t, position) - 0.5

    for shape in (Raised, AlsoRaised):
        plane = shape((0.0, 0.0), (0.0, 1.0))
        assert float(plane.gap(0.0, jnp.array([0.0, 2.0]))) == 1.5
        assert float(plane.signed_distance(0.0, jnp.array([0.0, 2.0]))) == 1.5


def test_a_number_of_a_shape_may_be_called_like_an_old_method():
    with warnings.catch_warnings():
        warnings.simplefilter("error")

        class Slot(contacts.Surface):
            gap: float
            bend: float

            def signed_distance(self, t, position):
                return position[..., 0] - self.gap * self.bend

    slot = Slot(2.0, 3.0)
    assert float(slot.signed_distance(0.0, jnp.array([7.0, 0.0]))) == 1.0
