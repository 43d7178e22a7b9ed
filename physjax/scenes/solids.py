"""Solids in space: boxes that stand on each other, balls that hit each other, and a handful that falls into a room."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study import energy
from physjax.study.energy.quantities import ENERGY, MOMENTUM
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

UP = (0.0, 1.0, 0.0)
CRATE_MASS = 100.0
"""Of a box of 1 m [kg]."""
BOXES, CAPSULES, BALLS = 2, 2, 3
"""How many of each fall into the room."""
DENSITY = 1000.0
"""Of what falls [kg/m³]."""
REST_TIME = 1.0
"""How long a pile may settle before it must be at rest [s]."""


@scene
def stack_in_space(count: int = 10, g: float = 9.8) -> Problem:
    """Ten boxes of 1 m on top of each other on a floor: they stay where they are."""
    place = np.stack([np.zeros(count), 0.5 + np.arange(count), np.zeros(count)], axis=-1)
    return _build_pile(place, g, [(i, i + 1) for i in range(count - 1)], slack=2e-3, still=1e-6)


@scene
def pyramid_in_space(rows: int = 4, spacing: float = 0.05, g: float = 9.8) -> Problem:
    """Thirty boxes in four layers of 4 x 4 to 1, each on four of the layer below: the pyramid stands."""
    sides = range(rows, 0, -1)
    level = np.concatenate([np.full(n * n, rows - n) for n in sides])
    cell = np.concatenate([np.indices((n, n)).reshape(2, -1).T - (n - 1) / 2 for n in sides])
    place = np.stack([(1 + spacing) * cell[:, 0], level + 0.5, (1 + spacing) * cell[:, 1]], axis=-1)
    above = (np.abs(place[:, None] - place) < [1.0, 1.5, 1.0]).all(axis=-1) & (level[:, None] != level)
    return _build_pile(place, g, np.argwhere(np.triu(above, 1)), slack=2e-3, still=1e-4)


@scene
def cradle_in_space(speed: float = 1.0, count: int = 5) -> Problem:
    """Balls in a row in free space, hit by one more of their kind: it stops, and the last one leaves as fast."""
    radius = 0.1
    ball = inertia.sphere(1.0, radius)
    # along no axis, so that all components have a share
    along = np.array([2.0, 1.0, -2.0]) / 3
    reach = 2 * radius * np.arange(count) - 0.3 * (np.arange(count) == 0)
    velocity = speed * along * (np.arange(count) == 0)[:, None]
    leaves = speed * along * (np.arange(count) == count - 1)[:, None]
    row = Scene(
        rigid.bodies(ball, reach[:, None] * along, velocity=velocity),
        ball,
        contacts=(
            rigid.Solids(rigid.Shape.sphere(radius), restitution=1.0, pairs=[(i, i + 1) for i in range(count - 1)]),
        ),
    )
    return Problem(
        row,
        duration=0.8,
        conserved=(ENERGY, MOMENTUM),
        truths=(
            Truth("the last one leaves as fast [m/s]", lambda f: f.state.momentum[-1], leaves, 1e-9 * speed),
            Truth(
                "momentum is conserved [kg m/s]",
                lambda f: f.state.momentum.sum(axis=-2) - speed * along,
                0.0,
                1e-12 * speed,
            ),
        ),
    )


@scene
def marbles(g: float = 9.8) -> Problem:
    """Balls, capsules and boxes fall into a room and bounce off it and each other: nothing gives energy."""
    shapes, bodies = _list_marbles()
    random = np.random.default_rng(3)
    # in two columns, in any order, far enough apart that none touches at the start
    number = random.permutation(len(shapes))
    place = np.stack([0.22 * (2 * (number % 2) - 1), 0.35 + 0.37 * (number // 2), 0.0 * number], axis=-1)
    place = place + random.uniform(-0.03, 0.03, place.shape)
    turned = random.normal(size=(len(shapes), 4))
    start = rigid.bodies(bodies, place, turned / np.linalg.norm(turned, axis=-1, keepdims=True))
    rough = contacts.Coulomb(0.4, 0.4)
    low, high = np.array([-0.5, 0.0, -0.5]), np.array([0.5, 2.0, 0.5])
    room = contacts.Room(low, high, restitution=0.4, coulomb=rough)
    fall = Scene(start, bodies, (forces.Gravity(g),), contacts=(rigid.Solids(shapes, (room,), 0.4, rough),))
    store = jax.jit(jax.vmap(lambda t, state: energy.total(fall, t, state)))

    def gain(flight: Trajectory) -> np.ndarray:
        """By how much the energy rises from one time to the next, as a share of that at the start."""
        stored = np.asarray(store(flight.time, flight.state))
        return np.maximum(np.diff(stored) / stored[0], 0.0)

    def leave(flight: Trajectory) -> np.ndarray:
        """How far centres are outside of the room [m]."""
        return np.maximum(low - flight.position, flight.position - high).clip(0.0)

    return Problem(
        fall,
        duration=1.6,
        truths=(
            Truth("the energy never rises [relative]", gain, 0.0, 1e-6),
            Truth("all stay in the room [m]", leave, 0.0, 0.0),
        ),
        frames=8,
    )


def _list_marbles() -> tuple[list[rigid.Shape], inertia.Inertia]:
    """The shapes of what falls into the room, and its mass.

    Boxes come first: pairs of two kinds are then always in one order, which makes the program smaller.
    """
    edges, tube, length, radius = np.array([0.26, 0.14, 0.2]), 0.07, 0.2, 0.1
    tube_volume, ball_volume = np.pi * tube**2 * (length + 4 / 3 * tube), 4 / 3 * np.pi * radius**3
    kinds = (
        (BOXES, rigid.Shape.box(edges), inertia.box(DENSITY * edges.prod(), edges)),
        (CAPSULES, rigid.Shape.capsule(tube, length), inertia.capsule(DENSITY * tube_volume, tube, length)),
        (BALLS, rigid.Shape.sphere(radius), inertia.sphere(DENSITY * ball_volume, radius)),
    )
    shapes = [shape for number, shape, _ in kinds for _ in range(number)]
    each = [own for number, _, own in kinds for _ in range(number)]
    return shapes, inertia.Inertia(jnp.stack([own.mass for own in each]), jnp.stack([own.principal for own in each]))


def _build_pile(place: np.ndarray, g: float, pairs: list | np.ndarray, *, slack: float, still: float) -> Problem:
    """Boxes of 1 m on a floor, which must stay where they are within `slack` [m] and come to rest, within `still` [m/s]."""
    rough = contacts.Coulomb(0.6, 0.6)
    crate = inertia.box(CRATE_MASS, (1.0, 1.0, 1.0))
    floor = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=0.0, coulomb=rough)
    pile = Scene(
        rigid.bodies(crate, place),
        crate,
        (forces.Gravity(g),),
        contacts=(rigid.Solids(rigid.Shape.box((1.0, 1.0, 1.0)), (floor,), coulomb=rough, pairs=pairs),),
    )
    return Problem(
        pile,
        duration=2.0,
        truths=(
            Truth("stays where it is [m]", lambda f: f.position - place, 0.0, slack),
            Truth("does not turn [1]", lambda f: f.state.orientation[..., 1:], 0.0, slack),
            Truth("is at rest when it has settled [m/s]", _measure_late_speed, 0.0, still),
        ),
        frames=8,
    )


def _measure_late_speed(flight: Trajectory) -> np.ndarray:
    """The speeds of all bodies from the time on at which a pile has settled [m/s]."""
    late = flight.time > REST_TIME
    return np.linalg.norm(flight.state.momentum[late], axis=-1) / CRATE_MASS
