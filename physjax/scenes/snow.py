"""Snowboards over a jump, in metres: x down the hill, y up. A board is a particle without rotation."""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, quantity
from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory
from physjax.vectors import stack_components


class Hill(contacts.Surface):
    """A slope with a smooth jump on it: h(x) = -s x + b e^(-u²), u = (x - c)/w.

    The signed distance is the height above times the cosine of the slope: right to first order, exactly zero on the hill.
    """

    steepness: Numbers = quantity("steepness s of the slope", "1")
    jump: Numbers = quantity("height b of the jump", "m")
    at: Numbers = quantity("middle c of the jump", "m")
    width: Numbers = quantity("width w of the jump", "m", above=0)

    def height(self, x: Array) -> tuple[Array, Array, Array]:
        """h [m], h' [1] and h'' [1/m]."""
        u = (x - self.at) / self.width
        bump = self.jump * jnp.exp(-u * u)
        slope = -self.steepness - 2 * u / self.width * bump
        return bump - self.steepness * x, slope, (4 * u * u - 2) / self.width**2 * bump

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes 2"]) -> Float[Array, "*lanes"]:
        """(y - h)/√(1 + h'²) [m]."""
        h, slope, _ = self.height(position[..., 0])
        return (position[..., 1] - h) / jnp.sqrt(1 + slope * slope)

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes 2"]) -> Float[Array, "*lanes 2"]:
        """(-h', 1)/√(1 + h'²)."""
        _, slope, _ = self.height(position[..., 0])
        up = 1 / jnp.sqrt(1 + slope * slope)
        return stack_components([-slope * up, up])

    def curvature_acceleration(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """-h'' v_x²/√(1 + h'²) [m/s²]."""
        _, slope, turn = self.height(position[..., 0])
        return -turn * relative[..., 0] ** 2 / jnp.sqrt(1 + slope * slope)


@scene
def snowboard(steepness: float = 0.4, jump: float = 1.5, g: float = 9.8) -> Problem:
    """Three snowboards slide down a smooth hill and over a jump: the faster, the farther.

    A board takes off where the hill curves away faster than it can fall, -h'' v_x² = g, with the speed that energy gives,
    v² = v₀² + 2g(h₀ - h). From there it flies along a parabola until that meets the hill again.
    """
    hill = Hill(steepness, jump, 20.0, 3.0, restitution=0.0)
    speed, x = np.array([2.0, 6.0, 9.0]), jnp.zeros(3)
    top, slope, _ = hill.height(x)
    along = np.array([1.0, slope[0]]) / np.hypot(1.0, slope[0])
    start = Particles(jnp.stack([x, top], axis=-1), np.outer(speed, along))
    place, pace, lands = _solve_flights(hill, np.asarray(top) + speed**2 / (2 * g), g)

    def flight_time(flight):
        """Time since each took off [s], at every frame, and whether it is in the air."""
        x = flight.position[..., 0]
        return (x - place[0]) / pace[0], (x > place[0]) & (x < lands)

    def path_error(flight):
        t, flies = flight_time(flight)
        path = place[1] + pace[1] * t - g * t * t / 2
        return np.where(flies, flight.position[..., 1] - path, 0.0)

    def speed_error(flight):
        _, flies = flight_time(flight)
        return np.where(flies, flight.velocity[..., 0] / pace[0] - 1, 0.0)

    return Problem(
        Scene(start, 70.0, (forces.Gravity(g),), (hill,)),
        duration=4.0,
        truths=(
            Truth("takes off with the speed that energy gives [relative]", speed_error, 0.0, 1e-6),
            Truth("flies along the parabola from where -h'' v_x² = g [m]", path_error, 0.0, 1e-5),
            Truth("lands where that meets the hill [m]", _find_landings, lands, 2e-4),
        ),
        frames=128,
    )


def _solve_flights(hill: Hill, energy: np.ndarray, g: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each board takes off, (x, y) [m], its velocity there [m/s], and the x where it lands [m]; E/(mg) is given [m]."""
    x = np.linspace(0.0, 60.0, 600_001)
    h, slope, turn = (np.asarray(part, float) for part in hill.height(jnp.asarray(x)))
    found = []
    for high in energy:
        square = 2 * g * (high - h) / (1 + slope**2)
        i = np.argmax(-turn * square > g)
        pace = np.sqrt(square[i]) * np.array([1.0, slope[i]])
        t = (x - x[i]) / pace[0]
        path = h[i] + pace[1] * t - g * t * t / 2
        found.append((np.array([x[i], h[i]]), pace, x[path >= h][-1]))
    place, pace, lands = (np.stack(part, axis=-1) for part in zip(*found, strict=True))
    return place, pace, lands


def _find_landings(flight: Trajectory) -> np.ndarray:
    """Where each landed [m]: from the last frame before, at constant velocity for the time that is left."""
    assert flight.final_scene is not None
    since = np.asarray(flight.final_scene.contacts[0].touching_since)
    last, lane = np.searchsorted(flight.time, since) - 1, np.arange(since.size)
    position, velocity = np.asarray(flight.position), np.asarray(flight.velocity)
    return position[last, lane, 0] + velocity[last, lane, 0] * (since - flight.time[last])
