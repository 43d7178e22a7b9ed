"""Collisions of rigid balls with each other: every pair, one after the other, at the end of a step."""

from itertools import combinations
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import any_lane
from physjax.checks import Numbers, concrete_or_none, demand_start_outside, quantity
from physjax.parts import Contact
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import RigidBodies
from physjax.vectors import cross, dot, norm, scale, unit

MAX_PAIR_PASSES = 16
"""Most passes over all pairs in a step: an impulse can go through a row of this many balls."""
MAX_BALLS = 64
"""Most balls in one scene: their n(n - 1)/2 pairs are visited one by one."""
EQUAL_MOMENTS_SHARE = 1e-6
"""Share by which the principal moments of a ball may differ."""


class Balls(Contact):
    """Balls that may not pass each other: restitution K_r, and Coulomb's friction, which makes them spin.

    For every pair in the last lane axis that overlaps and approaches, u' = -K_r u along the line of centers; across it
    the impulse is at most μ_k times the normal one, and at most what stops the slip. Between balls the two do not act on
    each other, so that this never adds energy. Momentum is conserved. Overlap is then removed about the common center of
    mass. First order in dt, with one step for all balls: take steps in which no ball moves more than a part of its
    radius. At most 64 balls; no stacks.

    Example:
        >>> marble = inertia.sphere(1.0, 0.5)
        >>> row = rigid.bodies(marble, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], velocity=[[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        >>> hit = Scene(row, marble, contacts=(rigid.Balls(0.5),)).step(methods.euler, 0.0, 0.01)
        >>> print(hit.state.momentum[:, 0])
        [0. 2.]
    """

    couples: ClassVar[bool] = True
    radius: Numbers = quantity("radius", "m", above=0)
    restitution: Numbers = quantity("restitution K_r", "1", at_least=0, at_most=1, default=1.0)
    coulomb: Coulomb | None = None

    def demand_fit(self, state: object, mass: object) -> None:
        """Raise a TypeError unless the state is of rigid bodies, a ValueError unless they are balls next to each other."""
        if not isinstance(state, RigidBodies) or not isinstance(mass, Inertia):
            raise TypeError(f"Balls: got a state of type {type(state).__name__}, expected RigidBodies.")
        if len(state.lanes) < 1 or not 2 <= state.lanes[-1] <= MAX_BALLS:
            raise ValueError(f"Balls: got lanes {state.lanes}, expected 2 to {MAX_BALLS} balls in the last axis.")
        demand_start_outside(self, state)
        moments = concrete_or_none(mass.principal)
        if moments is not None and np.ptp(moments, axis=-1).max() > EQUAL_MOMENTS_SHARE * moments.max():
            raise ValueError("Balls: got bodies with different principal moments, expected inertia.sphere.")

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes"]:
        """Distance of each ball to its nearest neighbour [m]."""
        # all n² distances: with at most 64 balls that is less work than finding neighbours
        apart = norm(position[..., :, None, :] - position[..., None, :, :])
        radius = jnp.broadcast_to(self.radius, position.shape[:-1])
        apart = apart - radius[..., :, None] - radius[..., None, :]
        itself = jnp.broadcast_to(jnp.eye(position.shape[-2], dtype=bool), apart.shape)
        return jnp.min(jnp.where(itself, jnp.inf, apart), axis=-1)

    def respond(self, t: ArrayLike, state: RigidBodies) -> RigidBodies:
        """The balls unchanged: a collision needs their masses; see `resolve`."""
        return state

    def resolve(self, t: ArrayLike, state: RigidBodies, mass: Inertia) -> RigidBodies:
        """The balls after all collisions of a step."""

        def sweep(state: RigidBodies) -> RigidBodies:
            after, _ = lax.scan(
                lambda state, pair: (self._resolve_pair(state, mass, pair), None), state, self._build_pair_masks(state)
            )
            return after

        # a scan of fixed length and not a while loop, so that reverse mode goes through; idle passes cost a branch
        def go_on(carry: tuple[RigidBodies, Array], _) -> tuple[tuple[RigidBodies, Array], None]:
            state, going = carry
            after = lax.cond(any_lane(going), sweep, lambda state: state, state)
            changed = jnp.any(after.momentum != state.momentum) | jnp.any(after.position != state.position)
            return (after, changed), None

        return lax.scan(go_on, (state, jnp.any(self.signed_distance(t, state.position) < 0)), length=MAX_PAIR_PASSES)[
            0
        ][0]

    def _build_pair_masks(self, state: RigidBodies) -> Array:
        """Of each pair, which lanes its two balls are in: `(pairs, 2, nodes)`, ones and zeros."""
        nodes = state.lanes[-1]
        return jnp.asarray(np.eye(nodes)[list(combinations(range(nodes), 2))], state.dtype)

    def _resolve_pair(self, state: RigidBodies, mass: Inertia, pair: Array) -> RigidBodies:
        """The balls after the collision of one pair, if there is one.

        The pair is picked, and written back, by products with its mask: a gather by index in a scan would be a scatter
        in reverse mode.
        """
        x, _, p, spin = state
        ends = [end.reshape((1,) * (x.ndim - 2) + end.shape) for end in pair]
        own = lambda number: [  # noqa: E731
            jnp.sum(end * jnp.broadcast_to(number, state.lanes), axis=-1) for end in ends
        ]
        of = lambda vector: [jnp.sum(end[..., None] * vector, axis=-2) for end in ends]  # noqa: E731
        radius, restitution = own(self.radius), sum(own(self.restitution)) / 2
        inverse_masses, inverse_inertias = own(1 / mass.mass), own(mass.inverse[..., 0])
        (a, b), (pa, pb), (sa, sb) = of(x), of(p), of(spin)
        line, normal = b - a, unit(b - a)
        depth = jnp.minimum(norm(line) - radius[0] - radius[1], 0.0)
        arms = [scale(radius[0], normal), scale(-radius[1], normal)]
        speeds = [
            scale(w, momentum) + cross(scale(i, s), arm)
            for w, momentum, i, s, arm in zip(inverse_masses, (pa, pb), inverse_inertias, (sa, sb), arms, strict=True)
        ]
        u = speeds[1] - speeds[0]
        inward = jnp.where(depth < 0, jnp.minimum(dot(u, normal), 0.0), 0.0)
        mobility = inverse_masses[0] + inverse_masses[1]
        push = -(1 + restitution) * inward / mobility
        impulse = scale(push, normal)
        if self.coulomb is not None:
            slip = u - scale(dot(u, normal), normal)
            size = norm(slip)
            # across the normal balls also turn, which makes them easier to move
            across = mobility + inverse_inertias[0] * radius[0] ** 2 + inverse_inertias[1] * radius[1] ** 2
            most = sum(own(self.coulomb.kinetic)) / 2 * push
            share = jnp.where(size > across * most, most / jnp.where(size > 0, size, 1.0), 1 / across)
            impulse = impulse - scale(jnp.where(inward < 0, share, 0.0), slip)
        # each ball takes the share of the overlap that the other's mass has, which keeps the center of mass
        for end, arm, sign, w in zip(ends, arms, (-1.0, 1.0), inverse_masses, strict=True):
            give = lambda vector, end=end: end[..., None] * vector[..., None, :]  # noqa: E731
            p = p + sign * give(impulse)
            spin = spin + sign * give(cross(arm, impulse))
            x = x - sign * give(scale(depth * w / mobility, normal))
        return RigidBodies(x, state.orientation, p, spin)
