"""Damped springs between pairs of nodes, of which ropes, cloth, jelly and bridges are made."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.checks import NestedArrayLike, as_positive_integer, as_real_quantity, unchecked_quantity
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics.springs.jacobian import LinearisedSlot, LinearisedSprings, product, spring_jacobian_coefficients
from physjax.physics.springs.topology import SpringTopology
from physjax.vectors import AnyArray, add_leading_axes, dot, norm, square_root, unit


class Springs(Force):
    """Damped springs between pairs of nodes: F = -(k (l - L) + c l̇) along the line between the ends, equal and opposite.

    `pairs` `(springs, 2)` are indices into the last lane axis. Stiffness k [N/m], rest length L [m] and damping c
    [kg/s] are numbers for all springs or one each, `(springs,)`; leading axes of scenes make a sweep of them. Coinciding
    ends have no line between them and no force. With `breaks_at`, a strain (l - L)/L, a spring that is stretched beyond it
    breaks for good, and a run records which are `unbroken`. With `yields_at`, a strain ε, springs are perfectly plastic
    (Prandtl's model): the elastic force goes no further than ±k ε L, and how far a spring is strained beyond that stays as
    its `permanent_set` [m], which is added to the length at rest and recorded too. Both strains are of the L that was given.
    With `tension_only` they are ropes, which pull where they are longer than L and are slack where they are not (and yield
    only when stretched). `nodes` is the number of nodes, if the pairs do not name the last. `layout` is "bands" (shifted
    slices, for lattices) or "gather" (for meshes), by default the faster. Raises ValueError or TypeError for pairs that are
    not pairs of different nodes, numbers < 0 and shapes that do not match.

    Example:
        >>> ends = Particles(jnp.array([[0.0, 0.0], [1.5, 0.0]]), jnp.zeros((2, 2)))
        >>> spring = springs.Springs([[0, 1]], stiffness=10.0, rest_length=1.0)
        >>> print(spring(0.0, ends, 1.0)[:, 0])
        [ 5. -5.]
        >>> bumper = springs.Springs([[0, 1]], stiffness=10.0, rest_length=1.0, yields_at=0.2)
        >>> bent, _ = bumper.advance(0.0, 0.1, ends)
        >>> print(bumper.tension(ends), bent.permanent_set)
        [2.] [0.3]
    """

    couples: ClassVar[bool] = True
    dissipative_symmetric: ClassVar[bool] = True
    topology: SpringTopology = eqx.field(static=True)
    k: Float[Array, "..."] = unchecked_quantity("stiffness", "N/m", per="spring", at_least=0)
    L: Float[Array, "..."] = unchecked_quantity("rest length", "m", per="spring", at_least=0)
    c: Float[Array, "..."] | None = unchecked_quantity("damping", "kg/s", per="spring", at_least=0)
    limit: Float[Array, "..."] | None = unchecked_quantity("breaks_at", per="spring", at_least=0)
    intact: Bool[Array, "..."] | None = unchecked_quantity("unbroken", per="spring")
    yield_strain: Float[Array, "..."] | None = unchecked_quantity("yields_at", per="spring", at_least=0)
    plastic: Float[Array, "..."] | None = unchecked_quantity("permanent set", "m", per="spring")
    tension_only: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        pairs: NestedArrayLike,
        stiffness: NestedArrayLike,
        rest_length: NestedArrayLike,
        damping: NestedArrayLike | None = None,
        breaks_at: NestedArrayLike | None = None,
        *,
        nodes: int | None = None,
        layout: str | None = None,
        tension_only: bool = False,
        yields_at: NestedArrayLike | None = None,
    ):
        self.tension_only = tension_only
        self.topology = SpringTopology(pairs, None if nodes is None else as_positive_integer("nodes", nodes), layout)
        self.k = self._lay_out("stiffness [N/m]", stiffness)
        self.L = self._lay_out("rest length [m]", rest_length)  # pyright: ignore[reportConstantRedefinition]  # a length
        self.c = None if damping is None else self._lay_out("damping [kg/s]", damping)
        self.limit = None if breaks_at is None else self._lay_out("breaks_at [1]", breaks_at)
        self.yield_strain = None if yields_at is None else self._lay_out("yields_at [1]", yields_at)
        numbers = [a for a in (self.k, self.L, self.limit, self.yield_strain) if a is not None]
        shape = (*jnp.broadcast_shapes(*(a.shape[:-2] for a in numbers)), *self.topology.present.shape)
        self.intact = None if self.limit is None else jnp.broadcast_to(self.topology.present, shape)
        self.plastic = None if self.yield_strain is None else jnp.zeros(shape, jnp.result_type(*numbers))

    @property
    def pairs(self) -> np.ndarray:
        """The two nodes of each spring, `(springs, 2)`."""
        return self.topology.pairs

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return self.topology.nodes

    @property
    def layout(self) -> str:
        """How neighbours are read: "bands" or "gather"."""
        return self.topology.layout

    @property
    def stiffness(self) -> Float[Array, "..."]:
        """k [N/m], as given: for all springs or one each. In a gradient, the derivative by it."""
        return self.topology.collect(self.k)

    @property
    def rest_length(self) -> Float[Array, "..."]:
        """L [m], as given."""
        return self.topology.collect(self.L)

    @property
    def damping(self) -> Float[Array, "..."] | None:
        """c [kg/s], as given."""
        return None if self.c is None else self.topology.collect(self.c)

    @property
    def breaks_at(self) -> Float[Array, "..."] | None:
        """The strain beyond which a spring breaks [1], as given."""
        return None if self.limit is None else self.topology.collect(self.limit)

    @property
    def unbroken(self) -> Bool[Array, "*scenes springs"] | None:
        """Which springs are unbroken; None for springs that cannot break."""
        return None if self.intact is None else self.topology.collect(self.intact)

    @property
    def yields_at(self) -> Float[Array, "..."] | None:
        """The strain beyond which a spring yields [1], as given."""
        return None if self.yield_strain is None else self.topology.collect(self.yield_strain)

    @property
    def permanent_set(self) -> Float[Array, "*scenes springs"] | None:
        """How much longer than L each spring is at rest [m], < 0 if it was crushed; None for springs that cannot yield."""
        return None if self.plastic is None else self.topology.collect(self.plastic)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes dim"]:
        """Σ (k (1 - L/l) + c (d·ḋ)/l²) d over the springs of each node, d to the other end [N]."""
        self._demand_nodes(state)
        topology, c = self.topology, self.c
        edges, parts = topology.differences(*(state[:1] if c is None else state))
        weights = []
        for slot, d in enumerate(parts[0]):
            k, L = self._take_slot(slot, self.k, d), self._take_rest_length(slot, d)
            square = product(d, d)
            apart = jnp.where(square > 0, square, 1.0)  # ends that coincide: no division by 0, also in derivatives
            # (k (1 - L/l) + c (d·ḋ)/l²) l², so that one division by l² remains
            if self.yield_strain is None:
                pull = k * (apart - L * square_root(square))
            else:
                length = square_root(square)
                pull = k * length * self._limit_stretch(slot, length - L, d)
            if c is not None:
                pull = pull + self._take_slot(slot, c, d) * product(d, parts[1][slot])
            if self.tension_only:
                pull = jnp.where(square > L * L, jnp.maximum(pull, 0.0), 0.0)
            # the division comes last because older compilers materialise a division by themselves
            weights.append(jnp.where(self._take_unbroken(slot, d), pull, 0.0) / apart)
        near = topology.neighbours
        return topology.resultant([near.scale_edges(w, e) for w, e in zip(near.store(weights), edges, strict=True)])

    def linearised_at(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> LinearisedSprings:
        """The springs linearised at a state, with a negative semidefinite Jacobian, as an implicit step uses them.

        What yields has the stiffness with which it would come back.
        """
        springs = []
        edges, (parts,) = self.topology.differences(state.position)
        for slot, (edge, d) in enumerate(zip(edges, parts, strict=True)):
            square = product(d, d)
            apart = jnp.where(square > 0, square, 1.0)
            L, unbroken = self._take_rest_length(slot, d), self._take_unbroken(slot, d)
            if self.tension_only:
                unbroken = unbroken & (square > L * L)
            k = jnp.where(unbroken, self._take_slot(slot, self.k, d), 0.0)
            g, h = spring_jacobian_coefficients(k, L * square_root(square) / apart, apart)
            gamma = None if self.c is None else jnp.where(unbroken, self._take_slot(slot, self.c, d), 0.0) / apart
            springs.append(LinearisedSlot(edge, d, g, h, gamma))
        return LinearisedSprings(self.topology, state, self(to_float_time(t), state, mass), springs)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes"]:
        """½k(l - L)² [J], half of it at each end, zero where a rope is slack."""
        self._demand_nodes(state)
        energies = []
        for slot, d in enumerate(self.topology.parts(state.position)):
            stretch = square_root(product(d, d)) - self._take_rest_length(slot, d)
            if self.tension_only:
                stretch = jnp.maximum(stretch, 0.0)
            # the work of a force that is constant beyond the yield: it becomes heat when the memory advances
            elastic = self._limit_stretch(slot, stretch, d)
            energy = 0.25 * self._take_slot(slot, self.k, d) * elastic * (2 * stretch - elastic)
            energies.append(jnp.where(self._take_unbroken(slot, d), energy, 0.0))
        return self.topology.neighbours.sum_at_both_ends(energies)

    @property
    def remembers(self) -> bool:
        """Whether springs can break or yield."""
        return self.limit is not None or self.yield_strain is not None

    def advance(self, t: ArrayLike, dt: ArrayLike, state: Particles) -> tuple["Springs", Particles]:
        """The springs without those stretched beyond `breaks_at`, which stay broken, and with the set of those that yielded."""
        if not self.remembers:
            return self, state
        self._demand_nodes(state)
        held, sets = [], []
        for slot, d in enumerate(self.topology.parts(state.position)):
            L, square, unbroken = self._take_slot(slot, self.L, d), product(d, d), self._take_unbroken(slot, d)
            if self.limit is not None:
                unbroken = unbroken & (square <= (L * (1 + self._take_slot(slot, self.limit, d))) ** 2)
                held.append(unbroken)
            if self.yield_strain is not None and self.plastic is not None:
                most, before = L * self._take_slot(slot, self.yield_strain, d), self._take_slot(slot, self.plastic, d)
                stretch = square_root(square) - L
                after = jnp.maximum(before, stretch - most)
                if not self.tension_only:
                    after = jnp.minimum(after, stretch + most)
                sets.append(jnp.where(unbroken, after, before))
        after = self
        if self.intact is not None and held:
            intact = self._stack_memory("breaks_at", self.intact, held, state)
            after = eqx.tree_at(lambda springs: springs.intact, after, intact)
        if self.plastic is not None:
            plastic = self._stack_memory("yields_at", self.plastic, sets, state)
            after = eqx.tree_at(lambda springs: springs.plastic, after, plastic)
        return after, state

    def _stack_memory(self, name: str, before: Array, slots: list[Array], state: Particles) -> Array:
        """What springs remember, from its slots; a ValueError where it was given for other scenes than those of the state."""
        memory = self.topology.neighbours.stack_slots(slots)
        if memory.shape != before.shape:
            raise ValueError(
                f"Springs: got positions of shape {state.position.shape} and {name} for the scenes {before.shape[:-2]}; "
                f"expected a strain for each scene: give {name} the shape (*scenes, 1)."
            )
        return memory

    def cut(self, where: NestedArrayLike) -> "Springs":
        """The springs without some, for good: a mask `(springs,)`, or `(*scenes, springs)` for a sweep of cuts.

        Go on with them from where a run ended: `scene = run.final_scene`, whose forces are replaced. Programs stay as they
        are, since the springs keep their places. Raises ValueError for a mask that does not fit.

        Example:
            >>> chain = springs.Springs([[0, 1], [1, 2]], stiffness=10.0, rest_length=1.0)
            >>> hanging = Particles(jnp.array([[0.0, 0.0], [0.0, -2.0], [0.0, -4.0]]), jnp.zeros((3, 2)))
            >>> print(chain.cut([False, True]).tension(hanging))
            [10.  0.]
        """
        mask = jnp.asarray(where)
        if mask.dtype != bool or mask.shape[-1:] != (len(self.pairs),):
            raise ValueError(
                f"cut: got {mask.dtype} of shape {mask.shape}, expected a mask, booleans of shape ({len(self.pairs)},): one "
                "for each spring."
            )
        held = self.topology.spread(~mask)  # what is in no slot is spread as False
        if self.intact is not None:
            shape = jnp.broadcast_shapes(held.shape, self.intact.shape)
            held = jnp.broadcast_to(held, shape) & jnp.broadcast_to(self.intact, shape)
        return eqx.tree_at(lambda springs: springs.intact, self, held, is_leaf=lambda leaf: leaf is None)

    def length(self, state: Particles) -> Float[Array, "*scenes springs"]:
        """Length l of each spring [m]."""
        return norm(self._edge_vectors(state.position))

    def strain(self, state: Particles) -> Float[Array, "*scenes springs"]:
        """Strain (l - L)/L of each spring [1], its permanent set included; infinite for a spring of zero rest length."""
        length = self.length(state)
        rest_length = add_leading_axes(self.rest_length, length.ndim)
        return (length - rest_length) / rest_length

    def tension(self, state: Particles) -> Float[Array, "*scenes springs"]:
        """k (l - L) + c l̇ of each spring [N]: positive when it pulls, zero when it is broken, or a rope that is slack."""
        stretch, elastic = self._measure_stretch(state)
        tension = add_leading_axes(self.stiffness, stretch.ndim) * elastic
        if self.damping is not None:
            rate = dot(unit(self._edge_vectors(state.position)), self._edge_vectors(state.velocity))
            tension = tension + add_leading_axes(self.damping, stretch.ndim) * rate
        if self.tension_only:
            tension = jnp.where(stretch > 0, jnp.maximum(tension, 0.0), 0.0)
        return self._zero_broken(tension)

    def energy(self, state: Particles) -> Float[Array, "*scenes springs"]:
        """½k(l - L)² of each spring [J], zero when it is broken, or a rope that is slack."""
        stretch, elastic = self._measure_stretch(state)
        if self.tension_only:
            elastic = jnp.maximum(elastic, 0.0)
        return self._zero_broken(0.5 * add_leading_axes(self.stiffness, stretch.ndim) * elastic * elastic)

    def _measure_stretch(self, state: Particles) -> tuple[Array, Array]:
        """How much longer each spring is than at rest [m], and how much of it is elastic."""
        length = self.length(state)
        rest_length = add_leading_axes(self.rest_length, length.ndim)
        if self.permanent_set is None or self.yields_at is None:
            return length - rest_length, length - rest_length
        stretch = length - rest_length - add_leading_axes(self.permanent_set, length.ndim)
        most = rest_length * add_leading_axes(self.yields_at, length.ndim)
        return stretch, jnp.clip(stretch, -most, most)

    def _take_rest_length(self, slot: int, like: list[Array]) -> Array:
        """L of the springs in a slot, with their permanent set [m]."""
        L = self._take_slot(slot, self.L, like)
        return L if self.plastic is None else L + self._take_slot(slot, self.plastic, like)

    def _limit_stretch(self, slot: int, stretch: Array, like: list[Array]) -> Array:
        """The elastic part of how much the springs in a slot are stretched [m]."""
        if self.yield_strain is None:
            return stretch
        most = self._take_slot(slot, self.L, like) * self._take_slot(slot, self.yield_strain, like)
        return jnp.clip(stretch, -most, most)

    def _take_unbroken(self, slot: int, like: list[Array]) -> Array | np.ndarray:
        """Mask of the unbroken springs of a slot, with as many axes as the components `like`."""
        if self.intact is not None:
            return self._take_slot(slot, self.intact, like)
        present = self.topology.neighbours.at(self.topology.present, slot)  # NumPy's: a constant of the program
        return add_leading_axes(present, like[0].ndim)

    def _take_slot(self, slot: int, number: AnyArray, like: list[Array]) -> AnyArray:
        """A number of the springs in a slot, `()` or with as many axes as the components `like` it is combined with."""
        if number.ndim == 0:
            return number
        each = number.shape[-2:] == self.topology.present.shape
        number = self.topology.neighbours.at(number, slot) if each else number[..., 0, :]
        return add_leading_axes(number, like[0].ndim)

    def _zero_broken(self, number: Array) -> Array:
        """A number per spring, zero where a spring is broken."""
        unbroken = self.unbroken
        return number if unbroken is None else number * add_leading_axes(unbroken, number.ndim).astype(number.dtype)

    def _edge_vectors(self, a: Array) -> Array:
        """The vector at the second end of each spring minus that at the first, `(*scenes, springs, dim)`."""
        first, second = self.topology.ends(a)
        return second - first

    def _lay_out(self, name: str, value: NestedArrayLike) -> Array:
        """A number per spring or for all, checked, in slots."""
        number = as_real_quantity(name, value, at_least=0)
        springs = len(self.topology.pairs)
        if number.ndim and number.shape[-1] != springs and (number.ndim == 1 or number.shape[-1] != 1):
            raise ValueError(
                f"{name}: got shape {number.shape}, expected () for all springs or ({springs},), one each; swept over "
                f"scenes, (*scenes, {springs}) or (*scenes, 1)."
            )
        return self.topology.spread(number)

    def prepare(self, state: PyTree, mass: PyTree) -> "Springs":
        """The springs as part of a scene, whose nodes they must join."""
        if isinstance(state, Particles):
            self._demand_nodes(state)
        return self

    def _demand_nodes(self, state: Particles) -> None:
        """Raise a ValueError for a state with another number of nodes."""
        if state.lanes[-1:] != (self.nodes,):
            raise ValueError(
                f"Springs: got positions of shape {state.position.shape}, expected (*scenes, {self.nodes}, dim): the "
                f"pairs join {self.nodes} nodes. If the scene has more, give Springs(..., nodes=)."
            )
