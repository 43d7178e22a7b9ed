"""The contact mode of each lane for a step: which surfaces carry it, and whether it sticks, slides or lifts off.

Decided once, at the start of a step: a surface lets go of a lane where the forces pull it off; a lane that stands still
sticks where static friction suffices; else it slides. The decision is in arrays of zeros and ones, so that the step
itself has no branches.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.backend import any_lane, bounded_while_loop, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.face import ContactFace
from physjax.physics.contacts.resting import Reaction, add_scaled, dot_components
from physjax.scene import Scene
from physjax.vectors import components, dot, scale, stack_components, unit

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


class ContactMode(NamedTuple):
    """What is decided at the start of a step, as arrays, which is all that a branch of a program may return.

    `state` is the state put onto the surfaces that carry it; `since` [s], `pressed` and `slip` are per surface: begin of
    contact (∞: none), 1 for the lanes it carries, and the direction of their slip; `still` is 1 for lanes that stick.
    """

    state: Particles
    since: tuple[Array, ...]
    pressed: tuple[Array, ...]
    slip: tuple[Array | None, ...]
    still: Array


def decide_contact_mode(
    scene: Scene, surfaces: tuple[ContactFace, ...], since: tuple[Array, ...], t: Time, dt: ArrayLike
) -> ContactMode:
    """The mode of each lane for the coming step; `since` [s] is its begin of contact with each surface (∞: none)."""
    flag = jnp.isfinite(jnp.stack(since))
    unheld = lax.stop_gradient(
        materialise_where(flag, lambda: scene.acceleration(t, scene.state), scene.state.velocity)
    )
    time, load_speed_squared = to_float_time(t), dot(unheld, unheld) * (dt * dt)
    touching = [
        jnp.isfinite(start) & _is_close(surface, scene.state, load_speed_squared, time, dt)
        for surface, start in zip(surfaces, since, strict=True)
    ]
    masks = [touch.astype(scene.state.dtype) for touch in touching]
    at = lax.stop_gradient(_project_onto_surfaces(surfaces, masks, time, scene.state, flag))

    def build():
        speed = dot(scene.state.velocity, scene.state.velocity) + load_speed_squared
        return [_build_contact_state(s, time, at, mask, speed) for s, mask in zip(surfaces, masks, strict=True)]

    contacts, unheld = lax.stop_gradient(materialise_where(flag, build)), components(unheld)
    pressed, still, slip = materialise_where(flag, lambda: _decide_mode(surfaces, contacts, unheld, touching))
    since = tuple(jnp.where(p > 0, s, jnp.inf) for p, s in zip(pressed, since, strict=True))
    # a lane that sticks to a surface that does not move keeps its place to the last bit, so that nothing creeps
    moves = [p * (1 - still) if s.velocity is None else p for p, s in zip(pressed, surfaces, strict=True)]
    x, v = _project_onto_surfaces(surfaces, moves, time, scene.state, flag)
    for surface, p in zip(surfaces, pressed, strict=True):
        v = v - scale(still * p, surface.relative(v))
    return ContactMode(Particles(x, v), since, pressed, slip, still)


def _decide_mode(
    surfaces: tuple[ContactFace, ...], contacts: list["_ContactState"], unheld: list[Array], touching: list[Array]
) -> tuple[tuple[Array, ...], Array, tuple[Array | None, ...]]:
    """Which surfaces carry each lane, which lanes stick, and in which direction the others slip.

    A lane lifts off where the surface would have to pull it. It sticks where all surfaces that carry it find it still
    and normal forces and static friction balance the load.
    """
    acceleration, normal_force = _solve_contact_forces(contacts, unheld)
    pressed = [
        touch & ~((force <= 0) & (dot_components(acceleration, contact.normal) + contact.curvature_acceleration > 0))
        for touch, force, contact in zip(touching, normal_force, contacts, strict=True)
    ]
    # sticking takes both: no slip yet, on any surface, and a load that static friction balances
    quiet = jnp.all(jnp.stack([~p | contact.still for p, contact in zip(pressed, contacts, strict=True)]), axis=0)
    dtype = unheld[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    # one surface is solved exactly, several by passes that converge slowly where they are nearly parallel
    left = BALANCE_ROUNDING * eps if len(surfaces) == 1 else eps**0.5
    balanced = dot_components(acceleration, acceleration) <= left**2 * dot_components(unheld, unheld)
    still = (jnp.any(jnp.stack(pressed), axis=0) & quiet & balanced).astype(dtype)
    pressed = tuple(p.astype(dtype) for p in pressed)
    slip = []
    for surface, contact, p in zip(surfaces, contacts, pressed, strict=True):
        # what stands still and does not stick begins to slip in the direction in which it is accelerated
        way = [jnp.where(contact.still, a, u) for a, u in zip(acceleration, contact.across, strict=True)]
        slip.append(None if surface.coulomb is None else scale(p * (1 - still), unit(stack_components(way))))
    return pressed, still, tuple(slip)


def make_free_mode(scene: Scene, surfaces: tuple[ContactFace, ...], since: tuple[Array, ...]) -> ContactMode:
    """The mode where no lane is in contact, shaped like that of `decide_contact_mode`."""
    # the same tree of arrays as a decision has, because a branch must return the same from both sides
    nothing, nowhere = jnp.zeros(scene.state.lanes, scene.state.dtype), jnp.zeros_like(scene.state.velocity)
    slip = tuple(None if surface.coulomb is None else nowhere for surface in surfaces)
    return ContactMode(scene.state, since, tuple(nothing for _ in surfaces), slip, nothing)


def apply_contact_mode(scene: Scene, surfaces: tuple[ContactFace, ...], mode: ContactMode) -> Scene:
    """The scene with the reactions of a mode among its forces, ready for a step."""
    any_contact = any_lane(jnp.any(jnp.stack(mode.pressed) > 0, axis=0))
    reaction = Reaction(surfaces, mode.pressed, mode.slip, mode.still, _assign_places(mode), any_contact)
    return scene.replace(state=mode.state, reaction=reaction)


def _assign_places(mode: ContactMode) -> tuple[tuple[Array, ...], ...] | None:
    """For each place, which surface takes it, lane by lane; None where every surface has a place of its own."""
    dim = mode.state.position.shape[-1]
    if len(mode.pressed) <= dim:
        return None
    # a running count over the surfaces: the first that presses on a lane takes its first place
    before, ranks = jnp.zeros_like(mode.still), []
    for pressed in mode.pressed:
        ranks.append(before)
        before = before + pressed
    return tuple(
        tuple(jnp.where(rank == place, pressed, 0.0) for pressed, rank in zip(mode.pressed, ranks, strict=True))
        for place in range(dim)
    )


class _ContactState(NamedTuple):
    """A lane at a surface: normal, curvature acceleration, tangential velocity, and the limit μ_s of static friction.

    The lane is `still` where that velocity is rounding. Vectors are lists of components.
    """

    touching: Array
    normal: list[Array]
    curvature_acceleration: Array
    across: list[Array]
    still: Bool[Array, "*lanes"]
    limit: Array | None


def _build_contact_state(
    surface: ContactFace, t: ArrayLike, state: Particles, touching: Array, speed_squared: Array
) -> _ContactState:
    """The lanes at a surface; slower than rounding of the speeds that occur in a step (`speed_squared`) is still."""
    normal_at, relative = surface.normal_at(t, state.position), surface.relative(state.velocity)
    normal, across = components(normal_at), components(relative)
    across = add_scaled(across, -dot_components(across, normal), normal)
    rounding = STILL_ROUNDING * float(jnp.finfo(state.dtype).eps)
    still = dot_components(across, across) <= rounding**2 * speed_squared
    limit = None if surface.coulomb is None else surface.coulomb.static
    if surface.friction is not None:
        # a lane comes to rest by infinitely many bounces, each of which takes the share K_f: nothing is left
        limit = jnp.where(surface.friction > 0, STICKING_FRICTION_COEFFICIENT, 0.0).astype(state.dtype)
    return _ContactState(
        touching, normal, surface.curvature_acceleration(t, state.position, relative), across, still, limit
    )


_Forces = tuple[list[Array], list[Array], list[list[Array]]]
"""The acceleration left over, and the normal force and the friction of each surface; vectors are lists of components."""


def _solve_contact_forces(contacts: list[_ContactState], acceleration: list[Array]) -> tuple[list[Array], list[Array]]:
    """The acceleration left over under normal forces and static friction, and the normal forces.

    Projected Gauss-Seidel: surface by surface, each normal force is what keeps the lane from going in, given the others,
    and the friction what keeps a still lane in place, cut to Coulomb's cone.
    """

    def sweep(forces: _Forces) -> _Forces:
        total, normal_force, friction = forces
        normal_force, friction = list(normal_force), list(friction)
        for i, c in enumerate(contacts):
            # the force that this surface had is taken back, and what is needed now is put in its place
            now = c.touching * jnp.maximum(
                normal_force[i] - dot_components(total, c.normal) - c.curvature_acceleration, 0.0
            )
            total = add_scaled(total, now - normal_force[i], c.normal)
            normal_force[i] = now
            if c.limit is not None:
                along = add_scaled(total, -dot_components(total, c.normal), c.normal)
                wanted = [f - a for f, a in zip(friction[i], along, strict=True)]
                size = jnp.sqrt(dot_components(wanted, wanted))
                share = jnp.where(size > c.limit * now, c.limit * now / jnp.where(size > 0, size, 1.0), 1.0)
                held = [jnp.where(c.still, share, 0.0) * part for part in wanted]
                total = [a + h - f for a, h, f in zip(total, held, friction[i], strict=True)]
                friction[i] = held
        return total, normal_force, friction

    nothing = jnp.zeros_like(acceleration[0])
    forces = (acceleration, [nothing for _ in contacts], [[nothing for _ in acceleration] for _ in contacts])
    if len(contacts) == 1:
        return sweep(forces)[:2]
    rounding = (SETTLED_ROUNDING * float(jnp.finfo(nothing.dtype).eps)) ** 2 * dot_components(
        acceleration, acceleration
    )

    def repeat(carry: tuple[_Forces, Array]) -> tuple[_Forces, Array]:
        before, _ = carry
        after = sweep(before)
        moved = [a - b for a, b in zip(after[0], before[0], strict=True)]
        return after, dot_components(moved, moved) > rounding

    start = forces, rounding >= 0
    return bounded_while_loop(lambda carry: any_lane(carry[1]), repeat, start, most=MAX_SETTLING_PASSES)[0][:2]


def _is_close(surface: ContactFace, state: Particles, load_speed_squared: Array, t: ArrayLike, dt: ArrayLike) -> Array:
    """Whether a lane is where a step along the surface can have left it; a state that was replaced need not be."""
    x, v = state
    relative = surface.relative(v)
    reach = REACH_SHARE * dt * (jnp.sqrt(dot(relative, relative)) + jnp.sqrt(dot(v, v)))
    rounding = (
        PLACE_ROUNDING * float(jnp.finfo(state.dtype).eps) * (jnp.sqrt(dot(x, x)) + dt * jnp.sqrt(load_speed_squared))
    )
    return jnp.abs(surface.signed_distance(t, x)) <= reach + rounding


def _project_onto_surfaces(
    surfaces: tuple[ContactFace, ...], touching: list[Array], t: ArrayLike, state: Particles, flag: Array
) -> Particles:
    """The state put onto the surfaces, its velocity along them: this removes the last step's truncation error."""
    for surface, touch in zip(surfaces, touching, strict=True):
        state = materialise_where(flag, partial(_project_onto_surface, surface, touch, t, state), state)
    return state


def _project_onto_surface(surface: ContactFace, touch: Array, t: ArrayLike, state: Particles) -> Particles:
    x, v = state
    normal = surface.normal_at(t, x)
    x = x - scale(touch * surface.signed_distance(t, x), normal)
    v = v - scale(touch * dot(surface.relative(v), normal), normal)
    if surface.friction is not None:
        v = v - scale(jnp.where(surface.friction > 0, touch, 0.0), surface.relative(v))
    return Particles(x, v)
