"""A scene in space whose motion stays in a plane, as a scene in the plane.

Whether and how a force or a contact is reduced follows from what it declares of its numbers (`quantity`, `kind=`), so
that a user's own part is reduced as ours are. A reduced part is then held against the whole one along the run: what a
part does with its numbers, or with a static field, no declaration can say.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from physjax.particles import Particles, callable_name
from physjax.parts import Contact, Force, find_plain_functions
from physjax.quantities import Number, collect_numbers
from physjax.scene import Scene
from physjax.trajectory import Trajectory

STILL_ROUNDINGS = 64
"""Roundings of the largest coordinate, or speed, within which an axis counts as one along which nothing moves."""
AGREEMENT_SHARE = 1e-4
"""Share of the largest load or distance by which a reduced part may differ from the whole: rounding in float32."""

Part = TypeVar("Part", bound=Force | Contact)
RestoreStates = Callable[[Particles], Particles]


class _Reason(Exception):
    """Why a part has no counterpart in the plane."""


class _Plane(NamedTuple):
    """The plane of a motion: the axis across it, where each lane is along that axis [m], and the run that stays in it."""

    axis: int
    place: Float[np.ndarray, "*lanes"]
    scene: Scene
    run: Trajectory

    def drop(self, vector: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes less"]:
        """A vector without its component across the plane."""
        return jnp.delete(jnp.asarray(vector), self.axis, axis=-1)

    def iterate_moments(self) -> list[tuple[Array, Particles]]:
        """Time and state of the start and, where they are finite, of the middle and the end of the run."""
        frames = [Particles(*(leaf[i] for leaf in self.run.state)) for i in (0, len(self.run.time) // 2, -1)]
        times = [self.run.time[i] for i in (0, len(self.run.time) // 2, -1)]
        finite = [bool(jnp.all(jnp.isfinite(frame.position))) for frame in frames]
        return [(t, frame) for t, frame, good in zip(times, frames, finite, strict=True) if good]


def reduce_to_plane(scene: Scene, run: Trajectory) -> tuple[Scene, RestoreStates] | str:
    """The scene without the axis along which nothing moves, and what gives its states that axis back; or why there is none."""
    if not isinstance(scene.state, Particles) or scene.prescribed_motion is not None:
        return "bodies turn in space, and prescribed motion follows a path in space"
    if scene.emitter is not None:
        return "particles are born in space"
    axis = _find_still_axis(run)
    if axis is None:
        return "something moves along every axis"
    plane = _Plane(axis, np.asarray(scene.state.position[..., axis]), scene, run)
    try:
        forces = [_reduce_part(force, plane) for force in scene.forces]
        contacts = [_reduce_part(contact, plane) for contact in scene.contacts]
    except _Reason as reason:
        return str(reason)
    state = Particles(*(plane.drop(leaf) for leaf in scene.state))
    return Scene(state, scene.mass, forces, contacts, scene.pinned), lambda states: _restore_axis(states, plane)


def _restore_axis(states: Particles, plane: _Plane) -> Particles:
    """Frames in the plane as frames in space."""
    whole = [jnp.insert(jnp.asarray(leaf), plane.axis, 0.0, axis=-1) for leaf in states]
    across = np.zeros(whole[0].shape[-1], whole[0].dtype)
    across[plane.axis] = 1.0
    shift = plane.place[..., None] * across
    return Particles(whole[0] + jnp.broadcast_to(shift, whole[0].shape), whole[1])


def _find_still_axis(run: Trajectory) -> int | None:
    """The axis along which no lane ever moves but for rounding; the last of them."""
    x, v = np.asarray(run.position, float), np.asarray(run.velocity, float)
    eps = float(jnp.finfo(run.position.dtype).eps)
    moves = np.abs(x - x[:1]).max(axis=tuple(range(x.ndim - 1)))
    speed = np.abs(v).max(axis=tuple(range(v.ndim - 1)))
    allowed = STILL_ROUNDINGS * eps
    still = (moves <= allowed * np.abs(x).max()) & (speed <= allowed * speed.max())
    return int(np.flatnonzero(still)[-1]) if still.any() else None


def _reduce_part(part: Part, plane: _Plane) -> Part:
    """A force or contact in the plane; `_Reason` if it has no counterpart there."""
    numbers, structure = collect_numbers(part)
    name = callable_name(part)
    if find_plain_functions(part):
        raise _Reason(f"{name} is, or holds, a plain function, whose numbers are not declared; write it as a Force")
    reduced = [_reduce_number(i, numbers, structure, part, plane) for i in range(len(numbers))]
    flat = forget_contacts(structure.unflatten(reduced))
    up = part.up_axis if isinstance(part, Force) else None
    if up is not None:
        if up == plane.axis:
            raise _Reason(f"{name} points across the plane")
        flat = replace(flat, up=up - (up > plane.axis))
    _demand_agreement(part, flat, name, plane)
    return flat


def forget_contacts(part: Part) -> Part:
    """A contact without its memory, which belongs to the lanes of a scene; a force as it is."""
    return replace(part, **dict.fromkeys(part.memory)) if isinstance(part, Contact) and part.memory else part


def _reduce_number(
    i: int,
    numbers: list[Number],
    structure: jax.tree_util.PyTreeDef,  # pyright: ignore[reportInvalidTypeForm]  # no stub
    part: Force | Contact,
    plane: _Plane,
) -> Array:
    """A number of a part in the plane, by its declared kind."""
    number, axis, owner = numbers[i], plane.axis, callable_name(part)
    if number.quantity is None:
        raise _Reason(f"{number.field} of {owner} is not declared: quantity(..., kind=) says what it is in a plane")
    kind, value, what = number.quantity.kind, jnp.asarray(number.value), f"{number.field} of {owner}"
    if kind == "number":
        return value
    if kind == "rotation":
        raise _Reason(f"{what} is a rotation in space")
    along, rest = np.asarray(value)[..., axis], plane.drop(value)
    if kind == "axial":
        if np.any(rest):
            raise _Reason(f"{what} leaves the plane")
        # a turn about y is clockwise as seen from the plane of x and z
        return value[..., axis] * (-1.0 if axis == 1 else 1.0)
    if kind == "tensor":
        mixed = jnp.delete(value[..., axis], axis, axis=-1), plane.drop(value[..., axis, :])
        if any(map(np.any, mixed)):
            raise _Reason(f"{what} mixes the plane with the axis across it")
        return jnp.delete(rest, axis, axis=-2)
    if kind == "vector" and np.any(along):
        raise _Reason(f"{what} leaves the plane")
    if kind == "place" and np.any(along != plane.place) and _depends_across(i, numbers, structure, plane):
        raise _Reason(f"{what} is not in the plane")
    return rest


def _depends_across(
    i: int,
    numbers: list[Number],
    structure: jax.tree_util.PyTreeDef,  # pyright: ignore[reportInvalidTypeForm]  # no stub
    plane: _Plane,
) -> bool:
    """Whether moving a place of a part across the plane changes what the part does: of a floor its point may be anywhere."""
    values = [jnp.asarray(number.value) for number in numbers]
    across = jnp.zeros_like(values[i]).at[..., plane.axis].set(1.0)

    def measure_with(value, t, state):
        return measure_part(structure.unflatten([*values[:i], value, *values[i + 1 :]]), t, state, plane.scene)

    slopes = [
        jax.jvp(lambda value, t=t, state=state: measure_with(value, t, state), (values[i],), (across,))[1]
        for t, state in plane.iterate_moments()
    ]
    return any(map(np.any, slopes))


def measure_part(part: Force | Contact, t: Array, state: PyTree, scene: Scene) -> PyTree:
    """What a part is known by: the load on each lane [N], or the distance of each from a surface [m]."""
    if isinstance(part, Contact):
        return part.signed_distance(t, state.position)
    return state.evaluate_load(part, t, scene.mass)


def _demand_agreement(part: Force | Contact, flat: Force | Contact, name: str, plane: _Plane) -> None:
    """Raise a `_Reason` unless the reduced part does along the run what the whole one does."""
    for t, state in plane.iterate_moments():
        whole = measure_part(part, t, state, plane.scene)
        if isinstance(part, Contact):
            # what is nearest across the plane, such as a side wall of a room, is never met by what stays in it
            (slope,) = jax.vjp(lambda x, t=t: part.signed_distance(t, x), state.position)[1](jnp.ones_like(whole))
            seen = slope[..., plane.axis] == 0
        else:
            whole = plane.drop(whole)
            seen = jnp.ones(whole.shape, bool)
        try:
            found = measure_part(flat, t, Particles(*(plane.drop(leaf) for leaf in state)), plane.scene)
        except (TypeError, ValueError, IndexError) as error:
            raise _Reason(f"{name} does not act on a state in the plane: {str(error).splitlines()[0]}") from error
        largest = np.abs(whole).max(initial=0.0)
        if np.any(np.where(seen, np.abs(found - whole), 0.0) > AGREEMENT_SHARE * largest):
            raise _Reason(f"{name} acts differently in the plane than its declared numbers say")
