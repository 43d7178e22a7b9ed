"""What a surface looks like, from its signed distance alone: where it is, whether it moves, and polygons that lie on it.

Everything here asks a contact for `signed_distance(t, position)` and for nothing else, so that a shape written by a user
is drawn like one of ours. In the plane matplotlib draws the contour; in space `extract_level_set` makes its polygons by
surface nets (Gibson, "Constrained elastic surface nets", 1998): one vertex in each cell that the surface passes, one
quadrilateral around each edge of the grid that it cuts. Details smaller than a cell are lost.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.checks import ENTRY_AXIS_COUNT
from physjax.parts import Contact
from physjax.quantities import collect_numbers
from physjax.show.stage import NEAR_FLOOR_SHARE, REACH_SHARE, Stage

SURVEY_CELLS = {2: 64, 3: 24}
"""Cells along a side of the grid on which a surface is looked for, by the number of dimensions: 4 225 and 15 625 points."""
REFINEMENTS = 2
"""Finer surveys of what the first has found: its ends are then known to a few thousandths of its size."""
PROJECTION_STEPS = 3
"""Newton steps that bring a vertex onto the surface; each squares the error, which starts at a fraction of a cell."""
MOTION_SAMPLES = 16
"""Moments at which a surface is compared with itself to see whether it moves."""


def evaluate_distance(contact: Contact, t: float, points: np.ndarray) -> np.ndarray:
    """Signed distance [m] of points `(..., dim)` at a time; infinite where it is not a number."""
    contact, flat = _as_float64(contact), np.asarray(points, float).reshape(-1, points.shape[-1])
    with jax.enable_x64(True):
        distance = np.array(_distance(contact, jnp.asarray(t, float), jnp.asarray(flat)))
    distance[~np.isfinite(distance)] = np.inf
    return distance.reshape(points.shape[:-1])


def project_onto_surface(contact: Contact, t: float, points: np.ndarray, longest_step: float) -> np.ndarray:
    """Points `(n, dim)` moved onto the surface along the gradient, by at most `longest_step` [m] at a time."""
    contact, number = _as_float64(contact), len(points)
    if not number:
        return points
    # a moving surface has another number of vertices in every frame: in sizes of powers of two few programs are compiled
    points = np.concatenate([points, np.repeat(points[:1], (1 << (number - 1).bit_length()) - number, axis=0)])
    for _ in range(PROJECTION_STEPS):
        with jax.enable_x64(True):
            found = _distance_and_gradient(contact, jnp.asarray(t, float), jnp.asarray(points))
        distance, slope = map(np.asarray, found)
        steepness = (slope * slope).sum(axis=-1)
        # the centre of a ball, or an edge of a box, has no gradient: such a point stays where it is
        usable = np.isfinite(distance) & np.isfinite(steepness) & (steepness > 0)
        length = np.where(usable, distance, 0.0) / np.sqrt(np.where(usable, steepness, 1.0))
        along = np.where(usable[:, None], slope, 0.0) / np.sqrt(np.where(usable, steepness, 1.0))[:, None]
        points = points - np.clip(length, -longest_step, longest_step)[:, None] * along
    return points[:number]


def is_shared(contact: Contact, dim: int) -> bool:
    """Whether a surface is the same for all lanes: a single point then has a single distance."""
    if contact.couples:
        return False  # how far a lane is from the others is no surface
    point = jax.ShapeDtypeStruct((1, dim), np.float64)
    with jax.enable_x64(True):
        try:
            distance = eqx.filter_eval_shape(_distance, _as_float64(contact), np.zeros(()), point)
        except (TypeError, ValueError):
            if _has_number_per_lane(contact, dim):
                return False  # which does not fit a single point
            raise
    return distance.shape == (1,)


def _has_number_per_lane(contact: Contact, dim: int) -> bool:
    numbers = collect_numbers(contact)[0]
    declared = [(np.ndim(number.value), number.quantity) for number in numbers if number.quantity is not None]
    return any(axes > len(quantity.axes(dim)) + ENTRY_AXIS_COUNT[quantity.per] for axes, quantity in declared)


def moves(contact: Contact, stage: Stage, times: Sequence[float] | np.ndarray) -> bool:
    """Whether any of the points of a coarse grid changes its distance between the given times [s]."""
    grid = _build_grid(stage.low, stage.high, np.full(len(stage.low), 8))
    # the first three moments follow each other closely, or a motion as periodic as the sampling would look like rest
    chosen = np.unique(
        [*range(min(3, len(times))), *np.linspace(0, len(times) - 1, MOTION_SAMPLES).round().astype(int)]
    )
    first = evaluate_distance(contact, float(times[0]), grid)
    return any(not np.array_equal(first, evaluate_distance(contact, float(times[i]), grid)) for i in chosen[1:])


def is_bounded(contact: Contact, stage: Stage, t: float) -> bool:
    """Whether an obstacle ends within reach of the picture: something solid, not a floor or a container."""
    _, distance = _survey(contact, t, *_find_reach(stage))
    return not _meets_border(distance < 0)


def find_corners(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    """Points that belong into the picture: the ends of an obstacle or of a container, or the nearest point of a floor."""
    for sign in (1.0, -1.0):  # obstacles have a wrong side that ends, containers a legal one
        ends = _find_ends(contact, t, sign, *_find_reach(stage))
        if ends is not None:
            return list(ends)
    grid = _build_grid(stage.low, stage.high, np.full(len(stage.low), 4)).reshape(-1, len(stage.low))
    distance = evaluate_distance(contact, t, grid)
    nearest = distance.argmin()
    if not 0 < distance[nearest] <= NEAR_FLOOR_SHARE * stage.size:
        return []
    return list(project_onto_surface(contact, t, grid[nearest : nearest + 1], stage.size))


def extract_level_set(contact: Contact, stage: Stage, t: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(vertices, 3)` [m] and quadrilaterals `(faces, 4)` of a surface in a box, `cells` along its longest side.

    The corners of a face go round counter-clockwise as seen from the legal side. Some faces reach out of the box.
    """
    width = stage.size / cells
    count = np.maximum(np.ceil((stage.high - stage.low) / width).astype(int), 2) + 2
    # a cell more on each side: a face needs all four cells around its edge, and would end before the box does
    grid = _build_grid(stage.low - width, stage.low + (count - 1) * width, count)
    distance = np.minimum(evaluate_distance(contact, t, grid), stage.size * cells)  # infinite numbers have no shares
    points, around = _find_cut_edges(grid, distance)
    inside = np.asarray(((around >= 0) & (around < count)).all(axis=-1))
    number = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(around, -1, 0)), tuple(count), mode="clip"))
    used, index = np.unique(number[inside], return_inverse=True)
    total = np.zeros((len(used), 3))
    np.add.at(total, index, np.repeat(points, inside.sum(axis=1), axis=0))
    vertices = total / np.bincount(index, minlength=len(used))[:, None]
    return project_onto_surface(contact, t, vertices, width), np.searchsorted(used, number[inside.all(axis=1)])


def _find_cut_edges(grid: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the surface cuts edges of the grid `(edges, 3)` [m], and the cells around each `(edges, 4, 3)`.

    The cells go round counter-clockwise as seen from the legal side; at the border some are none of the grid's.
    """
    points, cells = [], []
    for axis in range(3):
        along, first, second = np.roll(np.eye(3, dtype=int), -axis, axis=0)  # right-handed: along = first x second
        before = distance[: -1 if axis == 0 else None, : -1 if axis == 1 else None, : -1 if axis == 2 else None]
        after = distance[along[0] :, along[1] :, along[2] :]
        at = np.argwhere((before < 0) != (after < 0))
        start, end = tuple(at.T), tuple((at + along).T)
        share = distance[start] / (distance[start] - distance[end])
        points.append(grid[start] + share[:, None] * (grid[end] - grid[start]))
        around = at[:, None] - np.array([first + second, second, np.zeros(3, int), first])
        legal_start = distance[start] >= 0
        around[legal_start] = around[legal_start][:, ::-1]
        cells.append(around)
    return np.concatenate(points), np.concatenate(cells)


def _find_ends(
    contact: Contact, t: float, sign: float, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The box [m] around the places where sign times the distance is negative; None if there are none or they go on."""
    found = None
    for _ in range(1 + REFINEMENTS):
        points, distance = _survey(contact, t, low, high)
        distance, cell = sign * distance, (high - low).max() / SURVEY_CELLS[len(low)]
        inside = distance < 0
        if found is None and _meets_border(inside):
            return None
        if not inside.any():
            if distance.min() > cell:
                return found
            nearest = points.reshape(-1, len(low))[distance.argmin()]  # something smaller than a cell
            low, high = nearest - 2 * cell, nearest + 2 * cell
            continue
        # a ball of the distance around a point of one side lies on that side as well
        radius = np.minimum(np.abs(distance[inside]), cell)[:, None]
        found = (points[inside] - radius).min(axis=0), (points[inside] + radius).max(axis=0)
        low, high = found[0] - cell, found[1] + cell
    return found


def _find_reach(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """The box of all that may make the picture larger."""
    middle, reach = (stage.low + stage.high) / 2, REACH_SHARE * max(stage.size, 1e-12)
    return middle - reach, middle + reach


def _survey(contact: Contact, t: float, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on a grid over a box, and their distances."""
    points = _build_grid(low, high, np.full(len(low), SURVEY_CELLS[len(low)]))
    return points, evaluate_distance(contact, t, points)


def _meets_border(inside: np.ndarray) -> bool:
    return any(bool(inside.take(end, axis=axis).any()) for axis in range(inside.ndim) for end in (0, -1))


def _build_grid(low: np.ndarray, high: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Points `(*(cells + 1), dim)` of a grid over a box."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, cells, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _as_float64(contact: Contact) -> Contact:
    return jax.tree.map(lambda leaf: np.asarray(leaf, float) if eqx.is_inexact_array_like(leaf) else leaf, contact)


@eqx.filter_jit
def _distance(contact: Contact, t: Float[Array, ""], points: Float[Array, "n dim"]) -> Float[Array, " n"]:
    return contact.signed_distance(t, points)


@eqx.filter_jit
def _distance_and_gradient(
    contact: Contact, t: Float[Array, ""], points: Float[Array, "n dim"]
) -> tuple[Float[Array, " n"], Float[Array, "n dim"]]:
    # points are independent, so the gradient of the sum holds the gradient of each
    slope = jax.grad(lambda x: jnp.sum(contact.signed_distance(t, x)))(points)
    return contact.signed_distance(t, points), slope
