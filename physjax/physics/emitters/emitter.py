"""Particles that are born and die: a fixed pool of slots whose births are a closed form of slot and generation.

Slots are filled one after another, again and again: birth number n = generation·pool + slot has its own time, and its own
random numbers from the key folded with slot and generation. Nothing is accumulated: what is born depends on the key
alone, not on the step, the batch, or where a run was cut and resumed.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.backend import materialise
from physjax.checks import (
    Numbers,
    OptionalNumbers,
    as_positive_integer,
    concrete_or_none,
    demand_all,
    demand_direction,
    quantity,
    unchecked_quantity,
)
from physjax.compaction import compact_and_apply_runs
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
from physjax.parts import ParticleSource, as_module
from physjax.physics.emitters.appearance import Appearance, Look
from physjax.physics.emitters.births import Birth, Key, apply_spread, draw_uniforms, read_key
from physjax.physics.emitters.shapes import Source, direction_in_cone, unit_direction
from physjax.scene import Scene
from physjax.vectors import add_trailing_axes, broadcast_vector, components, scale, stack_components

POOL_ROUNDING_SHARE = 1e-6
"""By this share a pool may be too small [1]: rate times life is a whole number of particles only to float32's rounding."""
LARGEST_BURST_CORRECTION = 1e6
"""Bound on the bursts by which a first count is corrected [1]: rounding makes it a few, at most 2³¹ · eps = 256 in float32."""


class Emitter(ParticleSource):
    """A pool of particles born from a source: `Scene(emitter.unborn(), ..., emitter=emitter)`.

    From the time `start` [s] on, particles are born one by one at a `rate` [1/s], or in bursts of `burst` particles
    (by default the whole pool) at intervals of `every` [s]; with neither, once. A particle leaves the source with a
    `speed` [m/s] in a direction within the half-angle `cone` [rad] about `direction` (by default the outward normal
    of the source) and lives for `life` [s]. Speed, life and size [m] of each particle are uniform within mean·(1 ±
    spread). `key` is a seed or a `jax.random.key`. A source that moves has a `path(t) -> displacement` [m], `(dim,)`:
    particles are born along it, each at its own time, with the velocity of the path added to theirs. With `opposed`,
    bursts are of pairs with opposite velocities, so that their momentum is zero.

    All numbers but counts can be swept and differentiated (at fixed generations). Raises ValueError where a slot is needed
    before its particle has died, with the pool that is needed; with `drop_oldest` the oldest particle is replaced instead.
    Raises ValueError or TypeError for numbers out of range. Times are counted, and kept with their rounding errors, so that
    births stay evenly spaced after a day in float32; after 2³¹ births particles become NaN.

    Example:
        >>> fountain = emitters.Emitter(8, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=5.0, rate=4.0)
        >>> print(fountain.birth_time(slot=jnp.array([0, 1, 2]), generation=jnp.array([0, 0, 1])))
        [0.   0.25 2.5 ]
        >>> smoke = emitters.Emitter(
        ...     8, emitters.Point((0.0, 0.0)), key=0, life=1.0, rate=4.0, path=lambda t: jnp.stack([10 * t, 0 * t])
        ... )
        >>> print(smoke.births(slot=jnp.array([1]), generation=jnp.array([0])).position)
        [[2.5 0. ]]
    """

    memory: ClassVar[tuple[str, ...]] = ("generation", "born", "born_rest", "dies", "dies_rest")

    pool: int = eqx.field(static=True, converter=lambda value: as_positive_integer("pool", value))
    source: Source
    key: Key = unchecked_quantity("key", per=None, converter=read_key, kw_only=True)
    life: Numbers = quantity("life", "s", per=None, above=0, kw_only=True)
    speed: Numbers = quantity("speed", "m/s", per=None, default=0.0, kw_only=True)
    rate: OptionalNumbers = quantity("rate", "1/s", per=None, above=0, default=None, kw_only=True)
    every: OptionalNumbers = quantity("time between bursts", "s", per=None, above=0, default=None, kw_only=True)
    burst: int | None = eqx.field(static=True, default=None, kw_only=True)
    start: Numbers = quantity("start", "s", per=None, default=0.0, kw_only=True)
    direction: OptionalNumbers = quantity("direction", "1", kind="vector", per=None, default=None, kw_only=True)
    path: Callable | None = eqx.field(default=None, kw_only=True)
    cone: Numbers = quantity(
        "half-angle of the cone", "rad", per=None, at_least=0, at_most=3.1416, default=0.0, kw_only=True
    )
    size: Numbers = quantity("size", "m", per=None, above=0, default=0.01, kw_only=True)
    speed_spread: Numbers = quantity("spread of the speed", "1", per=None, at_least=0, default=0.0, kw_only=True)
    life_spread: Numbers = quantity("spread of the life", "1", per=None, at_least=0, default=0.0, kw_only=True)
    size_spread: Numbers = quantity("spread of the size", "1", per=None, at_least=0, default=0.0, kw_only=True)
    look: Look = eqx.field(default_factory=Look, kw_only=True)
    opposed: bool = eqx.field(static=True, default=False, kw_only=True)
    drop_oldest: bool = eqx.field(static=True, default=False, kw_only=True)
    slot: Int[Array, "pool"] = unchecked_quantity("slot", per="memory", default=None, kw_only=True)
    generation: Int[Array, "..."] = unchecked_quantity("generation", per="memory", default=None, kw_only=True)
    born: Numbers = unchecked_quantity("birth", "s", per="memory", default=None, kw_only=True)
    dies: Numbers = unchecked_quantity("death", "s", per="memory", default=None, kw_only=True)
    start_rest: Numbers = unchecked_quantity("rest of the start", "s", per=None, default=None, repr=False, kw_only=True)
    born_rest: Numbers = unchecked_quantity("rest of birth", "s", per="memory", default=None, repr=False, kw_only=True)
    dies_rest: Numbers = unchecked_quantity("rest of death", "s", per="memory", default=None, repr=False, kw_only=True)

    def __post_init__(self):
        # an array, not a count: selected lanes keep the numbers of their slots
        self.slot = jnp.arange(self.pool, dtype=jnp.int32)
        self.start_rest = float32_remainder(self.start, self.start_rest)
        if self.path is not None:
            if not callable(self.path) or isinstance(self.path, type):
                raise TypeError(f"path: got {self.path!r}, expected a function t -> displacement of the source [m].")
            self.path = as_module(self.path)
        if self.generation is None:  # pyright: ignore[reportUnnecessaryComparison]  # given where `dataclasses.replace` changes a number during a run
            memory = _begin_memory(self.slot.size, jnp.result_type(float))
            self.generation, self.born, self.born_rest, self.dies, self.dies_rest = memory

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
            if (spread := concrete_or_none(value)) is not None:
                demand_all(f"spread of the {name} [1]", value, spread < 1, "numbers from 0 to below 1")
        if self.direction is not None:
            demand_direction("direction", self.direction)
        if not self.drop_oldest:
            self._demand_room()

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers beyond their bounds, also for traced ones."""
        return self.life_spread < 1, self.size_spread < 1

    def _demand_room(self) -> None:
        """Raise a ValueError where a slot is needed before its particle has died."""
        life, spread, rate = concrete_or_none(self.life), concrete_or_none(self.life_spread), self._mean_rate
        pace = None if rate is None else concrete_or_none(rate)
        if life is None or spread is None or pace is None:
            return
        longest, burst = float(np.max(life * (1 + spread))), self._burst_size
        needed = burst * math.ceil(longest * float(np.max(pace)) / burst * (1 - POOL_ROUNDING_SHARE))
        if needed > self.pool:
            raise ValueError(
                f"pool: got {self.pool} slots for {float(np.max(pace)):g} births a second that live up to {longest:g} s, "
                f"expected at least {needed}. Give pool={needed}, or drop_oldest=True to replace the oldest."
            )

    # births, as a closed form

    @property
    def _burst_size(self) -> int:
        """Particles per burst."""
        return 1 if self.rate is not None else self.burst or self.pool

    @property
    def _mean_rate(self) -> Array | None:
        """Births per second, averaged over bursts; None where there is one burst only."""
        return self.rate if self.every is None else self._burst_size / self.every

    def birth_time(self, slot: Int[Array, "*births"], generation: Int[Array, "*births"]) -> Float[Array, "*births"]:
        """When the particle of a slot and generation is born [s]: start + n/rate, or the time of its burst."""
        return self._birth_moment(slot, generation)[0]

    def _birth_moment(self, slot: Array, generation: Array) -> tuple[Array, Array]:
        """When the particle of a slot and generation is born [s], and the rounding error of that."""
        start, start_rest = self.start, cast_remainder(self.start, self.start_rest)
        if self._mean_rate is None:
            return jnp.broadcast_to(start, generation.shape), jnp.broadcast_to(start_rest, generation.shape)
        after, after_rest = self._burst_delay((generation * self.pool + slot) // self._burst_size)
        time, rest = exact_sum(start, after)
        return time, rest + (start_rest + after_rest)

    def _burst_delay(self, burst: Array) -> tuple[Array, Array]:
        """How long after the first a burst is [s], and the rounding error of that."""
        if self.every is not None:
            return exact_multiple(burst, self.every)
        assert self.rate is not None  # with neither there is one burst only, and nobody asks
        return exact_quotient(burst, self.rate)

    def due_generation(self, t: Time) -> Int[Array, "pool"]:
        """The last generation born in each slot by the time t [s]; -1 before the first."""
        bursts = self._find_last_burst(Moment.of(t, jnp.inf, self.start.dtype))
        last = (bursts + 1) * self._burst_size - 1
        rounds = last // self.pool
        begun = self.slot <= last - rounds * self.pool
        return rounds + begun.astype(jnp.int32) - 1

    @property
    def _last_countable_burst(self) -> int:
        """The number of the last burst whose births can be counted in 32 bits."""
        # two pools below 2³¹, since a generation is found by rounding up to whole pools
        return (2**31 - 2 * self.pool) // self._burst_size - 1

    def _find_last_burst(self, t: Moment) -> Array:
        """The number of the last burst by a time, -1 before the first; one that is later by no more than rounding counts."""
        # materialised, or XLA on CPU would count again for every lane
        return materialise(to_float_time(t), lambda: self._count_bursts(t))

    def _count_bursts(self, t: Moment) -> Array:
        """The number of the last burst: a guess from the rounded time, corrected by the exact time that is left after it."""
        whole, rest = t.time_since(self.start, cast_remainder(self.start, self.start_rest))
        early = jnp.minimum(2 * float(jnp.finfo(whole.dtype).eps) * jnp.abs(t.start), LARGEST_SNAP_SHARE * t.step)
        rest = rest + early
        if (rate := self._mean_rate) is None:
            return jnp.where(whole + rest < 0, -1, 0).astype(jnp.int32)
        pace = rate / self._burst_size
        guess = jnp.clip(jnp.floor(whole * pace), -1, self._last_countable_burst).astype(jnp.int32)
        after, after_rest = self._burst_delay(guess)
        more = jnp.floor(((whole - force_rounding(after)) + (rest - after_rest)) * pace)
        # bounded before it is cast: NaN and infinities (a spoilt lane, a run of endless steps) have no integer
        more = jnp.clip(more, -LARGEST_BURST_CORRECTION, LARGEST_BURST_CORRECTION).astype(jnp.int32)
        return jnp.clip(guess + more, -1, self._last_countable_burst)

    @eqx.filter_jit  # one program wherever it is called: operation by operation, it would round differently
    def births(self, slot: Int[Array, "births"], generation: Int[Array, "births"]) -> Birth:
        """The births of these slots in these generations, drawn from the key folded with both."""
        u = self._draw(slot, generation)
        place, outward = self.source(u[:, :3])
        axis = outward if self.direction is None else broadcast_vector(unit_direction(self.direction), outward)
        speed = apply_spread(self.speed, self.speed_spread, u[:, 5])
        if self.opposed:
            speed = jnp.where(slot % 2 == 0, speed, -speed)
        velocity = scale(speed, direction_in_cone(axis, self.cone, u[:, 3:5]))
        time = self.birth_time(slot, generation)
        if self.path is not None:
            displacement, source_velocity = self._move_source(time)
            place, velocity = place + displacement, force_rounding(velocity) + source_velocity
        return Birth(
            time=time,
            life=apply_spread(self.life, self.life_spread, u[:, 6]),
            size=apply_spread(self.size, self.size_spread, u[:, 7]),
            position=place,
            velocity=velocity,
        )

    def _move_source(self, time: Array) -> tuple[Array, Array]:
        """How far the source has moved at the time of each birth [m], and its velocity [m/s], in the dtype of the time."""

        def displace(t: Array) -> Array:
            assert self.path is not None
            moved = jnp.asarray(self.path(t))
            if moved.shape != (self.source.dim,) or not jnp.issubdtype(moved.dtype, jnp.number):
                raise ValueError(
                    f"path: got {moved.dtype} of shape {moved.shape} for a time, expected the displacement of the source "
                    f"[m], of shape ({self.source.dim},)."
                )
            return moved.astype(time.dtype)

        moved = jax.vmap(lambda t: jax.jvp(displace, (t,), (jnp.ones_like(t),)))(time)
        return force_rounding(moved[0]), force_rounding(moved[1])

    def _draw(self, slot: Array, generation: Array) -> Array:
        """The uniform numbers of these births; the second of an opposed pair has those of the first."""
        slot = slot - slot % 2 if self.opposed else slot
        return draw_uniforms(self.key, slot, generation, self.start.dtype)

    # as part of a scene

    def unborn(self, dtype: DTypeLike | None = None) -> Particles:
        """The state before the first birth: every particle is at rest where it will be born."""
        emitter = self._cast(jnp.dtype(dtype or jnp.result_type(float)))
        place = emitter.births(self.slot, jnp.zeros_like(self.slot)).position
        return Particles(place, jnp.zeros_like(place))

    def prepare(self, scene: Scene) -> "Emitter":
        """The emitter as part of a scene, its numbers in the dtype of the state, with nothing born.

        Raises TypeError or ValueError for a scene in which it cannot work.
        """
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
            raise ValueError(
                "emitter: got pinned= as well, expected one of them: particles that are not alive are held."
            )
        unborn, *times = _begin_memory(self.pool, state.dtype)
        if isinstance(state.position, Tracer):
            # a lane with an invalid traced number stays NaN: it is never born, or its birth would make it finite
            invalid = jnp.any(jnp.isnan(state.position), axis=-1)
            unborn = jnp.where(invalid, jnp.iinfo(jnp.int32).max, unborn)
        return self._cast(state.dtype)._with_memory(unborn, *times)

    def live(self, motion: Callable[..., Scene], scene: Scene, t: Time, dt: ArrayLike) -> Scene:
        """One step of a scene in which particles are born and die at any time within the step.

        Each lane steps from its birth, if that is within the step, to the end or to its death. Lanes that are not alive
        make a step too short to move anything: a choice between vectors would cost several times the step.
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
        # only newborn lanes forget their contacts: a dead one that rests on a surface must not be tested against it again
        contacts = tuple(contact.forget_lanes(emitter.generation > self.generation) for contact in scene.contacts)
        after = motion(scene.replace(state=state, contacts=contacts, emitter=emitter), t + begun, lasts)
        return after.replace(state=after.state.hold_lanes((dt < dies).astype(state.dtype)))

    def emit(self, t: Time, state: Particles) -> tuple["Emitter", Particles]:
        """The emitter and the state after all births by the time t [s]; random numbers are drawn for those lanes only."""
        due_generation = jnp.maximum(self.due_generation(t), self.generation)

        def is_due(changing: tuple[PyTree, ...], slot: Array, due_generation: Array) -> Array:
            return due_generation > changing[1]

        def give_birth(changing: tuple[PyTree, ...], slot: Array, due_generation: Array) -> tuple[PyTree, ...]:
            (x, v), generation, *times = changing
            new, birth = due_generation > generation, self.births(slot, due_generation)
            state = Particles(_choose_vectors(new, birth.position, x), _choose_vectors(new, birth.velocity, v))
            time, rest = self._birth_moment(slot, due_generation)
            dies, dies_rest = exact_sum(time, birth.life)
            fresh = (time, rest, dies, rest + dies_rest)
            return state, due_generation, *(jnp.where(new, a, b) for a, b in zip(fresh, times, strict=True))

        changing = (state, *self._memory_arrays)
        state, *memory = compact_and_apply_runs(give_birth, is_due, changing, self.slot, due_generation)
        return self._with_memory(*memory), state

    # appearance

    def alive(self, t: ArrayLike) -> Bool[Array, "*frames pool"]:
        """Which particles are alive at the time t [s], or at the times of frames."""
        t = self._align_with_frames(t)
        return (self.born <= t) & (t < self.dies)

    def age(self, t: ArrayLike) -> Float[Array, "*frames pool"]:
        """Time since birth [s]; the whole life for the dead, zero for the unborn."""
        until = jnp.clip(self._align_with_frames(t), self.born, jnp.maximum(self.dies, self.born))
        return jnp.where(self.generation < 0, 0.0, until - self.born)

    def appearance(self, t: ArrayLike) -> Appearance:
        """Which particles are seen, their size [m], colour and opacity, at the time t [s] or at the times of frames."""
        flat = self.generation.ravel()
        slot = jnp.broadcast_to(self.slot, self.generation.shape).ravel()
        size = apply_spread(self.size, self.size_spread, self._draw(slot, flat)[:, 7]).reshape(self.generation.shape)
        life = jnp.where(self.generation < 0, 1.0, self.dies - self.born)
        return self.look.appearance_of(self.alive(t), size, self.age(t) / life)

    def _align_with_frames(self, t: ArrayLike) -> Array:
        """Times of frames, so that they meet the lanes of each frame."""
        return add_trailing_axes(jnp.asarray(t, self.dies.dtype), self.dies.ndim)

    @property
    def _memory_arrays(self) -> tuple[Array, ...]:
        """The arrays that `memory` names, in its order."""
        return self.generation, self.born, self.born_rest, self.dies, self.dies_rest

    def _with_memory(self, *memory: Array) -> "Emitter":
        return eqx.tree_at(lambda emitter: emitter._memory_arrays, self, memory)

    def _cast(self, dtype: DTypeLike) -> "Emitter":
        """The emitter with its floating-point numbers in this dtype."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, self)


def _begin_memory(pool: int, dtype: np.dtype) -> tuple[Array, ...]:
    """The memory of a pool before the first birth: no generation, born never, dead for ever."""
    never, nothing = jnp.full(pool, jnp.inf, dtype), jnp.zeros(pool, dtype)
    return jnp.full(pool, -1, jnp.int32), never, nothing, -never, nothing


def _choose_vectors(flag: Array, a: Array, b: Array) -> Array:
    """Vectors a where flagged, else b; by components, since a choice between whole vectors costs several times as much."""
    return stack_components([jnp.where(flag, p, q) for p, q in zip(components(a), components(b), strict=True)])
