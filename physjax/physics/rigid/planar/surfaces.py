"""Where shapes touch the surfaces of `contacts`: at their corners, and on edges where a surface is curved."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar.manifolds import Manifold, Outline, Vector

EDGE_SEARCH_TURNS = 24
"""Turns of the search for the nearest point of an edge, each of which keeps 0.62 of it: down to 1e-5 of its length."""
GOLDEN = 0.6180339887498949
"""The share that golden sections keep: (√5 - 1)/2."""


class Slot(NamedTuple):
    """A place for contacts of every body with a surface: of a flat one with both points, of a curved one with one of them."""

    surface: Surface
    point: int | None


def list_slots(surfaces: Sequence[Surface]) -> list[Slot]:
    """The places for contacts with these surfaces; a room is its pairs of walls."""
    walls = [wall for surface in surfaces for wall in surface.walls()]
    return [Slot(wall, point) for wall in walls for point in ((0, 1) if wall.curved else (None,))]


def find_surface_manifolds(slots: Sequence[Slot], t: ArrayLike, shapes: Outline) -> Manifold:
    """The points at which every body touches each surface, slot after slot, with normals from the body to the surface."""
    found = [_find_manifold(slot, t, shapes) for slot in slots]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *found)


def _find_manifold(slot: Slot, t: ArrayLike, shapes: Outline) -> Manifold:
    (nx, ny), points, gaps, is_point = _find_points(slot.surface, t, shapes)
    if slot.point is None:
        return Manifold((nx[0], ny[0]), points, gaps, is_point)
    # a point of its own, and none where the other would be
    place = jnp.array([slot.point, slot.point])
    alone = is_point[place] & jnp.array([True, False]).reshape(2, 1, 1)
    return Manifold((nx[slot.point], ny[slot.point]), (points[0][place], points[1][place]), gaps[place], alone)


def _find_points(surface: Surface, t: ArrayLike, shapes: Outline) -> Manifold:
    """The two points nearest to one surface, all `(2, bodies, worlds)`: each has a normal of its own."""
    x, y = shapes.corners
    if surface.curved and len(x) > 1:
        on_x, on_y = _search_edges(surface, t, shapes)
        x, y = jnp.concatenate([x, on_x]), jnp.concatenate([y, on_y])
    distance = _measure(surface, t, (x, y))
    first = jnp.argmin(distance, axis=0)
    same = (x == _take(x, first)[None]) & (y == _take(y, first)[None])  # padding repeats corners
    second = jnp.argmin(jnp.where(same, jnp.inf, distance), axis=0)
    several = ~jnp.all(same, axis=0)
    pick = lambda rows: jnp.stack([_take(rows, first), _take(rows, second)])  # noqa: E731
    place = pick(x), pick(y)
    normal = surface.normal_at(t, jnp.stack(place, axis=-1))
    nx, ny = -normal[..., 0], -normal[..., 1]
    radius = shapes.radius[None]
    gap = pick(distance) - radius
    reach = radius + gap / 2
    points = place[0] + nx * reach, place[1] + ny * reach
    # in order along the first normal turned left
    ahead = (place[1][1] - place[1][0]) * nx[0] - (place[0][1] - place[0][0]) * ny[0] < 0
    turn = lambda array: jnp.where((ahead & several)[None], array[::-1], array)  # noqa: E731
    is_point = jnp.stack([jnp.ones_like(several), several])
    return Manifold((turn(nx), turn(ny)), (turn(points[0]), turn(points[1])), turn(gap), is_point)


def _take(rows: Array, index: Array) -> Array:
    """The row of each body."""
    found = rows[0]
    for i in range(1, len(rows)):
        found = jnp.where(index == i, rows[i], found)
    return found


def _measure(surface: Surface, t: ArrayLike, place: Vector) -> Array:
    return surface.signed_distance(t, jnp.stack(place, axis=-1))


def _search_edges(surface: Surface, t: ArrayLike, shapes: Outline) -> Vector:
    """The point of each edge that is nearest to a convex surface, by golden sections; of what is no edge, its first end."""
    (x, y), after = shapes.corners, _follow(shapes)
    dx, dy = after[0] - x, after[1] - y
    at = lambda share: (x + share * dx, y + share * dy)  # noqa: E731
    height: Callable[[Array], Array] = lambda share: _measure(surface, t, at(share))  # noqa: E731

    def narrow(span: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
        low, high = span
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        nearer = height(left) < height(right)
        return (jnp.where(nearer, low, left), jnp.where(nearer, right, high)), None

    (low, high), _ = lax.scan(narrow, (jnp.zeros_like(x), jnp.ones_like(x)), length=EDGE_SEARCH_TURNS)
    # an edge's nearest point moves across it, where the distance does not change: its derivative is that of a fixed share
    return at(lax.stop_gradient((low + high) / 2))


def _follow(shapes: Outline) -> Vector:
    """The corner after each, of the last one the first; of what is no edge, the corner itself."""
    last = jnp.sum(shapes.is_edge, axis=0) - 1
    numbers = jnp.arange(len(shapes.corners[0])).reshape(-1, 1, 1)
    follow = lambda c: jnp.where(numbers == last[None], c[:1], jnp.concatenate([c[1:], c[-1:]]))  # noqa: E731
    x, y = shapes.corners
    return jnp.where(shapes.is_edge, follow(x), x), jnp.where(shapes.is_edge, follow(y), y)


__all__ = ["Slot", "find_surface_manifolds", "list_slots"]
