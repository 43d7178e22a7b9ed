"""The contact mode of each lane for a leg of a step: which surfaces carry it, and whether it sticks, slides or lifts off.

Decided once, at the start of a leg: a surface lets go of a lane where the forces pull it off; a lane that stands still
sticks where static friction suffices; else it slides. A decision has no derivatives; what follows from it has.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.backend import any_lane
from physjax.loops import Time, bounded_while_loop, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.resting import Reaction
from physjax.physics.contacts.surfaces import Surfaces, Touch, average_surfaces, mask_surfaces, relative_to
from physjax.scene import Scene
from physjax.vectors import dot, norm, scale, unit

T = TypeVar("T")

MAX_SETTLING_PASSES = 400
"""Most passes over several surfaces that carry one lane: each shrinks the residual by cos² of the angle between them."""
STICKING_FRICTION_COEFFICIENT = 1e18
"""A coefficient of static friction that always suffices."""
STILL_ROUNDING = 16
"""Units of rounding of the speeds in a step below which a tangential velocity is zero."""
BALANCE_ROUNDING = 64
"""Units of rounding of the load below which what is left of it under the reactions is zero; one surface solves exactly."""
SETTLED_ROUNDING = 4
"""Units of rounding of the load below which a pass over the surfaces changes nothing."""
REACH_SHARE = 0.1
"""Share of the way of a step by which truncation may have moved a lane off a surface that it moves along."""
PLACE_ROUNDING = 64
"""Units of rounding of the place, and of what a step's load moves, that are added to that reach."""

MAX_BRANCHLESS_NUMBERS = 64
"""Numbers in a velocity up to which a single smooth surface reacts without asking whether it must."""


class ContactMode(NamedTuple):
    """What is decided at the start of a leg, without derivatives.

    `pressed` says which surfaces carry each lane, `still` which lanes stick. A lane presses on no more surfaces than
    space has dimensions: `slip` is the direction in which it slips on the first of them, the second and so on.
    """

    pressed: Bool[Array, "surfaces *lanes"]
    still: Bool[Array, "*lanes"]
    slip: Float[Array, "places *lanes dim"] | None


def decide_contact_mode(
    scene: Scene, surfaces: Surfaces, touch: Touch, since: Array, t: Time, dt: ArrayLike
) -> ContactMode:
    """The mode of each lane for the coming leg; `since` [s] is its begin of contact with each surface (∞: none).

    A surface lets go where it would have to pull. A lane sticks where all surfaces that carry it find it still and
    normal forces and static friction balance the load.
    """
    scene, surfaces, touch, dt = lax.stop_gradient((scene, surfaces, touch, dt))
    state, eps = scene.state, float(jnp.finfo(scene.state.dtype).eps)
    load, time = scene.acceleration(t, state), to_float_time(t)
    load_squared = dot(load, load)
    load_speed_squared = load_squared * (dt * dt)
    touching = jnp.isfinite(since) & _is_close(touch, state, load_speed_squared, dt)
    contacts = _build_contact_states(surfaces, touch, time, state, touching, load_speed_squared)
    contacts, surplus = _enter_surface_frame(surfaces, contacts, load, time, state)
    left, normal_force = _solve_contact_forces(contacts, surplus)
    away = dot(jnp.broadcast_to(left, touch.normal.shape), touch.normal) + contacts.curvature_acceleration
    pressed = touching & ~((normal_force <= 0) & (away > 0))
    # sticking takes both: no slip yet, on any surface, and a load that static friction balances
    quiet = jnp.all(~pressed | contacts.still, axis=0)
    # one surface is solved exactly, several by passes that converge slowly where they are nearly parallel
    rounding = BALANCE_ROUNDING * eps if len(surfaces) == 1 else eps**0.5
    still = jnp.any(pressed, axis=0) & quiet & (dot(left, left) <= rounding**2 * load_squared)
    slip = None
    if surfaces.rough.any():
        # what stands still and does not stick begins to slip in the direction in which it is accelerated
        way = unit(jnp.where(contacts.still[..., None], left[None], contacts.across))
        slips = pressed & ~still[None] & mask_surfaces(surfaces.rough, pressed)
        way = scale(slips.astype(state.dtype), way)
        slip = select_places(assign_places(pressed, state), way)
    return ContactMode(pressed, still, slip)


def make_free_mode(scene: Scene, surfaces: Surfaces) -> ContactMode:
    """The mode where no lane is in contact, shaped like that of `decide_contact_mode`."""
    lanes, v = scene.state.lanes, scene.state.velocity
    places = min(len(surfaces), v.shape[-1])
    slip = jnp.zeros((places, *v.shape), v.dtype) if surfaces.rough.any() else None
    return ContactMode(jnp.zeros((len(surfaces), *lanes), bool), jnp.zeros(lanes, bool), slip)


def apply_contact_mode(scene: Scene, surfaces: Surfaces, mode: ContactMode) -> Scene:
    """The scene with the reactions of a mode among its forces."""
    state, any_contact = scene.state, None if _is_cheap(surfaces, scene) else any_lane(mode.pressed)
    places = assign_places(mode.pressed, state)
    pressed = mode.pressed if places is None else jnp.any(places, axis=1)
    number = lambda flag: flag.astype(state.dtype)  # noqa: E731
    reaction = Reaction(surfaces, places, number(pressed), number(mode.still), mode.slip, any_contact)
    return scene.replace(reaction=reaction)


def start_leg(scene: Scene, surfaces: Surfaces, mode: ContactMode, t: Time) -> tuple[Scene, Surfaces]:
    """The scene as a leg in a known mode begins, differentiable: put onto what carries it; and the faces that it meets."""
    state, time = scene.state, to_float_time(t)
    faces = surfaces.facing(time, state.position)
    put = lambda: put_on_surfaces(faces, faces.measure(time, state), mode, state)  # noqa: E731
    on = put() if _is_cheap(surfaces, scene) else lax.cond(any_lane(mode.pressed), put, lambda: state)
    return apply_contact_mode(scene.replace(state=on), faces, mode), faces


def get_reaction(held: Scene) -> Reaction:
    """The reactions among the forces of a scene to which a mode was applied."""
    return cast(Reaction, held.reaction)


def _is_cheap(surfaces: Surfaces, scene: Scene) -> bool:
    """Whether reactions are computed without asking whether any lane is in contact: a branch takes longer, also to compile."""
    few = scene.state.velocity.size <= MAX_BRANCHLESS_NUMBERS
    return len(surfaces) == 1 and not surfaces.rough.any() and few


def assign_places(pressed: Array, state: Particles) -> Bool[Array, "places surfaces *lanes"] | None:
    """For each place, which surface takes it, lane by lane; None where every surface has a place of its own."""
    dim = state.position.shape[-1]
    if len(pressed) <= dim:
        return None
    # a running count over the surfaces: the first that presses on a lane takes its first place
    rank = jnp.cumsum(pressed.astype(jnp.int32), axis=0)
    return pressed[None] & (rank[None] == jnp.arange(1, dim + 1).astype(rank.dtype).reshape(-1, *(1,) * rank.ndim))


def select_places(places: Array | None, values: Array) -> Array:
    """Of each place the value of the surface that takes it: a sum, of which all shares but one are zero."""
    if places is None:
        return values
    mask = places if places.ndim == values.ndim + 1 else places[..., None]
    return jnp.sum(jnp.where(mask, values[None], 0.0), axis=1)


class _ContactStates(NamedTuple):
    """The lanes at all surfaces: normals, curvature acceleration, tangential velocity, the limit μ_s of static friction.

    A lane is `still` where that velocity is rounding.
    """

    touching: Array
    normal: Array
    curvature_acceleration: Array
    across: Array
    still: Bool[Array, "surfaces *lanes"]
    limit: Array | None


def _build_contact_states(
    surfaces: Surfaces, touch: Touch, t: ArrayLike, state: Particles, touching: Array, load_speed_squared: Array
) -> _ContactStates:
    """The lanes at all surfaces; slower than rounding of the speeds that occur in a step is still."""
    number = touching.astype(state.dtype)
    _, v = _slide_along(touch, number, _find_grip(surfaces, number), state)
    relative = relative_to(touch.carried, v, len(surfaces))
    across = relative - scale(dot(relative, touch.normal), touch.normal)
    rounding = STILL_ROUNDING * float(jnp.finfo(state.dtype).eps)
    speed_squared = dot(state.velocity, state.velocity) + load_speed_squared
    still = dot(across, across) <= (rounding**2 * speed_squared)[None]
    turn = surfaces.distance_acceleration(t, state)
    return _ContactStates(
        number,
        touch.normal,
        jnp.zeros_like(touch.distance) if turn is None else turn,
        across,
        still,
        _find_sticking_limit(surfaces, state.lanes),
    )


def _enter_surface_frame(
    surfaces: Surfaces, contacts: _ContactStates, load: Array, t: ArrayLike, state: Particles
) -> tuple[_ContactStates, Array]:
    """The contacts and the load in the frame of what accelerates: there a lane that sticks needs no acceleration at all.

    What the frame takes from the load it gives back to the second derivatives of the distances.
    """
    carried = surfaces.acceleration_at(t, state.position)
    if carried is None:
        return contacts, load
    leads = mask_surfaces(surfaces.accelerates, contacts.touching).astype(load.dtype)
    frame = average_surfaces(contacts.touching * leads, carried)
    turn = contacts.curvature_acceleration + dot(jnp.broadcast_to(frame, contacts.normal.shape), contacts.normal)
    return contacts._replace(curvature_acceleration=turn), load - frame


def _find_sticking_limit(surfaces: Surfaces, lanes: tuple[int, ...]) -> Array | None:
    """The coefficient of static friction of every surface; None where no surface has friction."""
    limit, friction = surfaces.static_friction(lanes), surfaces.friction(lanes)
    if friction is None:
        return limit
    # a lane comes to rest by infinitely many bounces, each of which takes the share K_f: nothing is left
    sticky = jnp.where(friction > 0, STICKING_FRICTION_COEFFICIENT, 0.0).astype(friction.dtype)
    return sticky if limit is None else jnp.maximum(sticky, limit)


def _find_grip(surfaces: Surfaces, touching: Array) -> Array | None:
    """Where K_f takes the whole tangential velocity of a lane that a surface carries; None without such friction."""
    friction = surfaces.friction(touching.shape[1:])
    return None if friction is None else jnp.where(friction > 0, touching, 0.0)


_Forces = tuple[Array, Array, Array | None]
"""The acceleration left over, and the normal force and the friction of each surface."""


def _solve_contact_forces(contacts: _ContactStates, load: Array) -> tuple[Array, Array]:
    """The acceleration left over under normal forces and static friction, and the normal forces.

    Projected Gauss-Seidel: surface by surface, each normal force is what keeps the lane from going in, given the others,
    and the friction what keeps a still lane in place, cut to Coulomb's cone.
    """

    def turn(total: Array, one: tuple[_ContactStates, Array, Array | None]) -> tuple[Array, tuple]:
        c, force, friction = one
        # the force that this surface had is taken back, and what is needed now is put in its place
        now = c.touching * jnp.maximum(force - dot(total, c.normal) - c.curvature_acceleration, 0.0)
        total = total + scale(now - force, c.normal)
        if c.limit is None or friction is None:
            return total, (now, None)
        wanted = friction - (total - scale(dot(total, c.normal), c.normal))
        size, most = norm(wanted), c.limit * now
        share = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0)
        held = scale(jnp.where(c.still, share, 0.0), wanted)
        return total + held - friction, (now, held)

    def sweep(forces: _Forces) -> _Forces:
        total, pushes = scan_surfaces(turn, forces[0], (contacts, *forces[1:]))
        return (total, *pushes)

    forces = (
        load,
        jnp.zeros_like(contacts.touching),
        None if contacts.limit is None else jnp.zeros_like(contacts.normal),
    )
    if len(contacts.touching) == 1:
        return sweep(forces)[:2]
    rounding = (SETTLED_ROUNDING * float(jnp.finfo(load.dtype).eps)) ** 2 * dot(load, load)

    def repeat(carry: tuple[_Forces, Array]) -> tuple[_Forces, Array]:
        after = sweep(carry[0])
        moved = after[0] - carry[0][0]
        return after, dot(moved, moved) > rounding

    start = forces, rounding >= 0
    return bounded_while_loop(lambda carry: any_lane(carry[1]), repeat, start, most=MAX_SETTLING_PASSES)[0][:2]


def scan_surfaces(turn: Callable[[T, Any], tuple[T, Any]], carry: T, each: Any) -> tuple[T, Any]:
    """`lax.scan` over the axis of surfaces; a single one takes its turn without a loop."""
    if jax.tree.leaves(each)[0].shape[0] > 1:
        return lax.scan(turn, carry, each)
    carry, out = turn(carry, jax.tree.map(lambda leaf: leaf[0], each))
    return carry, jax.tree.map(lambda leaf: leaf[None], out)


def _is_close(touch: Touch, state: Particles, load_speed_squared: Array, dt: ArrayLike) -> Array:
    """Whether a lane is where a step along the surface can have left it; a state that was replaced need not be."""
    x, v = state
    speed = norm(v)
    moves = speed[None] + (speed[None] if touch.carried is None else norm(v[None] - touch.carried))
    rounding = PLACE_ROUNDING * float(jnp.finfo(state.dtype).eps) * (norm(x) + dt * jnp.sqrt(load_speed_squared))
    return jnp.abs(touch.distance) <= (REACH_SHARE * jnp.broadcast_to(dt, x.shape[:-1]))[None] * moves + rounding[None]


def put_on_surfaces(surfaces: Surfaces, touch: Touch, mode: ContactMode, state: Particles) -> Particles:
    """The state put onto what carries it, its velocity along it: this removes the last step's truncation error."""
    pressed, still = mode.pressed.astype(state.dtype), mode.still.astype(state.dtype)[None]
    # a lane that sticks to a surface that does not move keeps its place to the last bit, so that nothing creeps
    moves = jnp.where(mask_surfaces(surfaces.moves, pressed), pressed, pressed * (1 - still))
    grip = _find_grip(surfaces, moves)
    stick = pressed * still
    return _slide_along(touch, moves, stick if grip is None else jnp.maximum(grip, stick), state)


def _slide_along(touch: Touch, moves: Array, grip: Array | None, state: Particles) -> Particles:
    """The state moved onto the surfaces where `moves` is 1, one after the other, and its velocity along them.

    Where `grip` is 1 the lane takes over the velocity of the surface.
    """

    def turn(carry: tuple[Array, Array], one: tuple[Touch, Array, Array | None]) -> tuple[tuple[Array, Array], None]:
        (shift, v), (at, move, hold) = carry, one
        # the distance after what the surfaces before have shifted the lane by
        shift = shift - scale(move * (at.distance + dot(shift, at.normal)), at.normal)
        relative = v if at.carried is None else v - at.carried
        v = v - scale(move * dot(relative, at.normal), at.normal)
        if hold is not None:
            v = v - scale(hold, v if at.carried is None else v - at.carried)
        return (shift, v), None

    start = (jnp.zeros_like(state.position), state.velocity)
    (shift, v), _ = scan_surfaces(turn, start, (touch, moves, grip))
    return Particles(state.position + shift, v)
