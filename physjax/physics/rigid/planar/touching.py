"""Where bodies in the plane touch: contacts with each other and with surfaces, in the groups in which they are solved."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.planar.impulses import build_contacts
from physjax.physics.rigid.planar.manifolds import Manifold, Outline, Vector, find_manifolds
from physjax.physics.rigid.planar.shapes import tabulate_shapes
from physjax.physics.rigid.planar.surfaces import find_surface_manifolds
from physjax.physics.rigid.solids.mechanics import Touching
from physjax.physics.rigid.solids.surface_motion import SurfaceMotion, follow_surfaces
from physjax.physics.rigid.solids.world import World


def find_contacts(world: World, place: tuple[Array, ...], t: ArrayLike) -> Touching:
    """All contacts of bodies at places x, y [m] and angles [rad], `(bodies, worlds)`: of pairs, then with each surface."""
    groups = world.groups
    # a turn once, not once for every corner
    turns = materialise(t, lambda: (jnp.cos(place[2]), jnp.sin(place[2])))
    outlines = materialise(t, lambda: _place_shapes(world, (place[0], place[1]), turns))
    normal, points, gaps, is_point = materialise(t, lambda: _find_groups(world, outlines, t))
    x, y = map(world.pad, place[:2])
    reach = lambda rows: (points[0] - x[rows][None], points[1] - y[rows][None])  # noqa: E731
    arm = reach(jnp.asarray(groups.a)), reach(jnp.asarray(groups.b))
    of, (along, across) = world.materials, world.materials.carried
    contacts = build_contacts(t, normal, arm, (along, across), (world.mass, world.turning), of.kinetic, is_point)
    touching = Touching(contacts, (gaps[0], gaps[1]), points)
    find_middle = lambda part: jnp.where(is_point[1], (part[0] + part[1]) / 2, part[0])  # noqa: E731
    middle = find_middle(points[0]), find_middle(points[1])
    motions = follow_surfaces(world, t, middle)
    if motions is None:
        return touching
    mean, end = (_see_motion(normal, (points, middle), motion) for motion in motions)
    return touching._replace(contacts=contacts._replace(carried=mean), carried_at_end=end)


def _see_motion(normal: Vector, places: tuple[Vector, Vector], motion: SurfaceMotion) -> tuple[Array, ...]:
    """The speeds of surfaces along the tangent, and along the normal at both points, given these and their middles."""
    (nx, ny), (vx, vy), ((px, py), (x, y)) = normal, motion.velocity, places
    along = [vx * nx + vy * ny + motion.spin[0] * (ny * (px[k] - x) - nx * (py[k] - y)) for k in range(2)]
    return vy * nx - vx * ny, *along


def _find_groups(world: World, outlines: Outline, t: ArrayLike) -> Manifold:
    """Manifolds `(groups, size, worlds)`."""
    groups, found = world.groups, []
    a, b = (np.where(rows < world.size, rows, 0)[: groups.of_pairs] for rows in (groups.a, groups.b))
    arrange = lambda part: part.reshape(*part.shape[:-2], -1, groups.size, part.shape[-1])  # noqa: E731
    if groups.of_pairs:
        pairs = materialise(t, lambda: find_manifolds(t, _select(outlines, a.ravel()), _select(outlines, b.ravel())))
        found.append(jax.tree.map(arrange, pairs))
    if world.slots:
        surfaces = materialise(t, lambda: find_surface_manifolds(world.slots, t, outlines))
        found.append(jax.tree.map(partial(world.arrange_by_slot, arrange), surfaces))
    normal, points, gaps, is_point = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-3), *found)
    return Manifold(normal, points, gaps, is_point & jnp.asarray(groups.is_contact)[None, ..., None])


def _place_shapes(world: World, place: Vector, turns: Vector) -> Outline:
    """The shapes of all bodies, with cosines and sines of their angles, in the world: `(corners, bodies, worlds)`."""
    shapes = world.solids.shapes
    table = tabulate_shapes(shapes if len(shapes) == world.size else shapes * world.size, world.dtype)
    (x, y), (c, s) = place, (part[None] for part in turns)
    turn = lambda v: (c * v[..., 0, None] - s * v[..., 1, None], s * v[..., 0, None] + c * v[..., 1, None])  # noqa: E731
    (cx, cy), normals = turn(table.corners), turn(table.normals)
    is_edge = jnp.broadcast_to(jnp.asarray(table.is_edge)[..., None], cx.shape)
    return Outline((cx + x[None], cy + y[None]), normals, is_edge, jnp.broadcast_to(table.radius[:, None], x.shape))


def _select(outlines: Outline, bodies: np.ndarray) -> Outline:
    corners, normals, is_edge, radius = outlines
    pick = lambda v: (v[0][:, bodies], v[1][:, bodies])  # noqa: E731
    return Outline(pick(corners), pick(normals), is_edge[:, bodies], radius[bodies])


__all__ = ["find_contacts"]
