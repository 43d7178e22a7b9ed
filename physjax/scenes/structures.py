"""Bodies made of springs that fall, carry, break and are blown up: a jelly and a bridge."""

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
    """A cube of jelly falls flat on a smooth floor, bounces, and trembles until it lies still.

    With a `lean` [rad] it falls on its edge and turns over, which no chart can follow: on which face it ends hangs on
    the last digit.
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
    touch = np.sqrt(2 * drop / g)
    share = np.asarray(jelly.mass)

    def volume(x):
        a, b, c = (x[..., jelly.faces[:, i], :] for i in range(3))
        return np.sum(a * np.cross(b, c), axis=(-1, -2)) / 6

    def height(flight):
        return flight.position[..., 1] @ share

    def fall(flight):
        fallen = height(flight)[0] - height(flight)
        return (fallen - 0.5 * g * flight.time**2)[flight.time < touch]

    def bounce(flight):
        lowest = np.argmin(height(flight))
        return height(flight)[lowest:].max() - height(flight)[lowest]

    return Problem(
        falling,
        duration=3.0,
        looks=jelly,
        truths=(
            Truth("falls as a whole, ½gt², until it touches [m]", fall, 0.0, 1e-12),
            Truth("bounces: its middle rises again [m]", bounce, 0.1, 0.05),
            Truth(
                "is squashed by the floor [part of its volume]",
                lambda f: 1 - volume(f.position).min() / side**3,
                0.2,
                0.19,
            ),
            Truth(
                "has its volume back at the end, but for its own weight [share]",
                lambda f: volume(f.position[-1]) / side**3,
                1.0,
                0.02,
            ),
            Truth("no node is under the floor [m]", lambda f: np.minimum(f.position[..., 1], 0.0), 0.0, 1e-12),
            Truth(
                "lies still at the end, but for a trembling of at most g dt [g dt]",
                lambda f: np.abs(f.velocity[-1]) / (g * f.dt),
                0.0,
                1.0,
            ),
        ),
        frames=32,
    )


@scene
def breaking_bridge(rate: float = 4e4, breaks_at: float = 0.03, g: float = 9.8) -> Problem:
    """A bridge under a load that grows by four tonnes a second until a beam parts, the next one follows, and it falls."""
    bridge, start = _build_loaded_bridge(breaks_at, g)
    loaded = np.zeros((start.shape[0], 2))
    loaded[np.flatnonzero(bridge.nodes["deck"])[2], 1] = -rate
    breaking = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=bridge.mass,
        forces=(forces.Gravity(g), bridge.springs, _GrowingLoad(loaded)),
        pinned=bridge.nodes["supports"],
    )
    weight = np.asarray(bridge.mass)[:, None] * np.array([0.0, -g])
    strain = lambda t: _strain(bridge, _solve_equilibrium(bridge, weight + t * loaded))  # noqa: E731
    low, high = 0.0, 10.0
    for _ in range(30):
        t = 0.5 * (low + high)
        low, high = (t, high) if strain(t).max() < breaks_at else (low, t)
    weakest = int(np.argmax(strain(low)))

    return Problem(
        breaking,
        duration=low + 0.75,
        truths=(
            Truth(
                "the first beam parts under the load that statics says [s]",
                lambda f: f.time[_find_first_break(f)],
                low,
                0.05,
            ),
            Truth(
                "it is the one that is stretched most in statics",
                lambda f: _mark_broken(f)[_find_first_break(f)][weakest],
                True,
                0,
            ),
            Truth(
                "what has parted stays parted", lambda f: np.minimum(np.diff(_mark_broken(f), axis=0), 0.0), 0.0, 0.0
            ),
            Truth("the bridge falls: its lowest node at the end [m]", lambda f: f.position[-1, :, 1].min(), -5.0, 4.0),
        ),
        frames=128,
    )


@scene
def blown_bridge(impulse: float = 2e4, breaks_at: float = 0.03, g: float = 9.8) -> Problem:
    """The same bridge, blown up from below: the beams near the blast part, what is left flies or falls."""
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
        """Momentum gained while the blast lasts, less what springs and weight gave meanwhile (the mean of both ends)."""
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
            Truth("nothing parts before the blast", lambda f: _mark_broken(f)[1], 0.0, 0.0),
            Truth("some of the beams part [share of all]", lambda f: _mark_broken(f)[-1].mean(), 0.5, 0.49),
            Truth(
                "what has parted stays parted", lambda f: np.minimum(np.diff(_mark_broken(f), axis=0), 0.0), 0.0, 0.0
            ),
        ),
        frames=512,
    )


_evaluate_loads = jax.jit(lambda scene, state: loads(scene, 0.0, state))


class _GrowingLoad(Force):
    """A load that grows from nothing: F = rate · t."""

    rate: jax.Array

    def __init__(self, rate):
        self.rate = jnp.asarray(rate)

    def __call__(self, t, state, mass):
        return t * self.rate


def _build_loaded_bridge(breaks_at, g):
    """The bridge, and the positions in which it carries its own weight."""
    bridge = lattices.bridge(SPAN, HEIGHT, PANELS, mass=6000.0, stiffness=2e6, damping=1e4, breaks_at=breaks_at)
    weight = np.asarray(bridge.mass)[:, None] * np.array([0.0, -g])
    return bridge, jnp.asarray(_solve_equilibrium(bridge, weight))


def _solve_equilibrium(bridge, load):
    """Where the nodes stand under a load [N], in NumPy: Newton's method on the forces of the beams."""
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
    """1 for each beam that has parted, else 0, `(frames, beams)`."""
    return 1.0 - np.asarray(flight.parts[0].unbroken)


def _find_first_break(flight):
    """The first frame in which a beam has parted."""
    return int(np.argmax(_mark_broken(flight).any(axis=1)))
