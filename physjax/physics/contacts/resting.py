"""Lasting contact: what presses on a surface is held by its reaction, and slides or sticks.

Once a step, at its start, `decide_contact_mode` decides for each lane: the surface lets go where the forces pull it off; friction
holds it still where it stands and μ_s suffices; else it slides. Then the `Reaction` joins the forces for the step.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.backend import any_lane, bounded_while_loop, materialise_where
from physjax.linear import eliminate
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.scene import Scene
from physjax.vectors import components, dot, norm, scale, stack_components, turn_left, unit

MAX_SETTLING_PASSES = 400
"""Most passes to decide whether several surfaces hold a lane still: each shrinks what is left by cos² of their angle."""
STICKING_FRICTION_COEFFICIENT = 1e18
"""A coefficient of static friction that always suffices."""
NEGLIGIBLE_SPEED = 1e-15
"""A speed [m/s] of nothing: a slide in space that is slower has the direction that was decided."""
PARALLEL_SIN_SQUARED = 1e-5
"""Two surfaces whose normals differ by less (sin² of the angle) are one: the second carries nothing."""


class Reaction(eqx.Module):
    """The normal force N >= 0 of each surface a lane presses on, -μ_k N along its slip; lanes that are held stay still.

    `pressed` and `slip` are per surface: which lanes it carries, and the direction in which they slip at the start of
    the step. A lane that would turn around within the step is braked on beyond zero, so that the path stays smooth and
    the moment of the stop can be found. No lane leans on more surfaces than space has dimensions: where there are more,
    `places` says which of them takes each lane's first place, its second and so on.
    """

    surfaces: tuple
    pressed: tuple[Float[Array, "*lanes"], ...]
    slip: tuple[Float[Array, "*lanes dim"] | None, ...]
    still: Float[Array, "*lanes"]
    places: tuple[tuple[Float[Array, "*lanes"], ...], ...] | None
    any_contact: Bool[Array, ""]

    def __call__(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        """The acceleration [m/s²] with the reactions added."""
        return lax.cond(self.any_contact, lambda: self._add_reactions(t, state, acceleration), lambda: acceleration)

    def _add_reactions(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        surface_terms = [self._compute_surface_terms(i, t, state) for i in range(len(self.surfaces))]
        total = components(acceleration)
        if self.places is None:
            presses = list(self.pressed)
        else:
            presses, surface_terms = (
                [sum(place) for place in self.places],
                [_select_place(place, surface_terms) for place in self.places],
            )
        wanted = [-_dot(total, normal) - curvature_acceleration for normal, curvature_acceleration, _ in surface_terms]
        weights = [[_dot(normal, along) for _, _, along in surface_terms] for normal, _, _ in surface_terms]
        for force, (_, _, along) in zip(_solve_normal_forces(weights, wanted, presses), surface_terms, strict=True):
            total = _add_scaled(total, force, along)
        free = 1 - self.still
        return stack_components([free * part for part in total])

    def _compute_surface_terms(self, i: int, t: ArrayLike, state: Particles) -> tuple[list, ArrayLike, list]:
        """Normal, the normal acceleration that the surface's bend adds, and where the reaction points: N and friction."""
        surface = self.surfaces[i]
        normal_at, relative = surface.normal_at(t, state.position), surface.relative(state.velocity)
        curvature_acceleration, normal = (
            surface.curvature_acceleration(t, state.position, relative),
            components(normal_at),
        )
        if self.slip[i] is None:
            return normal, curvature_acceleration, normal
        along, length = self._find_slip_direction(i, normal_at, relative)
        return normal, curvature_acceleration, _add_scaled(normal, -surface.coulomb.kinetic / length, along)

    def _find_slip_direction(self, i: int, normal_at: Array, relative: Array) -> tuple[list, ArrayLike]:
        """A vector along which a lane slips, and its length: as at the start of the step, so that it is braked on beyond zero.

        In the plane that is the surface's tangent, whose sign is decided: no division by the speed, which passes through
        zero where a slide turns back. In space it is the velocity; what is slower than a hair has the way of the slip,
        as decided.
        """
        slip = components(self.slip[i])
        if len(slip) == 2:
            tangent = components(turn_left(normal_at))
            sign = jnp.sign(_dot(tangent, slip))
            return [sign * part for part in tangent], 1.0
        normal, across = components(normal_at), components(relative)
        across = _add_scaled(across, -_dot(across, normal), normal)
        forwards = jnp.where(_dot(across, slip) < 0, -1.0, 1.0)
        # a hair of the slip's direction stands in where nothing moves yet
        across = [forwards * part + NEGLIGIBLE_SPEED * direction for part, direction in zip(across, slip, strict=True)]
        # and its derivatives are none: a choice between equals, which the compiler drops where nothing is differentiated
        moving = norm(stack_components(across)) > 2 * NEGLIGIBLE_SPEED
        across = [jnp.where(moving, part, lax.stop_gradient(part)) for part in across]
        speed = norm(stack_components(across))
        return across, jnp.where(speed > 0, speed, 1.0)


class ContactMode(NamedTuple):
    """What is decided at the start of a step, as arrays: all that a branch may return."""

    state: Particles
    since: tuple[Array, ...]
    pressed: tuple[Array, ...]
    slip: tuple[Array | None, ...]
    still: Array


def decide_contact_mode(scene: Scene, surfaces: tuple, since: tuple, t: Time, dt: ArrayLike) -> ContactMode:
    """What carries each lane through the coming step; `since` [s] is when it began to touch each surface (infinite: never)."""
    flag = jnp.isfinite(jnp.stack(since))
    unheld = lax.stop_gradient(
        materialise_where(flag, lambda: scene.acceleration(t, scene.state), scene.state.velocity)
    )
    t, load_speed_squared = to_float_time(t), dot(unheld, unheld) * (dt * dt)
    touching = [
        jnp.isfinite(moment) & _is_close(surface, scene.state, load_speed_squared, t, dt)
        for surface, moment in zip(surfaces, since, strict=True)
    ]
    masks = [touch.astype(scene.state.dtype) for touch in touching]
    at = lax.stop_gradient(_project_onto_surfaces(surfaces, masks, t, scene.state, flag))

    def look():
        speed = dot(scene.state.velocity, scene.state.velocity) + load_speed_squared
        return [_build_contact_state(s, t, at, mask, speed) for s, mask in zip(surfaces, masks, strict=True)]

    contacts, unheld = lax.stop_gradient(materialise_where(flag, look)), components(unheld)
    pressed, still, slip = materialise_where(flag, lambda: _decide_mode(surfaces, contacts, unheld, touching))
    since = tuple(jnp.where(p > 0, s, jnp.inf) for p, s in zip(pressed, since, strict=True))
    # what stands still on a surface that does too keeps its place to the last bit: nothing creeps
    moves = [p * (1 - still) if s.velocity is None else p for p, s in zip(pressed, surfaces, strict=True)]
    x, v = _project_onto_surfaces(surfaces, moves, t, scene.state, flag)
    for surface, p in zip(surfaces, pressed, strict=True):
        v = v - scale(still * p, surface.relative(v))
    return ContactMode(Particles(x, v), since, pressed, slip, still)


def _decide_mode(surfaces: tuple, contacts: list["_ContactState"], unheld: list[Array], touching: list[Array]) -> tuple:
    """Which surfaces press on each lane, which lanes stay still, and which way the others slip."""
    acceleration, normal_force = _solve_contact_forces(contacts, unheld)
    pressed = [
        touch & ~((force <= 0) & (_dot(acceleration, contact.normal) + contact.curvature_acceleration > 0))
        for touch, force, contact in zip(touching, normal_force, contacts, strict=True)
    ]
    quiet = jnp.all(jnp.stack([~p | contact.still for p, contact in zip(pressed, contacts, strict=True)]), axis=0)
    dtype = unheld[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    left = 64 * eps if len(surfaces) == 1 else eps**0.5
    balanced = _dot(acceleration, acceleration) <= left**2 * _dot(unheld, unheld)
    still = (jnp.any(jnp.stack(pressed), axis=0) & quiet & balanced).astype(dtype)
    pressed = tuple(p.astype(dtype) for p in pressed)
    slip = []
    for surface, contact, p in zip(surfaces, contacts, pressed, strict=True):
        way = [jnp.where(contact.still, a, u) for a, u in zip(acceleration, contact.across, strict=True)]
        slip.append(None if surface.coulomb is None else scale(p * (1 - still), unit(stack_components(way))))
    return pressed, still, tuple(slip)


def make_free_mode(scene: Scene, surfaces: tuple, since: tuple) -> ContactMode:
    """What `decide_contact_mode` returns where no lane touches anything."""
    nothing, nowhere = jnp.zeros(scene.state.lanes, scene.state.dtype), jnp.zeros_like(scene.state.velocity)
    slip = tuple(None if surface.coulomb is None else nowhere for surface in surfaces)
    return ContactMode(scene.state, since, tuple(nothing for _ in surfaces), slip, nothing)


def apply_contact_mode(scene: Scene, surfaces: tuple, held: ContactMode) -> Scene:
    """The scene with the lanes held as decided, ready for a step."""
    any_contact = any_lane(jnp.any(jnp.stack(held.pressed) > 0, axis=0))
    reaction = Reaction(surfaces, held.pressed, held.slip, held.still, _assign_places(held), any_contact)
    return scene.replace(state=held.state, reaction=reaction)


def _assign_places(held: ContactMode) -> tuple | None:
    """For each place, which surface takes it, lane by lane; None where every surface has one of its own."""
    dim = held.state.position.shape[-1]
    if len(held.pressed) <= dim:
        return None
    before, ranks = jnp.zeros_like(held.still), []
    for pressed in held.pressed:
        ranks.append(before)
        before = before + pressed
    return tuple(
        tuple(jnp.where(rank == place, pressed, 0.0) for pressed, rank in zip(held.pressed, ranks, strict=True))
        for place in range(dim)
    )


def _select_place(place: tuple, surface_terms: list[tuple]) -> tuple:
    """How the surface in one place feels: of normal, bend and reaction those of the lane's own surface."""
    pick = lambda *values: sum(share * value for share, value in zip(place, values, strict=True))  # noqa: E731
    return jax.tree.map(pick, *surface_terms)


def _solve_normal_forces(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """The N >= 0 with Σ_j W_ij N_j = w_i of the surfaces that press; one that would have to pull lets go."""
    forces = _eliminate_pressed(weights, wanted, presses)
    if len(forces) > 1:
        forces = _eliminate_pressed(
            weights, wanted, [jnp.where(force > 0, p, 0.0) for p, force in zip(presses, forces, strict=True)]
        )
    return [jnp.maximum(force, 0.0) for force in forces]


def _eliminate_pressed(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """Gaussian elimination, lane by lane, over those that press."""
    return eliminate(weights, wanted, lambda i, pivot: (presses[i] > 0) & (pivot > PARALLEL_SIN_SQUARED))


class _ContactState(NamedTuple):
    """A surface as a lane feels it: normal, bend, tangential velocity, and what friction can hold.

    The lane stands `still` where that velocity is rounding. Vectors are lists of components.
    """

    touching: Array
    normal: list[Array]
    curvature_acceleration: Array
    across: list[Array]
    still: Bool[Array, "*lanes"]
    limit: Array | None


def _build_contact_state(
    surface: eqx.Module, t: ArrayLike, state: Particles, touching: Array, speed_squared: Array
) -> _ContactState:
    """How a surface feels; what is slower than rounding of the speeds that a step deals with stands still."""
    normal_at, relative = surface.normal_at(t, state.position), surface.relative(state.velocity)
    normal, across = components(normal_at), components(relative)
    across = _add_scaled(across, -_dot(across, normal), normal)
    rounding = 16 * float(jnp.finfo(state.dtype).eps)
    still = _dot(across, across) <= rounding**2 * speed_squared
    limit = None if surface.coulomb is None else surface.coulomb.static
    if surface.friction is not None:
        # every one of the endless bounces takes its part of the tangential velocity: nothing is left
        limit = jnp.where(surface.friction > 0, STICKING_FRICTION_COEFFICIENT, 0.0).astype(state.dtype)
    return _ContactState(
        touching, normal, surface.curvature_acceleration(t, state.position, relative), across, still, limit
    )


def _solve_contact_forces(contacts: list[_ContactState], acceleration: list[Array]) -> tuple[list[Array], list[Array]]:
    """The acceleration that is left under normal forces and static friction, and the normal forces (projected Gauss-Seidel)."""

    def sweep(forces):
        total, normal_force, friction = forces
        normal_force, friction = list(normal_force), list(friction)
        for i, c in enumerate(contacts):
            now = c.touching * jnp.maximum(normal_force[i] - _dot(total, c.normal) - c.curvature_acceleration, 0.0)
            total = _add_scaled(total, now - normal_force[i], c.normal)
            normal_force[i] = now
            if c.limit is not None:
                along = _add_scaled(total, -_dot(total, c.normal), c.normal)
                wanted = [f - a for f, a in zip(friction[i], along, strict=True)]
                size = jnp.sqrt(_dot(wanted, wanted))
                share = jnp.where(size > c.limit * now, c.limit * now / jnp.where(size > 0, size, 1.0), 1.0)
                held = [jnp.where(c.still, share, 0.0) * part for part in wanted]
                total = [a + h - f for a, h, f in zip(total, held, friction[i], strict=True)]
                friction[i] = held
        return total, normal_force, friction

    nothing = jnp.zeros_like(acceleration[0])
    forces = (acceleration, [nothing for _ in contacts], [[nothing for _ in acceleration] for _ in contacts])
    if len(contacts) == 1:
        return sweep(forces)[:2]
    rounding = (4 * float(jnp.finfo(nothing.dtype).eps)) ** 2 * _dot(acceleration, acceleration)

    def settling(carry):
        return any_lane(carry[1])

    def pass_(carry):
        before, _ = carry
        after = sweep(before)
        moved = [a - b for a, b in zip(after[0], before[0], strict=True)]
        return after, _dot(moved, moved) > rounding

    return bounded_while_loop(settling, pass_, (forces, rounding >= 0), most=MAX_SETTLING_PASSES)[0][:2]


def _is_close(surface: eqx.Module, state: Particles, load_speed_squared: Array, t: ArrayLike, dt: ArrayLike) -> Array:
    """Whether a lane is still where a step along the surface can have left it; a state set by hand need not be."""
    x, v = state
    relative = surface.relative(v)
    reach = 0.1 * dt * (jnp.sqrt(dot(relative, relative)) + jnp.sqrt(dot(v, v)))
    rounding = 64 * float(jnp.finfo(state.dtype).eps) * (jnp.sqrt(dot(x, x)) + dt * jnp.sqrt(load_speed_squared))
    return jnp.abs(surface.signed_distance(t, x)) <= reach + rounding


def _project_onto_surfaces(surfaces: tuple, touching: list, t: ArrayLike, state: Particles, flag: Array) -> Particles:
    """Onto the surfaces and along them: what the truncation of the last step left over is taken away."""
    for surface, touch in zip(surfaces, touching, strict=True):
        state = materialise_where(flag, partial(_project_onto_surface, surface, touch, t, state), state)
    return state


def _project_onto_surface(surface: eqx.Module, touch: Array, t: ArrayLike, state: Particles) -> Particles:
    x, v = state
    normal = surface.normal_at(t, x)
    x = x - scale(touch * surface.signed_distance(t, x), normal)
    v = v - scale(touch * dot(surface.relative(v), normal), normal)
    if surface.friction is not None:
        v = v - scale(jnp.where(surface.friction > 0, touch, 0.0), surface.relative(v))
    return Particles(x, v)


def _dot(a: list[Array], b: list[Array]) -> Array:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _add_scaled(a: list[Array], factor: Array, b: list[Array]) -> list[Array]:
    return [x + factor * y for x, y in zip(a, b, strict=True)]
