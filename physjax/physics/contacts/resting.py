"""Lasting contact: what presses on a surface is held by its reaction, and slides or sticks.

Once a step, at its start, `hold` decides for each lane: the surface lets go where the forces pull it off; friction
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

from physjax.backend import any_lane, apart, loop
from physjax.loops import Time, now
from physjax.particles import Particles
from physjax.scene import Scene
from physjax.vectors import components, dot, norm, scale, stacked, turn_left, unit

SETTLING = 400
"""Most passes to decide whether several surfaces hold a lane still: each shrinks what is left by cos² of their angle."""
ENOUGH = 1e18
"""A coefficient of static friction that always suffices."""
HAIR = 1e-15
"""A speed [m/s] of nothing: a slide in space that is slower has the direction that was decided."""
PARALLEL = 1e-5
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
    anywhere: Bool[Array, ""]

    def __call__(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        """The acceleration [m/s²] with the reactions added."""
        return lax.cond(self.anywhere, lambda: self._added(t, state, acceleration), lambda: acceleration)

    def _added(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        felt = [self._at(i, t, state) for i in range(len(self.surfaces))]
        total = components(acceleration)
        if self.places is None:
            presses = list(self.pressed)
        else:
            presses, felt = [sum(place) for place in self.places], [_picked(place, felt) for place in self.places]
        wanted = [-_dot(total, normal) - bend for normal, bend, _ in felt]
        weights = [[_dot(normal, along) for _, _, along in felt] for normal, _, _ in felt]
        for force, (_, _, along) in zip(_normal_forces(weights, wanted, presses), felt, strict=True):
            total = _plus(total, force, along)
        free = 1 - self.still
        return stacked([free * part for part in total])

    def _at(self, i: int, t: ArrayLike, state: Particles) -> tuple[list, ArrayLike, list]:
        """Normal, the normal acceleration that the surface's bend adds, and where the reaction points: N and friction."""
        surface = self.surfaces[i]
        outward, relative = surface.outward(t, state.position), surface.relative(state.velocity)
        bend, normal = surface.bend(t, state.position, relative), components(outward)
        if self.slip[i] is None:
            return normal, bend, normal
        along, length = self._way(i, outward, relative)
        return normal, bend, _plus(normal, -surface.coulomb.kinetic / length, along)

    def _way(self, i: int, outward: Array, relative: Array) -> tuple[list, ArrayLike]:
        """A vector along which a lane slips, and its length: as at the start of the step, so that it is braked on beyond zero.

        In the plane that is the surface's tangent, whose sign is decided: no division by the speed, which passes through
        zero where a slide turns back. In space it is the velocity; what is slower than a hair has the way of the slip,
        as decided.
        """
        slip = components(self.slip[i])
        if len(slip) == 2:
            tangent = components(turn_left(outward))
            sign = jnp.sign(_dot(tangent, slip))
            return [sign * part for part in tangent], 1.0
        normal, across = components(outward), components(relative)
        across = _plus(across, -_dot(across, normal), normal)
        forwards = jnp.where(_dot(across, slip) < 0, -1.0, 1.0)
        # a hair of the slip's direction stands in where nothing moves yet
        across = [forwards * part + HAIR * hair for part, hair in zip(across, slip, strict=True)]
        # and its derivatives are none: a choice between equals, which the compiler drops where nothing is differentiated
        moving = norm(stacked(across)) > 2 * HAIR
        across = [jnp.where(moving, part, lax.stop_gradient(part)) for part in across]
        speed = norm(stacked(across))
        return across, jnp.where(speed > 0, speed, 1.0)


class Held(NamedTuple):
    """What is decided at the start of a step, as arrays: all that a branch may return."""

    state: Particles
    since: tuple[Array, ...]
    pressed: tuple[Array, ...]
    slip: tuple[Array | None, ...]
    still: Array


def hold(scene: Scene, surfaces: tuple, since: tuple, t: Time, dt: ArrayLike) -> Held:
    """What carries each lane through the coming step; `since` [s] is when it began to touch each surface (infinite: never)."""
    flag = jnp.isfinite(jnp.stack(since))
    unheld = lax.stop_gradient(apart(flag, lambda: scene.acceleration(t, scene.state), scene.state.velocity))
    t, kick = now(t), dot(unheld, unheld) * (dt * dt)
    touching = [
        jnp.isfinite(moment) & _is_close(surface, scene.state, kick, t, dt)
        for surface, moment in zip(surfaces, since, strict=True)
    ]
    masks = [touch.astype(scene.state.dtype) for touch in touching]
    at = lax.stop_gradient(_put_back(surfaces, masks, t, scene.state, flag))

    def look():
        speed = dot(scene.state.velocity, scene.state.velocity) + kick
        return [_contact(s, t, at, mask, speed) for s, mask in zip(surfaces, masks, strict=True)]

    contacts, unheld = lax.stop_gradient(apart(flag, look)), components(unheld)
    pressed, still, slip = apart(flag, lambda: _decided(surfaces, contacts, unheld, touching))
    since = tuple(jnp.where(p > 0, s, jnp.inf) for p, s in zip(pressed, since, strict=True))
    # what stands still on a surface that does too keeps its place to the last bit: nothing creeps
    moves = [p * (1 - still) if s.velocity is None else p for p, s in zip(pressed, surfaces, strict=True)]
    x, v = _put_back(surfaces, moves, t, scene.state, flag)
    for surface, p in zip(surfaces, pressed, strict=True):
        v = v - scale(still * p, surface.relative(v))
    return Held(Particles(x, v), since, pressed, slip, still)


def _decided(surfaces: tuple, contacts: list["_Contact"], unheld: list[Array], touching: list[Array]) -> tuple:
    """Which surfaces press on each lane, which lanes stay still, and which way the others slip."""
    acceleration, normal_force = _settle(contacts, unheld)
    pressed = [
        touch & ~((force <= 0) & (_dot(acceleration, contact.normal) + contact.bend > 0))
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
        slip.append(None if surface.coulomb is None else scale(p * (1 - still), unit(stacked(way))))
    return pressed, still, tuple(slip)


def nothing_held(scene: Scene, surfaces: tuple, since: tuple) -> Held:
    """What `hold` returns where no lane touches anything."""
    nothing, nowhere = jnp.zeros(scene.state.lanes, scene.state.dtype), jnp.zeros_like(scene.state.velocity)
    slip = tuple(None if surface.coulomb is None else nowhere for surface in surfaces)
    return Held(scene.state, since, tuple(nothing for _ in surfaces), slip, nothing)


def carried(scene: Scene, surfaces: tuple, held: Held) -> Scene:
    """The scene with the lanes held as decided, ready for a step."""
    anywhere = any_lane(jnp.any(jnp.stack(held.pressed) > 0, axis=0))
    reaction = Reaction(surfaces, held.pressed, held.slip, held.still, _places(held), anywhere)
    return scene.having(state=held.state, reaction=reaction)


def _places(held: Held) -> tuple | None:
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


def _picked(place: tuple, felt: list[tuple]) -> tuple:
    """How the surface in one place feels: of normal, bend and reaction those of the lane's own surface."""
    pick = lambda *values: sum(share * value for share, value in zip(place, values, strict=True))  # noqa: E731
    return jax.tree.map(pick, *felt)


def _normal_forces(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """The N >= 0 with Σ_j W_ij N_j = w_i of the surfaces that press; one that would have to pull lets go."""
    forces = _solved(weights, wanted, presses)
    if len(forces) > 1:
        forces = _solved(
            weights, wanted, [jnp.where(force > 0, p, 0.0) for p, force in zip(presses, forces, strict=True)]
        )
    return [jnp.maximum(force, 0.0) for force in forces]


def _solved(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """Gaussian elimination, lane by lane, over those that press."""
    rows, right, inverse = [list(row) for row in weights], list(wanted), []
    for i, press in enumerate(presses):
        usable = (press > 0) & (rows[i][i] > PARALLEL)
        inverse.append(jnp.where(usable, 1.0 / jnp.where(usable, rows[i][i], 1.0), 0.0))
        for j in range(i + 1, len(rows)):
            share = rows[j][i] * inverse[i]
            rows[j] = _plus(rows[j], -share, rows[i])
            right[j] = right[j] - share * right[i]
    forces = [None] * len(rows)
    for i in reversed(range(len(rows))):
        known = sum(rows[i][k] * forces[k] for k in range(i + 1, len(rows)))
        forces[i] = (right[i] - known) * inverse[i]
    return forces


class _Contact(NamedTuple):
    """A surface as a lane feels it: normal, bend, tangential velocity, and what friction can hold.

    The lane stands `still` where that velocity is rounding. Vectors are lists of components.
    """

    touching: Array
    normal: list[Array]
    bend: Array
    across: list[Array]
    still: Bool[Array, "*lanes"]
    limit: Array | None


def _contact(surface: eqx.Module, t: ArrayLike, state: Particles, touching: Array, speed_squared: Array) -> _Contact:
    """How a surface feels; what is slower than rounding of the speeds that a step deals with stands still."""
    outward, relative = surface.outward(t, state.position), surface.relative(state.velocity)
    normal, across = components(outward), components(relative)
    across = _plus(across, -_dot(across, normal), normal)
    rounding = 16 * float(jnp.finfo(state.dtype).eps)
    still = _dot(across, across) <= rounding**2 * speed_squared
    limit = None if surface.coulomb is None else surface.coulomb.static
    if surface.friction is not None:
        # every one of the endless bounces takes its part of the tangential velocity: nothing is left
        limit = jnp.where(surface.friction > 0, ENOUGH, 0.0).astype(state.dtype)
    return _Contact(touching, normal, surface.bend(t, state.position, relative), across, still, limit)


def _settle(contacts: list[_Contact], acceleration: list[Array]) -> tuple[list[Array], list[Array]]:
    """The acceleration that is left under normal forces and static friction, and the normal forces (projected Gauss-Seidel)."""

    def sweep(forces):
        total, normal_force, friction = forces
        normal_force, friction = list(normal_force), list(friction)
        for i, c in enumerate(contacts):
            now = c.touching * jnp.maximum(normal_force[i] - _dot(total, c.normal) - c.bend, 0.0)
            total = _plus(total, now - normal_force[i], c.normal)
            normal_force[i] = now
            if c.limit is not None:
                along = _plus(total, -_dot(total, c.normal), c.normal)
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

    return loop(settling, pass_, (forces, rounding >= 0), most=SETTLING)[0][:2]


def _is_close(surface: eqx.Module, state: Particles, kick: Array, t: ArrayLike, dt: ArrayLike) -> Array:
    """Whether a lane is still where a step along the surface can have left it; a state set by hand need not be."""
    x, v = state
    relative = surface.relative(v)
    reach = 0.1 * dt * (jnp.sqrt(dot(relative, relative)) + jnp.sqrt(dot(v, v)))
    rounding = 64 * float(jnp.finfo(state.dtype).eps) * (jnp.sqrt(dot(x, x)) + dt * jnp.sqrt(kick))
    return jnp.abs(surface.gap(t, x)) <= reach + rounding


def _put_back(surfaces: tuple, touching: list, t: ArrayLike, state: Particles, flag: Array) -> Particles:
    """Onto the surfaces and along them: what the truncation of the last step left over is taken away."""
    for surface, touch in zip(surfaces, touching, strict=True):
        state = apart(flag, partial(_put_back_on, surface, touch, t, state), state)
    return state


def _put_back_on(surface: eqx.Module, touch: Array, t: ArrayLike, state: Particles) -> Particles:
    x, v = state
    normal = surface.outward(t, x)
    x = x - scale(touch * surface.gap(t, x), normal)
    v = v - scale(touch * dot(surface.relative(v), normal), normal)
    if surface.friction is not None:
        v = v - scale(jnp.where(surface.friction > 0, touch, 0.0), surface.relative(v))
    return Particles(x, v)


def _dot(a: list[Array], b: list[Array]) -> Array:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _plus(a: list[Array], factor: Array, b: list[Array]) -> list[Array]:
    return [x + factor * y for x, y in zip(a, b, strict=True)]
