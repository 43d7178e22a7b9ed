"""Mechanisms whose joints hold exactly: pendulums of several rods, a rope with a heavy load, a bridge of chains."""

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import forces
from physjax.physics.springs import Rods
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study import energy
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

INTEGRATION_STEPS = 400
"""Steps of rk4 between two frames for the equations of the angles: their error is below 1e-9."""


@scene
def double_pendulum(angles: tuple[float, ...] = (1.0, 0.5), g: float = 9.8) -> Problem:
    """Two bobs on rods of 1 m swing as the equations of the angles say, and chaotically from larger angles."""
    return _build_pendulum(angles, g, duration=5.0)


@scene
def triple_pendulum(angles: tuple[float, ...] = (1.0, 0.6, 0.2), g: float = 9.8) -> Problem:
    """Three bobs on rods of 1 m swing as the equations of the angles say."""
    return _build_pendulum(angles, g, duration=3.0)


def _build_pendulum(angles: tuple[float, ...], g: float, duration: float) -> Problem:
    """A pendulum of several rods of 1 m with bobs of 1 kg, released at these angles [rad] from the vertical."""
    links = _chain_pairs(len(angles))
    start = jnp.asarray(_place_bobs(np.array(angles)))
    rods = Rods(links, 1.0)
    hung = Scene(
        Particles(start, jnp.zeros_like(start)),
        forces=(forces.Gravity(g), rods),
        pinned=np.arange(len(start)) == 0,
    )
    return Problem(
        hung,
        duration=duration,
        conserved=(energy.ENERGY,),
        truths=(
            Truth(
                "swings as the equations of the angles say [m]", lambda f: _measure_departure(f, angles, g), 0.0, 1e-7
            ),
            Truth("its rods keep their length [m]", lambda f: _measure_links(f, links), 1.0, 1e-9),
        ),
    )


@scene
def heavy_rope(links: int = 20, ratio: float = 1800.0, length: float = 2.0, g: float = 9.8) -> Problem:
    """A rope of light links swings a load of 1800 times the mass of each, as one pendulum, and no joint opens."""
    along = np.array([np.sin(0.5), -np.cos(0.5)])
    start = jnp.asarray(np.arange(links + 1)[:, None] * length / links * along)
    pairs, mass = _chain_pairs(links), np.ones(links + 1)
    mass[-1] = ratio
    swung = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass,
        (forces.Gravity(g), Rods(pairs, length / links, substeps=None)),
        pinned=np.arange(links + 1) == 0,
    )
    reach = lambda f: np.linalg.norm(f.position[:, -1], axis=-1)  # noqa: E731
    return Problem(
        swung,
        duration=1.0,
        conserved=(energy.ENERGY,),
        truths=(
            Truth("its links keep their length [m]", lambda f: _measure_links(f, pairs), length / links, 1e-9),
            Truth("hangs straight: the load is at its length [m]", reach, length, 1e-3),
            Truth(
                "swings as one pendulum [rad]",
                lambda f: (
                    np.arctan2(f.position[:, -1, 0], -f.position[:, -1, 1])
                    - _swing(np.asarray(f.time), [0.5], g / length)[:, 0]
                ),
                0.0,
                5e-3,
            ),
        ),
    )


@scene
def chain_bridge(links: int = 30, ratio: float = 100.0, span: float = 8.0, g: float = 9.8) -> Problem:
    """A bridge of 30 links takes a load of 100 times the mass of each, and comes to rest in the polygon of statics."""
    pairs, mass, link = _chain_pairs(links), np.ones(links + 1), 0.3
    start = jnp.asarray(_hang_between(mass, span, link))
    mass[links // 2] = ratio
    rest = _hang_between(mass, span, link)
    ends = (np.arange(links + 1) == 0) | (np.arange(links + 1) == links)
    loaded = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass,
        (forces.Gravity(g), forces.StokesDrag(jnp.asarray(4.0 * mass)), Rods(pairs, link, substeps=8)),
        pinned=ends,
    )
    return Problem(
        loaded,
        duration=4.0,
        truths=(
            Truth("its links keep their length [m]", lambda f: _measure_links(f, pairs), link, 1e-9),
            Truth("comes to rest as statics has it [m]", lambda f: f.position[-1] - rest, 0.0, 2e-3),
        ),
    )


def _chain_pairs(links: int) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(links)]


def _place_bobs(angles: np.ndarray) -> np.ndarray:
    """The pivot and the bobs on rods of 1 m at angles `(*frames, rods)` from the vertical."""
    steps = np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    return np.concatenate([np.zeros_like(steps[..., :1, :]), np.cumsum(steps, axis=-2)], axis=-2)


def _measure_links(flight: Trajectory, pairs: list[tuple[int, int]]) -> np.ndarray:
    """The length of each link at each frame [m]."""
    first, second = np.array(pairs).T
    return np.linalg.norm(flight.position[:, second] - flight.position[:, first], axis=-1)


def _measure_departure(flight: Trajectory, angles: tuple[float, ...], g: float) -> np.ndarray:
    return np.asarray(flight.position) - _place_bobs(_swing(np.asarray(flight.time), angles, g))


def _swing(times: np.ndarray, angles: list[float] | tuple[float, ...], g: float) -> np.ndarray:
    """The angles of rods of 1 m with equal bobs, from rest, by rk4: Σⱼ mᵢⱼ (cos(θᵢ - θⱼ) θ̈ⱼ + sin(θᵢ - θⱼ) θ̇ⱼ²) = -mᵢᵢ g sin θᵢ.

    mᵢⱼ is how many bobs hang on both rods.
    """
    count = len(angles)
    below = count - np.maximum.outer(np.arange(count), np.arange(count))

    def rate(y: np.ndarray) -> np.ndarray:
        angle, speed = y
        apart = angle[:, None] - angle[None]
        right = -np.diag(below) * g * np.sin(angle) - (below * np.sin(apart)) @ speed**2
        return np.stack([speed, np.linalg.solve(below * np.cos(apart), right)])

    y, found = np.stack([np.array(angles), np.zeros(count)]), [np.array(angles)]
    for span in np.diff(times):
        h = span / INTEGRATION_STEPS
        for _ in range(INTEGRATION_STEPS):
            a = rate(y)
            b = rate(y + h / 2 * a)
            c = rate(y + h / 2 * b)
            y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
        found.append(y[0])
    return np.stack(found)


def _hang_between(mass: np.ndarray, span: float, link: float) -> np.ndarray:
    """Where links of a length hang at rest between two points at one height, symmetric masses at their joints.

    The vertical pull of each link is the weight of what hangs between it and the middle, the horizontal one is the same in
    all, found by bisection such that they reach across the span.
    """
    weight = mass.copy()
    weight[[0, -1]] = 0.0
    lift = np.cumsum(weight[:-1]) - weight.sum() / 2
    low, high = 0.0, 1e6 * weight.sum()
    for _ in range(200):
        pull = (low + high) / 2
        reach = (link * pull / np.hypot(pull, lift)).sum()
        low, high = (pull, high) if reach < span else (low, pull)
    steps = link * np.stack([np.full(len(lift), pull), lift], axis=-1) / np.hypot(pull, lift)[:, None]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
