"""Where bodies in space touch: contacts with each other and with surfaces, in the groups in which they are solved."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.solids.mechanics import Sides, Touching
from physjax.physics.rigid.solids.surface_motion import SurfaceMotion, follow_surfaces
from physjax.physics.rigid.solids.world import World
from physjax.physics.rigid.space.boxes import find_box_manifolds
from physjax.physics.rigid.space.components import multiply
from physjax.physics.rigid.space.hulls import Hulls, find_hull_manifolds
from physjax.physics.rigid.space.impulses import Bodies, Contacts, build_contacts
from physjax.physics.rigid.space.manifolds import POINTS, Boxes, Manifold
from physjax.physics.rigid.space.round_hulls import find_round_manifolds
from physjax.physics.rigid.space.segments import find_segment_manifolds
from physjax.physics.rigid.space.shapes import Shape, build_polyhedra, tabulate_shapes
from physjax.physics.rigid.space.surfaces import find_surface_manifolds
from physjax.physics.rigid.space.turning import find_rotation


def find_contacts(world: World, place: tuple[Array, ...], t: ArrayLike) -> Touching:
    """All contacts of bodies at places `(3, bodies, worlds)` [m] with quaternions `(4, bodies, worlds)`, in groups."""
    groups, (center, turn) = world.groups, place
    matrix, turning = materialise(t, lambda: (find_rotation(turn), world.turning.find_mobility(turn)))
    found = materialise(t, lambda: _find_groups(world, _place_shapes(world, center, matrix), t))

    def take(part: Array) -> Sides:
        padded = world.pad(part)
        return first(padded[..., jnp.asarray(groups.a), :]), first(padded[..., jnp.asarray(groups.b), :])

    first = lambda part: jnp.moveaxis(part, -3, 0)  # noqa: E731
    of = world.materials
    bodies = Bodies(take(center), world.mass, take(turning))

    # one group after the other: so each is stored whole, as it is read when it is solved
    def build(group: tuple) -> tuple[Contacts, Array]:
        found, bodies, carried, friction = group
        return build_contacts(t, found, bodies, carried, friction), found.gaps

    contacts, gap = lax.map(build, (jax.tree.map(first, found), bodies, of.carried, of.kinetic))
    touching = Touching(contacts, (gap,), found.points)
    motions = follow_surfaces(
        world, t, tuple((part[0] + part[1] + part[2] + part[3]) / POINTS for part in found.points)
    )
    if motions is None:
        return touching
    mean, end = (_see_motion(contacts, motion) for motion in motions)
    return touching._replace(contacts=contacts._replace(carried=mean), carried_at_end=end)


def _see_motion(contacts: Contacts, motion: SurfaceMotion) -> tuple[Array, Array]:
    """The velocities and angular velocities of surfaces in the frames of contacts."""
    see = jax.vmap(multiply)
    return see(contacts.axes, jnp.stack(motion.velocity, axis=1)), see(contacts.axes, jnp.stack(motion.spin, axis=1))


def _place_shapes(world: World, center: Array, matrix: Array) -> Boxes:
    """The shapes of all bodies in the world, `(bodies, worlds)`."""
    table = tabulate_shapes(_list_shapes(world), world.dtype)
    middle, axes = (center[0], center[1], center[2]), (matrix[0], matrix[1], matrix[2])
    return Boxes(middle, axes, table.half[..., None], table.radius[:, None])


def _list_shapes(world: World) -> tuple[Shape, ...]:
    """The shape of each body."""
    shapes = world.solids.shapes
    return shapes if len(shapes) == world.size else shapes * world.size


def _find_groups(world: World, boxes: Boxes, t: ArrayLike) -> Manifold:
    """Manifolds `(groups, size, worlds)`."""
    groups, found = world.groups, []
    arrange = lambda part: part.reshape(*part.shape[:-2], -1, groups.size, part.shape[-1])  # noqa: E731
    if groups.of_pairs:
        found.append(jax.tree.map(arrange, _find_pairs(world, boxes, t)))
    if world.slots:
        surfaces = materialise(t, lambda: find_surface_manifolds(world.slots, t, boxes, _list_shapes(world)))
        found.append(jax.tree.map(partial(world.arrange_by_slot, arrange), surfaces))
    normal, points, gaps, is_point = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-3), *found)
    return Manifold(normal, points, gaps, is_point & jnp.asarray(groups.is_contact)[..., None])


def _find_pairs(world: World, boxes: Boxes, t: ArrayLike) -> Manifold:
    """The manifolds of all pairs, `(pairs, worlds)`: those of one kind together, and then in the order of the groups."""
    groups, shapes = world.groups, _list_shapes(world)
    kinds = np.array([shape.kind if shape.kind in ("box", "hull") else "round" for shape in shapes])
    a, b = (np.where(rows < world.size, rows, 0)[: groups.of_pairs].ravel() for rows in (groups.a, groups.b))
    found, order = [], []
    for one, other in product(("box", "round", "hull"), repeat=2):
        chosen = np.flatnonzero((kinds[a] == one) & (kinds[b] == other))
        if not len(chosen):
            continue
        first, second = _select(boxes, a[chosen], t), _select(boxes, b[chosen], t)
        order.append(chosen)
        shaped = [[shapes[row] for row in rows[chosen]] for rows in (a, b)]
        found.append(_find_manifolds(t, (one, other), (first, second), shaped))
    if len(found) == 1:
        return found[0]
    places = np.argsort(np.concatenate(order))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2)[..., places, :], *found)


def _find_manifolds(
    t: ArrayLike, kinds: tuple[str, str], pair: tuple[Boxes, Boxes], shapes: list[list[Shape]]
) -> Manifold:
    """The manifolds of pairs of one kind: what has no sides with what has, and with its like; boxes with boxes; hulls."""
    a, b = pair
    if kinds[0] == "round" and kinds[1] != "round":
        return _turn_over(_find_manifolds(t, (kinds[1], kinds[0]), (b, a), shapes[::-1]))
    if kinds == ("box", "box"):
        return find_box_manifolds(t, a, b)
    if "hull" not in kinds:
        return find_segment_manifolds(t, a, b, kinds[0] == "box")
    hull = Hulls(a, build_polyhedra(shapes[0], b.half.dtype))
    if kinds[1] == "round":
        return find_round_manifolds(t, hull, b)
    return find_hull_manifolds(t, hull, Hulls(b, build_polyhedra(shapes[1], b.half.dtype)))


def _turn_over(found: Manifold) -> Manifold:
    """The manifold of a and b, given that of b and a."""
    x, y, z = found.normal
    return found._replace(normal=(-x, -y, -z))


def _select(boxes: Boxes, rows: np.ndarray, t: ArrayLike) -> Boxes:
    x, y, z = (part[:, rows] for part in boxes.axes)
    center = boxes.center[0][rows], boxes.center[1][rows], boxes.center[2][rows]
    return materialise(t, lambda: Boxes(center, (x, y, z), boxes.half[:, rows], boxes.radius[rows]))


__all__ = ["find_contacts"]
