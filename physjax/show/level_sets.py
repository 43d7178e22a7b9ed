"""What a surface looks like, from its signed distance alone: where it is, whether it moves, and polygons that lie on it.

Everything here asks a contact for `signed_distance(t, position)` and for nothing else, so that a shape written by a user
is drawn like one of ours. In the plane matplotlib draws the contour; in space `extract_level_set` makes its polygons by
surface nets (Gibson, "Constrained elastic surface nets", 1998): one vertex in each cell that the surface passes, one
quadrilateral around each edge of the grid that it cuts. Details smaller than a cell are lost.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.parts import Contact
from physjax.show.stage import NEAR_FLOOR_SHARE, REACH_SHARE, Stage

SURVEY_CELLS = {2: 64, 3: 24}
"""Cells along a side of the grid on which a surface is looked for, by the number of dimensions: 4 225 and 15 625 points."""
PROJECTION_STEPS = 3
"""Newton steps that bring a vertex onto the surface; each squares the error, which starts at a fraction of a cell."""
MOTION_SAMPLES = 16
"""Moments at which a surface is compared with itself to see whether it moves."""


def evaluate_distance(contact: Contact, t: float, points: np.ndarray) -> np.ndarray:
    """Signed distance [m] of points `(..., dim)` at a time; infinite where it is not a number."""
    contact, flat = _as_float64(contact), np.asarray(points, float).reshape(-1, points.shape[-1])
    with jax.enable_x64(True):
        distance = np.array(_distance(contact, np.asarray(t, float), flat))
    distance[~np.isfinite(distance)] = np.inf
    return distance.reshape(points.shape[:-1])


def project_onto_surface(contact: Contact, t: float, points: np.ndarray, longest_step: float) -> np.ndarray:
    """Points `(n, dim)` moved onto the surface along the gradient, by at most `longest_step` [m] at a time."""
    contact = _as_float64(contact)
    for _ in range(PROJECTION_STEPS):
        with jax.enable_x64(True):
            distance, slope = (np.asarray(x) for x in _distance_and_gradient(contact, np.asarray(t, float), points))
        steepness = (slope * slope).sum(axis=-1)
        # the centre of a ball, or an edge of a box, has no gradient: such a point stays where it is
        usable = np.isfinite(distance) & np.isfinite(steepness) & (steepness > 0)
        length = np.where(usable, distance, 0.0) / np.sqrt(np.where(usable, steepness, 1.0))
        along = np.where(usable[:, None], slope, 0.0) / np.sqrt(np.where(usable, steepness, 1.0))[:, None]
        points = points - np.clip(length, -longest_step, longest_step)[:, None] * along
    return points


def is_shared(contact: Contact, dim: int) -> bool:
    """Whether a surface is the same for all lanes: a single point then has a single distance."""
    if contact.couples:
        return False  # how far a lane is from the others is no surface
    with jax.enable_x64(True):
        point = jax.ShapeDtypeStruct((1, dim), np.float64)
        try:
            distance = jax.eval_shape(_as_float64(contact).signed_distance, np.zeros(()), point)
        except (TypeError, ValueError):  # numbers for each lane do not fit a single point
            return False
    return distance.shape == (1,)


def moves(contact: Contact, stage: Stage, times: np.ndarray) -> bool:
    """Whether any of the points of a coarse grid changes its distance between the given times [s]."""
    grid = _build_grid(stage.low, stage.high, np.full(len(stage.low), 8))
    # the first three moments follow each other closely, or a motion as periodic as the sampling would look like rest
    chosen = np.unique(
        [*range(min(3, len(times))), *np.linspace(0, len(times) - 1, MOTION_SAMPLES).round().astype(int)]
    )
    first = evaluate_distance(contact, times[0], grid)
    return any(not np.array_equal(first, evaluate_distance(contact, times[i], grid)) for i in chosen[1:])


def is_bounded(contact: Contact, stage: Stage, t: float) -> bool:
    """Whether it is an obstacle that ends within reach of the picture: something solid, not a floor or a container."""
    _, distance = _survey(contact, stage, t)
    return (distance < 0).any() and not _meets_border(distance < 0)


def find_corners(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    """Points that belong into the picture: the ends of an obstacle or of a container, or the nearest point of a floor."""
    points, distance = _survey(contact, stage, t)
    cell = 2 * REACH_SHARE * max(stage.size, 1e-12) / SURVEY_CELLS[len(stage.low)]
    for side in (distance < 0, distance > 0):
        if side.any() and not _meets_border(side):
            # a ball of the distance around a point of one side lies on that side as well
            radius = np.minimum(np.abs(distance[side]), cell)[:, None]
            return [(points[side] - radius).min(axis=0), (points[side] + radius).max(axis=0)]
    grid = _build_grid(stage.low, stage.high, np.full(len(stage.low), 4)).reshape(-1, len(stage.low))
    distance = evaluate_distance(contact, t, grid)
    nearest = distance.argmin()
    if not 0 < distance[nearest] <= NEAR_FLOOR_SHARE * stage.size:
        return []
    return list(project_onto_surface(contact, t, grid[nearest : nearest + 1], stage.size))


def extract_level_set(contact: Contact, stage: Stage, t: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(vertices, 3)` [m] and quadrilaterals `(faces, 4)` of a surface in a box, `cells` along its longest side.

    The corners of a face go round counter-clockwise as seen from the legal side.
    """
    width = stage.size / cells
    count = np.maximum(np.ceil((stage.high - stage.low) / width).astype(int), 2)
    # a cell more on each side: a face needs all four cells around its edge, and would end before the box does
    low, high = stage.low - width, stage.low + (count + 1) * width
    grid = _build_grid(low, high, count + 2)
    distance = evaluate_distance(contact, t, grid)
    distance = np.minimum(distance, 10 * stage.size)  # shares of an infinite difference are no numbers
    crossed, middle = _average_crossings(grid, distance)
    numbers = np.full(crossed.shape, -1)
    numbers[crossed] = np.arange(crossed.sum())
    return project_onto_surface(contact, t, middle[crossed], width), _join_cells(numbers, distance)


def _average_crossings(grid: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which cells the surface passes, and the mean of the points in which it cuts the edges of each."""
    cells = tuple(n - 1 for n in distance.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells, int)
    for axis in range(3):
        start, end = (_slice(distance, axis, part) for part in (slice(None, -1), slice(1, None)))
        crosses = (start < 0) != (end < 0)
        share = np.where(crosses, start / np.where(crosses, start - end, 1.0), 0.0)
        first, last = (_slice(grid, axis, part) for part in (slice(None, -1), slice(1, None)))
        point = np.where(crosses[..., None], first + share[..., None] * (last - first), 0.0)
        # each edge belongs to the four cells around it
        for near in product((0, 1), repeat=2):
            part = _around(axis, [slice(side, side + cells[i]) for side, i in zip(near, _others(axis), strict=True)])
            total += point[part]
            count += crosses[part]
    return count > 0, total / np.maximum(count, 1)[..., None]


def _join_cells(numbers: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """The faces: for each edge that is cut, the vertices of the four cells around it."""
    faces = []
    for axis in range(3):
        inner = [slice(1, -1)] * 2
        start, end = (_slice(distance, axis, part)[_around(axis, inner)] for part in (slice(None, -1), slice(1, None)))
        crosses = (start < 0) != (end < 0)
        around = [
            numbers[_around(axis, [slice(None, -1) if side else slice(1, None) for side in near])][crosses]
            for near in ((1, 1), (0, 1), (0, 0), (1, 0))
        ]
        face = np.stack(around, axis=-1)
        turned = start[crosses] >= 0  # the legal side is at the start of the edge
        face[turned] = face[turned][:, ::-1]
        faces.append(face)
    return np.concatenate(faces)


def _survey(contact: Contact, stage: Stage, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on a grid as far as the picture may reach, and their distances."""
    middle, reach = (stage.low + stage.high) / 2, REACH_SHARE * max(stage.size, 1e-12)
    points = _build_grid(middle - reach, middle + reach, np.full(len(middle), SURVEY_CELLS[len(middle)]))
    return points, evaluate_distance(contact, t, points)


def _meets_border(inside: np.ndarray) -> bool:
    return any(bool(inside.take(end, axis=axis).any()) for axis in range(inside.ndim) for end in (0, -1))


def _build_grid(low: np.ndarray, high: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Points `(*(cells + 1), dim)` of a grid over a box."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, cells, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _others(axis: int) -> tuple[int, int]:
    """The two axes after another, in the cycle x, y, z: (axis, first, second) is right-handed."""
    return (axis + 1) % 3, (axis + 2) % 3


def _slice(array: np.ndarray, axis: int, part: slice) -> np.ndarray:
    return array[(slice(None),) * axis + (part,)]


def _around(axis: int, parts: list[slice]) -> tuple[slice, ...]:
    """An index that takes everything along an axis, and these parts along the two after it."""
    index = [slice(None)] * 3
    for i, part in zip(_others(axis), parts, strict=True):
        index[i] = part
    return tuple(index)


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
