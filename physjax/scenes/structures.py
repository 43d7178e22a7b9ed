"""Structures made of springs: a jelly that falls, a bridge that is loaded until it breaks, and one that is blown up."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics import contacts, forces
from physjax.physics.springs import lattices
from physjax.scene import Scene, loads
from physjax.scenes.registry import scene
from physjax.study.problem import Problem, Truth

SPAN, HEIGHT, PANELS = 12.0, 2.0, 6
"""The bridge: a deck of 12 m between two banks, a truss of six panels above it [m]."""


@scene
def jelly_cube(nodes: int = 4, side: float = 0.2, lean: float = 0.0, g: float = 9.8) -> Problem:
    """A cube of jelly falls flat on a smooth floor, bounces, and vibrates until it is at rest.

    With a `lean` [rad] it falls on its edge and turns over; that is chaotic, and no chart can compare methods on it.
    """
    jelly = lattices.jelly(
        (side,) * 3, (nodes,) * 3, mass=1.0, structural=300.0, shear=150.0, damping=0.7, corner=(-side / 2,) * 3
    )
    drop = 0.3
    turn = np.array([[np.cos(lean), -np.sin(lean), 0.0], [np.sin(lean), np.cos(lean), 0.0], [0.0, 0.0, 1.0]])
    start = np.asarray(jelly.state.position) @ turn.T
    start[:, 1] += drop - start[:, 1].min()
    start = jnp.asarray(start)
    falling = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=jelly.mass,
        forces=(forces.Gravity(g), jelly.springs),
        contacts=(contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0),),
    )
    return Problem(falling, duration=3.0, looks=jelly, truths=_build_jelly_truths(jelly, side, drop, g), frames=32)


def _build_jelly_truths(jelly: lattices.Lattice, side: float, drop: float, g: float) -> tuple[Truth, ...]:
    impact_time, share = np.sqrt(2 * drop / g), np.asarray(jelly.mass)

    def volume(x):
        a, b, c = (x[..., jelly.faces[:, i], :] for i in range(3))
        return np.sum(a * np.cross(b, c), axis=(-1, -2)) / 6 / side**3

    def height(flight):
        return flight.position[..., 1] @ share

    def fall(flight):
        fallen = height(flight)[0] - height(flight)
        return (fallen - 0.5 * g * flight.time**2)[flight.time < impact_time]

    def bounce(flight):
        lowest = np.argmin(height(flight))
        return height(flight)[lowest:].max() - height(flight)[lowest]

    speed = lambda flight: np.abs(flight.velocity[-1]) / (g * flight.dt)  # noqa: E731
    return (
        Truth("falls as a whole, ½gt², until the impact [m]", fall, 0.0, 1e-12),
        Truth("bounces: its centre rises again [m]", bounce, 0.1, 0.05),
        Truth("is compressed by the floor [share of its volume]", lambda f: 1 - volume(f.position).min(), 0.2, 0.19),
        Truth("regains its volume but for its own weight [share]", lambda f: volume(f.position[-1]), 1.0, 0.02),
        Truth("no node is under the floor [m]", lambda f: np.minimum(f.position[..., 1], 0.0), 0.0, 1e-12),
        Truth("vibrates at the end with at most g dt [g dt]", speed, 0.0, 1.0),
    )


@scene
def breaking_bridge(rate: float = 4e4, breaks_at: float = 0.03, g: float = 9.8) -> Problem:
    """A bridge under a load that grows by four tonnes per second until one beam breaks after the other and it falls."""
    bridge, start = _build_loaded_bridge(breaks_at, g)
    loaded = np.zeros((start.shape[0], 2))
    loaded[np.flatnonzero(bridge.nodes["deck"])[2], 1] = -rate
    breaking = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=bridge.mass,
        forces=(forces.Gravity(g), bridge.springs, _GrowingLoad(loaded)),
        pinned=bridge.nodes["supports"],
    )
    moment, weakest = _solve_first_break(bridge, loaded, breaks_at, g)
    return Problem(
        breaking,
        duration=moment + 0.75,
        truths=(
            Truth(
                "the first beam breaks under the load of statics [s]",
                lambda f: f.time[_find_first_break(f)],
                moment,
                0.05,
            ),
            Truth(
                "it is the one with the largest strain in statics",
                lambda f: _mark_broken(f)[_find_first_break(f)][weakest],
                True,
                0,
            ),
            STAYS_BROKEN,
            Truth("the bridge falls: its lowest node at the end [m]", lambda f: f.position[-1, :, 1].min(), -5.0, 4.0),
        ),
        frames=128,
    )


def _solve_first_break(bridge: lattices.Lattice, loaded: np.ndarray, breaks_at: float, g: float) -> tuple[float, int]:
    """When the first beam breaks in statics under a load that grows as `loaded` [N/s], by bisection [s], and which it is."""
    weight = np.asarray(bridge.mass)[:, None] * np.array([0.0, -g])
    strain = lambda t: _strain(bridge, _solve_equilibrium(bridge, weight + t * loaded))  # noqa: E731
    low, high = 0.0, 10.0
    for _ in range(30):
        t = 0.5 * (low + high)
        low, high = (t, high) if strain(t).max() < breaks_at else (low, t)
    return low, int(np.argmax(strain(low)))


@scene
def blown_bridge(impulse: float = 2e4, breaks_at: float = 0.03, g: float = 9.8) -> Problem:
    """The same bridge, blown up from below: beams near the blast break, and the pieces fly or fall."""
    bridge, start = _build_loaded_bridge(breaks_at, g)
    blast = forces.Blast((0.4 * SPAN, -1.0), impulse, reach=2.0, at=1 / 512, duration=1 / 512)
    blown = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=bridge.mass,
        forces=(forces.Gravity(g), bridge.springs, blast),
        pinned=bridge.nodes["supports"],
    )
    d = np.asarray(start) - np.asarray(blast.center)
    distance = np.linalg.norm(d, axis=1, keepdims=True)
    expected = impulse / (1 + (distance / 2.0) ** 2) * d / distance
    free = ~bridge.nodes["supports"]

    def received(flight):
        """Momentum gained while the blast lasts, less the impulse of springs and weight meanwhile (trapezoidal rule)."""
        before, after = (Particles(flight.position[i], flight.velocity[i]) for i in (1, 2))
        others = flight.scene.replace(forces=flight.scene.forces[:2])
        steady = 0.5 * (np.asarray(_evaluate_loads(others, before)) + np.asarray(_evaluate_loads(others, after)))
        gained = np.asarray(flight.scene.mass)[:, None] * (after.velocity - before.velocity)
        return (gained - steady * (flight.time[2] - flight.time[1]))[free]

    return Problem(
        blown,
        duration=1.0,
        truths=(
            Truth("each node gets the impulse J/(1 + (d/r)²) [N s]", received, expected[free], 0.005 * impulse),
            Truth("no beam breaks before the blast", lambda f: _mark_broken(f)[1], 0.0, 0.0),
            Truth("some of the beams break [share of all]", lambda f: _mark_broken(f)[-1].mean(), 0.5, 0.49),
            STAYS_BROKEN,
        ),
        frames=512,
    )


_evaluate_loads = jax.jit(lambda scene, state: loads(scene, 0.0, state))


class _GrowingLoad(Force):
    """A load that grows from zero: F = rate · t, with one rate per node [N/s]."""

    rate: jax.Array

    def __init__(self, rate):
        self.rate = jnp.asarray(rate)

    def __call__(self, t, state, mass):
        return t * self.rate


def _build_loaded_bridge(breaks_at, g):
    """The bridge, and its equilibrium positions under its own weight."""
    bridge = lattices.bridge(SPAN, HEIGHT, PANELS, mass=6000.0, stiffness=2e6, damping=1e4, breaks_at=breaks_at)
    weight = np.asarray(bridge.mass)[:, None] * np.array([0.0, -g])
    return bridge, jnp.asarray(_solve_equilibrium(bridge, weight))


def _solve_equilibrium(bridge, load):
    """Equilibrium positions of the nodes under a load [N], in NumPy: Newton's method on the forces of the beams."""
    x, held = np.asarray(bridge.state.position, float).copy(), np.repeat(bridge.nodes["supports"], 2)
    (a, b), rest = bridge.springs.pairs.T, np.asarray(bridge.springs.rest_length, float)
    k = float(bridge.springs.stiffness)
    for _ in range(8):
        d = x[b] - x[a]
        length = np.linalg.norm(d, axis=1)
        way = d / length[:, None]
        pull = (k * (length - rest))[:, None] * way
        force = load.copy()
        np.add.at(force, a, pull)
        np.add.at(force, b, -pull)
        stiff = np.zeros((len(x), 2, len(x), 2))
        for i, j, u, slack in zip(a, b, way, 1 - rest / length, strict=True):
            block = k * (np.outer(u, u) + slack * (np.eye(2) - np.outer(u, u)))
            for p, q, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                stiff[p, :, q] += sign * block
        stiff = stiff.reshape(x.size, x.size)[np.ix_(~held, ~held)]
        step = np.zeros(x.size)
        step[~held] = np.linalg.solve(stiff, force.ravel()[~held])
        x = x + step.reshape(x.shape)
    return x


def _strain(bridge, x):
    """Strain of each beam with its nodes at x."""
    a, b = bridge.springs.pairs.T
    return np.linalg.norm(x[b] - x[a], axis=1) / np.asarray(bridge.springs.rest_length) - 1


def _mark_broken(flight):
    """1 for each broken beam, else 0, `(frames, beams)`."""
    return 1.0 - np.asarray(flight.parts[0].unbroken)


def _find_first_break(flight):
    """The first frame with a broken beam."""
    return int(np.argmax(_mark_broken(flight).any(axis=1)))


STAYS_BROKEN = Truth("broken beams stay broken", lambda f: np.minimum(np.diff(_mark_broken(f), axis=0), 0.0), 0.0, 0.0)
