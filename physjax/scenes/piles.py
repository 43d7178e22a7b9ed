"""Boxes in the plane that slide, stand on each other and lean on each other: what must stay where it is, and what must not."""

import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

UP = (0.0, 1.0)
DENSITY = 1.0
"""Of all boxes [kg/m²]."""
REST_TIME = 0.5
"""How long a pile may settle before it must be at rest [s]."""


@scene
def box_on_slope(angle: float = 0.4, friction: float = 0.3, g: float = 9.8) -> Problem:
    """A crate that slides down a slope of 0.4 rad on its edge: a = g(sin θ - μ cos θ), and it does not tip over."""
    along, normal = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
    crate = inertia.planar_plate(2.0, (1.0, 1.0))
    slope = contacts.Plane((0.0, 0.0), normal, restitution=0.0, coulomb=contacts.Coulomb(friction, friction))
    start = 0.5 * normal
    pull = g * (np.sin(angle) - friction * np.cos(angle))
    way = lambda flight: (flight.position[:, 0] - start) @ along  # noqa: E731
    return Problem(
        Scene(
            rigid.planar_bodies(crate, start[None], angle=-angle),
            crate,
            (forces.Gravity(g),),
            contacts=(rigid.Solids(rigid.PlanarShape.box((1.0, 1.0)), surfaces=(slope,)),),
        ),
        duration=1.0,
        truths=(
            Truth("slides at g(sin θ - μ cos θ) [m]", lambda f: way(f) - 0.5 * pull * f.time**2, 0.0, 1e-3 * pull),
            Truth("keeps its angle [rad]", lambda f: f.state.angle[:, 0] + angle, 0.0, 1e-3),
        ),
    )


@scene
def stack_of_ten(offset: float = 0.02, g: float = 9.8) -> Problem:
    """Ten crates on top of each other, each slightly offset from the one below: they stay where they are."""
    shift = offset * np.array([0.0, 1.0, -0.7, 0.4, -1.0, 0.8, -0.2, 0.6, -0.9, 0.3])
    place = np.stack([shift, 0.5 + np.arange(10)], axis=-1)
    return _build_pile(np.ones((10, 2)), place, g, [(i, i + 1) for i in range(9)])


@scene
def stack_of_sizes(sizes: int = 6, g: float = 9.8) -> Problem:
    """Six crates of 1 m to 32 m, each half as large as the one below: the masses are as 1 to 1024."""
    side = 2.0 ** np.arange(sizes)[::-1]
    height = np.cumsum(side) - side / 2
    place = np.stack([np.zeros(sizes), height], axis=-1)
    return _build_pile(side[:, None] * np.ones(2), place, g, [(i, i + 1) for i in range(sizes - 1)])


@scene
def pyramid(rows: int = 10, g: float = 9.8) -> Problem:
    """Fifty-five crates in ten rows, each on two of the row below: the pyramid stands."""
    row = np.concatenate([np.full(rows - i, i) for i in range(rows)])
    column = np.concatenate([np.arange(rows - i) for i in range(rows)])
    place = np.stack([1.05 * (column + 0.5 * row), row + 0.5], axis=-1)
    away = np.abs(place[:, None] - place)
    touching = (away[..., 0] < 1.1) & (away[..., 1] < 1.1)
    return _build_pile(np.ones((len(row), 2)), place, g, np.argwhere(np.triu(touching, 1)), duration=1.0)


@scene
def card_house(lean: float = 0.3, friction: float = 0.9, g: float = 9.8) -> Problem:
    """A house of cards: four leaning cards, one that lies on them, and two that lean on top; friction alone holds it."""
    length, thick = 1.0, 0.02
    half_base = 0.5 * length * np.sin(lean) + 0.5 * thick * np.cos(lean)
    rise = 0.5 * length * np.cos(lean) + 0.5 * thick * np.sin(lean)
    floor = 2 * rise + thick
    # a pair of cards about a ridge at 0: the left one leans to the right, so that their upper corners touch
    pair = np.array([[-half_base, rise], [half_base, rise]])
    ridges = np.array([-2.0, 2.0]) * half_base
    lying = np.array([[0.0, 2 * rise + thick / 2]])
    offsets = np.array([[ridges[0], 0.0], [ridges[1], 0.0], [0.0, floor]])
    left, right, top = pair + offsets[:, None]
    place = np.concatenate([left, right, lying, top])
    angle = np.array([-lean, lean, -lean, lean, np.pi / 2, -lean, lean])
    size = np.tile([thick, length], (7, 1))
    size[4, 1] = 4 * half_base
    pairs = [(0, 1), (1, 2), (2, 3), (0, 4), (1, 4), (2, 4), (3, 4), (4, 5), (4, 6), (5, 6)]
    return _build_pile(size, place, g, pairs, angle=angle, friction=friction, slack=5e-3)


def _build_pile(
    size: np.ndarray,
    place: np.ndarray,
    g: float,
    pairs: list | np.ndarray,
    *,
    angle: np.ndarray | float = 0.0,
    friction: float = 0.6,
    duration: float = 2.0,
    slack: float = 1e-3,
) -> Problem:
    """Boxes with sides `(boxes, 2)` [m] on a floor, which must be at rest within `slack`, a share of the smallest side."""
    rough = contacts.Coulomb(friction, friction)
    boxes = inertia.planar_plate(jnp.asarray(DENSITY * size.prod(axis=-1)), jnp.asarray(size))
    floor = contacts.Plane((0.0, 0.0), UP, restitution=0.0, coulomb=rough)
    alike = (size == size[0]).all()
    shapes = [rigid.PlanarShape.box(tuple(side)) for side in (size[:1] if alike else size)]
    pile = Scene(
        rigid.planar_bodies(boxes, place, angle),
        boxes,
        (forces.Gravity(g),),
        contacts=(rigid.Solids(shapes, surfaces=(floor,), coulomb=rough, pairs=pairs),),
    )
    smallest = size.max(axis=-1).min()
    return Problem(
        pile,
        duration=duration,
        truths=(
            Truth("stays where it is [m]", lambda f: f.position - place, 0.0, slack * smallest),
            Truth("keeps its angles [rad]", lambda f: f.state.angle - angle, 0.0, 2 * slack),
            Truth("is at rest when it has settled [m/s]", _measure_late_speed, 0.0, slack * smallest),
        ),
    )


def _measure_late_speed(flight: Trajectory) -> np.ndarray:
    """The speeds of all bodies from the time on at which a pile has settled [m/s]."""
    assert flight.scene is not None
    mass = np.asarray(flight.scene.mass.mass, float)
    late = flight.time > REST_TIME
    return np.linalg.norm(flight.state.momentum[late], axis=-1) / mass
