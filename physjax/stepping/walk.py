"""A walk in steps of its own: it is asked for states at given times, and takes the steps in between as it sees fit.

Every independent lane, or scene of coupled lanes, walks by itself. A walk stands at the start of a step that it has already
tried. The next turn of the loop sets out from the end of that step if it was accepted, and tries a shorter one if it was
not; a walk whose step reaches as far as it was asked for tries the same again until all others have arrived. So
what a path within the steps needs is that of the last turn, for all of them at once, and nothing is selected.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.backend import any_lane
from physjax.compaction import write_entries
from physjax.loops import Time, differentiable_while_loop
from physjax.stepping.pairs import Attempt
from physjax.stepping.step_control import StepRecord, find_next_stop
from physjax.vectors import add_trailing_axes

MAX_TURNS = 2**14
"""Steps of one dt through which derivatives are carried where no bound is given: 128 states are stored."""


class Progress(NamedTuple):
    """Where walks stand [s], relative to the start of the current dt, and what they know of steps.

    `frame` counts the dt that are behind them. The step tried goes from `elapsed` to `arrived`, over `length`; `accepted`
    says whether it may be kept, `proposed` how long the next may be. `last` is the last step accepted; counts and `shortest`
    are those of the current dt.
    """

    frame: Int[Array, "..."]
    elapsed: Float[Array, "..."]
    arrived: Float[Array, "..."]
    length: Float[Array, "..."]
    proposed: Float[Array, "..."]
    accepted: Bool[Array, "..."]
    failed: Bool[Array, "..."]
    last: StepRecord
    taken: Int[Array, "..."]
    rejected: Int[Array, "..."]
    shortest: Float[Array, "..."]

    @classmethod
    def begin(cls, first: Array) -> "Progress":
        """Before the first step, of a length [s] that is proposed."""
        zero, none = jnp.zeros_like(first), jnp.zeros(first.shape, jnp.int32)
        no = jnp.zeros(first.shape, bool)
        before = StepRecord(jnp.full_like(first, jnp.inf), jnp.ones_like(first))
        never = jnp.full_like(first, jnp.inf)
        return cls(none, zero, zero, jnp.ones_like(first), first, no, no, before, none, none, never)

    def has_arrived(self, dt: Array) -> Array:
        """Which have a step that reaches the end of dt."""
        return self.accepted & (self.arrived >= dt)

    def is_going(self, dt: Array, tries: int | None) -> Array:
        """Which have to step on to reach the end of dt."""
        going = ~self.failed & ~self.has_arrived(dt)
        return going if tries is None else going & (self.taken + self.rejected < tries)

    def begin_next(self, dt: Array, those: Array | bool = True) -> "Progress":
        """The same, relative to the start of the next dt, of `those` that begin it."""
        begun = self._replace(
            frame=self.frame + 1,
            elapsed=self.elapsed - dt,
            arrived=self.arrived - dt,
            taken=jnp.zeros_like(self.taken),
            rejected=jnp.zeros_like(self.rejected),
            shortest=jnp.full_like(self.shortest, jnp.inf),
        )
        return jax.tree.map(lambda new, old: jnp.where(those, new, old), begun, self)


class Walk(NamedTuple):
    """What is carried: the start of the step tried, the slope there where it is known, what was found, and the progress."""

    start: PyTree
    slope: PyTree
    attempt: Attempt
    progress: Progress


class Course(NamedTuple):
    """How steps are tried and judged, and where they must end.

    - `clock(frame) -> time` at the start of the current dt [s].
    - `attempt(time, start, length, slope) -> Attempt` and `measure(start, attempt) -> error` in units of the tolerance.
    - `normalise(state)`: what a step leaves, as it must be.
    - `choose_factor(step, before, good) -> factor` of the next step.
    - `find_jumps(time)`: after how many seconds steps end; `end`: the same, the end of dt or infinity.
    - `floor`, `ceiling` of the length of a step [s]; `tries` bounds their number in one dt.
    """

    clock: Callable[[Array], Time]
    attempt: Callable[[Time, PyTree, Array, PyTree], Attempt]
    measure: Callable[[PyTree, Attempt], Array]
    normalise: Callable[[PyTree], PyTree]
    choose_factor: Callable[[StepRecord, StepRecord, Array], Array]
    find_jumps: Callable[[Time], list[Array]]
    end: Array
    floor: Array
    ceiling: Array
    tries: int | None


def begin_walk(course: Course, start: PyTree, slope: PyTree, first: Array) -> Walk:
    """A walk before its first step."""
    progress = Progress.begin(lax.stop_gradient(jnp.clip(first, course.floor, course.ceiling)))
    found = jax.eval_shape(course.attempt, course.clock(progress.frame), start, progress.length, slope)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), found._replace(error=None))
    return Walk(start, slope, nothing, progress)


def walk_on(course: Course, walk: Walk, dt: Array) -> Walk:
    """The walk after all have reached dt [s], or have failed."""
    going = lambda walk: walk.progress.is_going(dt, course.tries)  # noqa: E731
    turn = lambda walk: take_turn(course, walk, going(walk))  # noqa: E731
    return differentiable_while_loop(going, turn, walk, most=MAX_TURNS if course.tries is None else course.tries)


def walk_through(
    course: Course, walk: Walk, dt: Array, frames: int, read: Callable[[Walk], PyTree]
) -> tuple[PyTree, Walk]:
    """The states at the ends of `frames` dt, NaN where they were not reached, and the walk; `read(walk)` is that at one.

    No walk waits for another at a frame: each writes its frames when it gets there. No derivatives.
    """

    def is_going(walk: Walk) -> Array:
        return walk.progress.is_going(dt, course.tries) & (walk.progress.frame < frames)

    def is_at_frame(walk: Walk) -> Array:
        return walk.progress.has_arrived(dt) & (walk.progress.frame < frames)

    def write(carry: tuple[PyTree, Walk]) -> tuple[PyTree, Walk]:
        film, walk = carry
        those = is_at_frame(walk)
        place = jnp.where(those, walk.progress.frame, frames)
        film = jax.tree.map(lambda kept, leaf: write_entries(kept, place, leaf), film, read(walk))
        return film, walk._replace(progress=walk.progress.begin_next(dt, those))

    def turn(carry: tuple[PyTree, Walk]) -> tuple[PyTree, Walk]:
        film, walk = carry
        walk = take_turn(course, walk, is_going(walk))
        return lax.while_loop(lambda carry: any_lane(is_at_frame(carry[1])), write, (film, walk))

    seen = jax.eval_shape(read, walk)
    empty = jax.tree.map(lambda leaf: jnp.full((frames, *leaf.shape), jnp.nan, leaf.dtype), seen)
    return lax.while_loop(lambda carry: any_lane(is_going(carry[1])), turn, (empty, walk))


def take_turn(course: Course, walk: Walk, going: Array) -> Walk:
    """One step tried by those that are going."""
    now = walk.progress
    t = course.clock(now.frame)
    leaves = going & now.accepted
    start = select(leaves, course.normalise(walk.attempt.end), walk.start)
    slope = None if walk.slope is None else select(leaves, walk.attempt.slope, walk.slope)
    elapsed = jnp.where(leaves, now.arrived, now.elapsed)
    stop = find_next_stop(course.find_jumps(t), course.end, elapsed)
    left = stop - elapsed
    # two equal steps to a stop rather than a long and a tiny one
    cut = now.proposed >= left
    length = jnp.where(cut, left, jnp.where(2 * now.proposed > left, left / 2, now.proposed))
    length = jnp.where(going, length, now.length)
    arrived = jnp.where(going, jnp.where(cut, stop, elapsed + length), now.arrived)
    attempt = course.attempt(t + elapsed, start, length, slope)
    error = lax.stop_gradient(course.measure(start, attempt))
    progress = _judge(course, now._replace(elapsed=elapsed, arrived=arrived, length=length), going, cut, error)
    return Walk(start, slope, attempt._replace(error=None), progress)


def _judge(course: Course, now: Progress, going: Array, cut: Array, error: Array) -> Progress:
    """Whether the steps tried are kept, and how long the next may be."""
    good = going & (error <= 1.0)
    bad = going & ~good
    step = StepRecord(lax.stop_gradient(now.length), error)
    longer = step.length * course.choose_factor(step, now.last, good)
    # cut short by a stop, a step says little about how long the next may be
    longer = jnp.where(good & cut, jnp.maximum(longer, now.proposed), longer)
    return now._replace(
        proposed=jnp.where(going, jnp.clip(longer, course.floor, course.ceiling), now.proposed),
        accepted=jnp.where(going, good, now.accepted),
        failed=now.failed | (bad & ~(step.length > course.floor)),  # negated, so that a step of NaN fails as well
        last=StepRecord(*(jnp.where(good, new, old) for new, old in zip(step, now.last, strict=True))),
        taken=now.taken + good.astype(jnp.int32),
        rejected=now.rejected + bad.astype(jnp.int32),
        shortest=jnp.where(good, jnp.minimum(now.shortest, step.length), now.shortest),
    )


def select(flag: Array, new: PyTree, old: PyTree) -> PyTree:
    """The new tree for what is flagged, the old one elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(add_trailing_axes(flag, a.ndim), a, b), new, old)


__all__ = ["Course", "Progress", "Walk", "begin_walk", "select", "walk_on", "walk_through"]
