"""Particles that are born and die: a fixed pool whose births are a closed form of slot and generation.

The slots of the pool are born one after another, and again from the first on; birth number n = generation·pool + slot has
its own moment, and its own numbers, drawn from the key folded with slot and generation. So nothing is accumulated: the
film depends on the key alone, not on the step, the batch, or where the run was cut and resumed.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt32

from physjax.backend import compact_and_apply_runs, materialise
from physjax.checks import (
    as_positive_integer,
    concrete_or_none,
    demand_all,
    demand_direction,
    quantity,
    unchecked_quantity,
)
from physjax.loops import (
    LARGEST_SNAP_SHARE,
    Moment,
    Time,
    cast_remainder,
    exact_multiple,
    exact_quotient,
    exact_sum,
    float32_remainder,
    force_rounding,
    to_float_time,
)
from physjax.particles import Particles, demand_particles
from physjax.parts import ParticleSource
from physjax.physics.emitters.appearance import Appearance, Look
from physjax.physics.emitters.shapes import Source, direction_in_cone, unit_direction
from physjax.vectors import broadcast_vector, components, scale, stack_components

_DRAWS_PER_BIRTH = 8
"""Uniform numbers of a birth: three for the place, two for the direction, then speed, life and size."""


class Birth(NamedTuple):
    """What is fixed when a particle is born: the moment [s], its life [s] and size [m], place [m] and velocity [m/s].

    Example:
        >>> first = fountain.births(slot=jnp.array([0]), generation=jnp.array([0]))
        >>> isinstance(first, emitters.Birth), first.velocity.tolist()
        (True, [[0.0, 5.0]])
    """

    time: Float[Array, "*births"]
    life: Float[Array, "*births"]
    size: Float[Array, "*births"]
    position: Float[Array, "*births dim"]
    velocity: Float[Array, "*births dim"]


class Emitter(ParticleSource):
    """A pool of particles born from a source: `Scene(emitter.unborn(), ..., emitter=emitter)`.

    Births come one by one at a `rate` [1/s], or in bursts of `burst` particles (of the whole pool by default) `every` so
    many seconds, from the time `start` on; with neither, once. A particle leaves with `speed` [m/s] in a direction
    within the half-angle `cone` [rad] about `direction`, by default about the way out of the source, and lives for
    `life` [s]. Of speed, life and size [m] each particle has its own, even within mean·(1 ± spread). `key` is a seed or a
    `jax.random.key`. With `opposed`, bursts are of pairs: the second leaves like the first, the other way round, so that
    their momentum is zero.

    Every number but the counts can be swept and differentiated (births at fixed generations). A slot that is needed
    again before its particle has died is an error that names the pool needed; with `drop_oldest` the oldest makes way.
    Moments are counted, and kept with what rounding to the state's type leaves out of them, so that a day later births
    still come one by one; after 2³¹ births the particles are not a number any more.
    Raises ValueError or TypeError for numbers out of range.

    Example:
        >>> fountain = emitters.Emitter(8, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=5.0, rate=4.0)
        >>> print(fountain.birth_time(slot=jnp.array([0, 1, 2]), generation=jnp.array([0, 0, 1])))
        [0.   0.25 2.5 ]
    """

    memory: ClassVar[tuple[str, ...]] = ("generation", "born", "born_rest", "dies", "dies_rest")

    pool: int = eqx.field(static=True, converter=lambda value: as_positive_integer("pool", value))
    source: Source
    key: UInt32[Array, "words"] = unchecked_quantity(
        "key", per=None, converter=lambda key: _read_key(key), kw_only=True
    )
    life: Float[Array, ""] = quantity("life", "s", per=None, above=0, kw_only=True)
    speed: Float[Array, ""] = quantity("speed", "m/s", per=None, default=0.0, kw_only=True)
    rate: Float[Array, ""] | None = quantity("rate", "1/s", per=None, above=0, default=None, kw_only=True)
    every: Float[Array, ""] | None = quantity("time between bursts", "s", per=None, above=0, default=None, kw_only=True)
    burst: int | None = eqx.field(static=True, default=None, kw_only=True)
    start: Float[Array, ""] = quantity("start", "s", per=None, default=0.0, kw_only=True)
    direction: Float[Array, "dim"] | None = quantity(
        "direction", "1", kind="vector", per=None, default=None, kw_only=True
    )
    cone: Float[Array, ""] = quantity(
        "half-angle of the cone", "rad", per=None, at_least=0, at_most=3.1416, default=0.0, kw_only=True
    )
    size: Float[Array, ""] = quantity("size", "m", per=None, above=0, default=0.01, kw_only=True)
    speed_spread: Float[Array, ""] = quantity(
        "spread of the speed", "1", per=None, at_least=0, default=0.0, kw_only=True
    )
    life_spread: Float[Array, ""] = quantity("spread of the life", "1", per=None, at_least=0, default=0.0, kw_only=True)
    size_spread: Float[Array, ""] = quantity("spread of the size", "1", per=None, at_least=0, default=0.0, kw_only=True)
    look: Look = eqx.field(default_factory=Look, kw_only=True)
    opposed: bool = eqx.field(static=True, default=False, kw_only=True)
    drop_oldest: bool = eqx.field(static=True, default=False, kw_only=True)
    slot: Int[Array, "pool"] | None = unchecked_quantity("slot", per="memory", default=None, kw_only=True)
    generation: Int[Array, "..."] | None = unchecked_quantity("generation", per="memory", default=None, kw_only=True)
    born: Float[Array, "..."] | None = unchecked_quantity("birth", "s", per="memory", default=None, kw_only=True)
    dies: Float[Array, "..."] | None = unchecked_quantity("death", "s", per="memory", default=None, kw_only=True)
    start_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of the start", "s", per=None, default=None, repr=False, kw_only=True
    )
    born_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of birth", "s", per="memory", default=None, repr=False, kw_only=True
    )
    dies_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of death", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        # an array of its own, so that lanes that are taken apart keep their numbers
        self.slot = jnp.arange(self.pool, dtype=jnp.int32)
        self.start_rest = float32_remainder(self.start, self.start_rest)

    def __check_init__(self):
        if self.rate is not None and (self.every is not None or self.burst is not None):
            raise ValueError("Emitter: got rate= and bursts (every=, burst=), expected one of them.")
        if self.burst is not None:
            if self.every is None:
                raise ValueError("burst: got a number without every=, the time between bursts [s]. Give both.")
            if self.pool % as_positive_integer("burst", self.burst):
                raise ValueError(f"burst: got {self.burst}, expected a divisor of the pool of {self.pool}.")
        if self.opposed and self._burst_size % 2:
            raise ValueError(f"opposed: got births {self._burst_size} at a time, expected bursts of an even number.")
        for name, value in (("life", self.life_spread), ("size", self.size_spread)):
            if concrete_or_none(value) is not None:
                demand_all(f"spread of the {name} [1]", value, concrete_or_none(value) < 1, "numbers from 0 to below 1")
        if self.direction is not None:
            demand_direction("direction", self.direction)
        if not self.drop_oldest:
            self._demand_room()

    def relations(self) -> tuple[Array, ...]:
        """What must hold between its numbers, also where they are traced."""
        return self.life_spread < 1, self.size_spread < 1

    def _demand_room(self):
        """Raise a ValueError where a slot is needed again before its particle has died."""
        life, spread, pace = concrete_or_none(self.life), concrete_or_none(self.life_spread), self._mean_rate
        pace = None if pace is None else concrete_or_none(pace)
        if life is None or spread is None or pace is None:
            return
        longest, burst = float(np.max(life * (1 + spread))), self._burst_size
        needed = burst * math.ceil(longest * float(np.max(pace)) / burst * (1 - 1e-6))
        if needed > self.pool:
            raise ValueError(
                f"pool: got {self.pool} slots for {float(np.max(pace)):g} births a second that live up to {longest:g} s, "
                f"expected at least {needed}. Give pool={needed}, or drop_oldest=True to let the oldest make way."
            )

    # births, as a closed form

    @property
    def _burst_size(self) -> int:
        """Particles that are born together."""
        return 1 if self.rate is not None else self.burst or self.pool

    @property
    def _mean_rate(self) -> Array | None:
        """Births a second on the long run; None where there is one burst only."""
        return self.rate if self.every is None else self._burst_size / self.every

    def birth_time(self, slot: Int[Array, "*births"], generation: Int[Array, "*births"]) -> Float[Array, "*births"]:
        """When the particle of a slot and generation is born [s]: start + n/rate, or its burst's moment."""
        return self._birth_moment(slot, generation)[0]

    def _birth_moment(self, slot: Array, generation: Array) -> tuple[Array, Array]:
        """When the particle of a slot and generation is born [s], and what rounding left out of that."""
        start, start_rest = self.start, cast_remainder(self.start, self.start_rest)
        if self._mean_rate is None:
            return jnp.broadcast_to(start, generation.shape), jnp.broadcast_to(start_rest, generation.shape)
        after, after_rest = self._burst_delay((generation * self.pool + slot) // self._burst_size)
        time, rest = exact_sum(start, after)
        return time, rest + (start_rest + after_rest)

    def _burst_delay(self, burst: Array) -> tuple[Array, Array]:
        """How long after the first a burst comes [s], and what rounding left out of that."""
        return exact_quotient(burst, self.rate) if self.every is None else exact_multiple(burst, self.every)

    def due_generation(self, t: Time) -> Int[Array, "pool"]:
        """The generation that each slot has been born in by a time [s]; -1 where it has not been born."""
        bursts = self._find_last_burst(Moment.of(t, jnp.inf, self.start.dtype))
        last = (bursts + 1) * self._burst_size - 1
        rounds = last // self.pool
        begun = self.slot <= last - rounds * self.pool
        return rounds + begun.astype(jnp.int32) - 1

    @property
    def _last_countable_burst(self) -> int:
        """The number of the last burst whose births can be counted in 32 bits."""
        return (2**31 - 2 * self.pool) // self._burst_size - 1

    def _find_last_burst(self, t: Moment) -> Array:
        """The number of the last burst by a time, -1 before the first; one that comes later by no more than rounding is it."""
        # kept apart, or XLA on CPU would count anew for every lane
        return materialise(to_float_time(t), lambda: self._count_bursts(t))

    def _count_bursts(self, t: Moment) -> Array:
        whole, rest = t.time_since(self.start, cast_remainder(self.start, self.start_rest))
        early = jnp.minimum(2 * float(jnp.finfo(whole.dtype).eps) * jnp.abs(t.start), LARGEST_SNAP_SHARE * t.step)
        rest = rest + early
        if self._mean_rate is None:
            return jnp.where(whole + rest < 0, -1, 0).astype(jnp.int32)
        pace = self._mean_rate / self._burst_size
        guess = jnp.clip(jnp.floor(whole * pace), -1, self._last_countable_burst).astype(jnp.int32)
        after, after_rest = self._burst_delay(guess)
        more = jnp.floor(((whole - force_rounding(after)) + (rest - after_rest)) * pace)
        return jnp.clip(guess + jnp.clip(more, -1e6, 1e6).astype(jnp.int32), -1, self._last_countable_burst)

    @eqx.filter_jit  # as one program wherever it is called: one operation after the other would round otherwise
    def births(self, slot: Int[Array, "births"], generation: Int[Array, "births"]) -> Birth:
        """The births of these slots in these generations, drawn from the key folded with both."""
        u = self._draw(slot, generation)
        place, outward = self.source(u[:, :3])
        axis = outward if self.direction is None else broadcast_vector(unit_direction(self.direction), outward)
        speed = _apply_spread(self.speed, self.speed_spread, u[:, 5])
        if self.opposed:
            speed = jnp.where(slot % 2 == 0, speed, -speed)
        return Birth(
            time=self.birth_time(slot, generation),
            life=_apply_spread(self.life, self.life_spread, u[:, 6]),
            size=_apply_spread(self.size, self.size_spread, u[:, 7]),
            position=place,
            velocity=scale(speed, direction_in_cone(axis, self.cone, u[:, 3:5])),
        )

    def _draw(self, slot: Array, generation: Array) -> Array:
        key = jax.random.wrap_key_data(self.key, impl="threefry2x32")
        # the second of a pair has the numbers of the first
        slot = slot - slot % 2 if self.opposed else slot

        def one(slot, generation):
            own = jax.random.fold_in(jax.random.fold_in(key, slot), generation)
            return jax.random.uniform(own, (_DRAWS_PER_BIRTH,), self.start.dtype)

        return jax.vmap(one)(slot, generation)

    # as part of a scene

    def unborn(self, dtype: Any = None) -> Particles:
        """The state before the first birth: every particle rests where it will be born."""
        emitter = self._cast(jnp.dtype(dtype or jnp.result_type(float)))
        place = emitter.births(self.slot, jnp.zeros_like(self.slot)).position
        return Particles(place, jnp.zeros_like(place))

    def prepare(self, scene: Any) -> "Emitter":
        """The emitter as part of a scene, its numbers in the state's type; its memory begins here. The checks are here."""
        state = scene.state
        demand_particles("emitter", state, "bodies are not born")
        if state.position.shape != (self.pool, self.source.dim):
            raise ValueError(
                f"emitter: got a state of shape {state.position.shape}, expected {(self.pool, self.source.dim)}, one lane "
                "for each slot of the pool. Start from emitter.unborn()."
            )
        if scene.couples:
            raise ValueError(
                "emitter: got forces that couple the lanes, expected independent lanes, since each has its own clock. "
                "Wrap a plain function in forces.independent."
            )
        if scene.pinned is not None:
            raise ValueError("emitter: got pinned= as well, expected one of them: who is not alive is held already.")
        never, nothing = jnp.full(self.pool, jnp.inf, state.dtype), jnp.zeros(self.pool, state.dtype)
        unborn = jnp.full(self.pool, -1, jnp.int32)
        if isinstance(state.position, jax.core.Tracer):
            # a lane that a traced number has spoilt is never born, or its birth would put it right
            spoilt = jnp.any(jnp.isnan(state.position), axis=-1)
            unborn = jnp.where(spoilt, jnp.iinfo(jnp.int32).max, unborn)
        return self._cast(state.dtype)._with_memory(unborn, never, nothing, -never, nothing)

    def live(self, motion: Callable, scene: Any, t: Time, dt: ArrayLike) -> Any:
        """One step of a scene in which particles are born and die inside it, each at its own moment.

        Each lane has its own clock: it runs from birth, if that is in the step, and to death. For who does not live the
        step is so short that nothing moves: a choice between vectors would cost several times the step.
        """
        t = Moment.of(t, dt, scene.state.dtype)
        emitter, state = self.emit(t + dt, scene.state)
        if self._mean_rate is not None:
            dt = jnp.where(self._find_last_burst(t + dt) < self._last_countable_burst, dt, jnp.nan)
        born, dies = t.time_until(emitter.born, emitter.born_rest), t.time_until(emitter.dies, emitter.dies_rest)
        begun, end = jnp.clip(born, 0.0, dt), jnp.minimum(dies, dt)
        limits = jnp.finfo(state.dtype)
        shortest = float(limits.tiny) / float(limits.eps)
        lasts = jnp.where((born <= 0) & (dies >= dt), dt, jnp.maximum(end - begun, shortest))
        # the dead keep what they touched: who lies on a surface is not asked again whether it meets it
        contacts = tuple(contact.forget_lanes(emitter.generation > self.generation) for contact in scene.contacts)
        after = motion(scene.replace(state=state, contacts=contacts, emitter=emitter), t + begun, lasts)
        return after.replace(state=after.state.hold_lanes((dt < dies).astype(state.dtype)))

    def emit(self, t: Time, state: Particles) -> tuple["Emitter", Particles]:
        """All that are born by the time t [s], put where they were born; only their numbers are drawn."""
        due_generation = jnp.maximum(self.due_generation(t), self.generation)

        def newborn(changing, slot, due_generation):
            return due_generation > changing[1]

        def bear(changing, slot, due_generation):
            (x, v), generation, *moments = changing
            new, birth = due_generation > generation, self.births(slot, due_generation)
            state = Particles(_choose_vectors(new, birth.position, x), _choose_vectors(new, birth.velocity, v))
            time, rest = self._birth_moment(slot, due_generation)
            ends, more = exact_sum(time, birth.life)
            fresh = (time, rest, ends, rest + more)
            return state, due_generation, *(jnp.where(new, a, b) for a, b in zip(fresh, moments, strict=True))

        changing = (state, *(getattr(self, name) for name in self.memory))
        state, *memory = compact_and_apply_runs(bear, newborn, changing, self.slot, due_generation)
        return self._with_memory(*memory), state

    # what is seen

    def alive(self, t: ArrayLike) -> Bool[Array, "*frames pool"]:
        """Who is alive at the time t [s] of the scene, or at the times of a film's frames."""
        t = _align_with_frames(t, self.dies)
        return (self.born <= t) & (t < self.dies)

    def age(self, t: ArrayLike) -> Float[Array, "*frames pool"]:
        """Time since birth [s]; of the dead their whole life, of the unborn zero."""
        seen = jnp.clip(_align_with_frames(t, self.dies), self.born, jnp.maximum(self.dies, self.born))
        return jnp.where(self.generation < 0, 0.0, seen - self.born)

    def appearance(self, t: ArrayLike) -> Appearance:
        """Who is seen, how large [m], in which colour and how opaque, at the time t [s] or at a film's frames."""
        flat = self.generation.ravel()
        slot = jnp.broadcast_to(self.slot, self.generation.shape).ravel()
        size = _apply_spread(self.size, self.size_spread, self._draw(slot, flat)[:, 7]).reshape(self.generation.shape)
        life = jnp.where(self.generation < 0, 1.0, self.dies - self.born)
        return self.look.appearance_of(self.alive(t), size, self.age(t) / life)

    def _with_memory(self, *memory: Array) -> "Emitter":
        where = lambda emitter: [getattr(emitter, name) for name in emitter.memory]  # noqa: E731
        return eqx.tree_at(where, self, list(memory), is_leaf=lambda leaf: leaf is None)

    def _cast(self, dtype: Any) -> "Emitter":
        return jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, self)


def _apply_spread(mean: Array, spread: Array, u: Array) -> Array:
    """Even within mean·(1 ± spread)."""
    return force_rounding(mean * (1.0 + force_rounding(spread * (2.0 * u - 1.0))))


def _choose_vectors(flag: Array, a: Array, b: Array) -> Array:
    """Vectors a where flagged, else b; by components, since a choice between whole vectors costs several times that."""
    return stack_components([jnp.where(flag, p, q) for p, q in zip(components(a), components(b), strict=True)])


def _align_with_frames(t: ArrayLike, like: Array) -> Array:
    t = jnp.asarray(t, like.dtype)
    return t.reshape(t.shape + (1,) * (like.ndim - t.ndim)) if t.ndim else t


def _read_key(key: Any) -> Array:
    """The words of a key of JAX's default generator, or of a seed."""
    if isinstance(key, int | np.integer):
        key = jax.random.key(key)
    if not jnp.issubdtype(getattr(key, "dtype", type(key)), jax.dtypes.prng_key):
        raise TypeError(f"key: got {key!r}, expected a seed or jax.random.key(seed).")
    return jax.random.key_data(key)
