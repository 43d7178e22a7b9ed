"""A scene in space whose motion stays in a plane, as a scene in the plane."""

from dataclasses import fields, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.physics.springs.springs import Springs
from physjax.scene import Scene

ACROSS, WITHIN, ABOUT, ANYWHERE, UP = "across", "within", "about", "anywhere", "up"
VECTOR_FIELDS = {
    "up": UP, "wind": ACROSS, "velocity": ACROSS, "normal": ACROSS, "force": ACROSS, "values": ACROSS,
    "axis": ABOUT, "omega": ABOUT, "omega_rate": ABOUT, "lower": ANYWHERE, "upper": ANYWHERE,
}  # fmt: skip
"""Fields that are vectors: nothing may point across the plane, a turn is about its normal, a place may be anywhere."""
VECTOR_FIELDS_BY_TYPE = {
    forces.Anchor: {"point": WITHIN},
    forces.Blast: {"center": WITHIN},
    forces.Kick: {"impulse": ACROSS},
    contacts.Sphere: {"center": WITHIN},
    contacts.Plane: {"point": ANYWHERE},
    contacts.Slab: {"point": ANYWHERE},
}
"""Fields that are vectors here and numbers elsewhere; or places, which must be in the plane (or need not)."""
REDUCIBLE_TYPES = (
    *VECTOR_FIELDS_BY_TYPE, forces.Buoyancy, forces.Constant, forces.Control, forces.Gravitation, forces.Gravity, forces.Magnus,
    forces.QuadraticDrag, forces.RotatingFrame, forces.SphereDrag, forces.StokesDrag, contacts.Room, Springs,
)  # fmt: skip


def reduce_to_plane(scene: Scene, flight: Any) -> tuple[Scene, Any] | str:
    """The scene without the axis along which nothing moves, with what gives its states that axis back; or why there is none."""
    if not isinstance(scene.state, Particles) or scene.prescribed_motion is not None:
        return "bodies turn in space, and lanes are led along paths in space"
    if scene.emitter is not None:
        return "particles are born in space"
    axis = _find_still_axis(flight)
    if axis is None:
        return "something moves along every axis"
    place = np.asarray(scene.state.position[..., axis])
    parts = []
    for part in (*scene.forces, *scene.contacts):
        flat = _reduce_part(part, axis, place)
        if isinstance(flat, str):
            return flat
        parts.append(flat)
    state = Particles(*(jnp.delete(leaf, axis, -1) for leaf in scene.state))
    count = len(scene.forces)
    return Scene(state, scene.mass, parts[:count], parts[count:], scene.pinned), lambda states: _restore_axis(
        states, axis, place
    )


def _restore_axis(states: Particles, axis: int, place: np.ndarray) -> Particles:
    """Frames in the plane as frames in space."""
    whole = [jnp.insert(jnp.asarray(leaf), axis, 0.0, axis=-1) for leaf in states]
    at = np.zeros(whole[0].shape[-1], whole[0].dtype)
    at[axis] = 1.0
    shift = place[..., None] * at
    return Particles(whole[0] + jnp.broadcast_to(shift, whole[0].shape), whole[1])


def _find_still_axis(flight: Any) -> int | None:
    """The axis along which no lane ever moves but for rounding; the last of them."""
    x, v = np.asarray(flight.position, float), np.asarray(flight.velocity, float)
    eps = float(jnp.finfo(flight.position.dtype).eps)
    moves = np.abs(x - x[:1]).max(axis=tuple(range(x.ndim - 1)))
    speed = np.abs(v).max(axis=tuple(range(v.ndim - 1)))
    still = (moves <= 64 * eps * np.abs(x).max()) & (speed <= 64 * eps * speed.max())
    return int(np.flatnonzero(still)[-1]) if still.any() else None


def _reduce_part(part: Any, axis: int, place: np.ndarray) -> Any:
    """A force or contact in the plane, or why it cannot be."""
    name = type(part).__name__
    if type(part) not in REDUCIBLE_TYPES:
        return f"{name} is not known to act in a plane"
    if isinstance(part, Springs):
        return part
    kinds, changes = VECTOR_FIELDS | VECTOR_FIELDS_BY_TYPE.get(type(part), {}), {}
    for field in fields(part):
        value, kind = getattr(part, field.name), kinds.get(field.name)
        if value is None or kind is None:
            continue
        if kind is UP:
            if value == axis:
                return f"{name} points across the plane"
            changes[field.name] = value - (value > axis)
            continue
        along = np.asarray(value)[..., axis]
        rest = np.delete(np.asarray(value), axis, -1)
        if (kind is ACROSS and np.any(along)) or (kind is ABOUT and np.any(rest)):
            return f"{field.name} of {name} leaves the plane"
        if kind is WITHIN and np.any(along != place):
            return f"{field.name} of {name} is not in the plane"
        # a turn about y is clockwise as seen from the plane of x and z
        changes[field.name] = along * (-1.0 if axis == 1 else 1.0) if kind is ABOUT else rest
    if hasattr(part, "touching_since"):
        changes["touching_since"] = None
    return replace(part, **changes)
