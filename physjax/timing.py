"""One policy for timing runs: warm up first, take turns in slices of time, report the least and the median.

The least time of a call is the one that other work on the machine disturbed least; the median says what to expect. Runs
that are compared take turns, so that a busy moment meets all of them. A turn lasts a slice of time: a short call is
repeated until the slice is over, so that it cannot slip through a gap that a long one does not fit into. Each turn begins
with a call that does not count, which pays for what the run before left behind: cold caches, memory to be returned.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from physjax.backend import read_work_clock

Result = TypeVar("Result")


class Timing(NamedTuple):
    """Wall-clock seconds of a call, one number a turn, and the processor seconds of the same turns.

    `first` is the first call of all, which compiles, and `compiling` the compiler's share of it, where they were timed [s].
    """

    seconds: tuple[float, ...]
    busy: tuple[float, ...] = ()
    first: float = math.nan
    compiling: float = math.nan

    @property
    def least(self) -> float:
        """A call in the least disturbed turn [s]."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """A call in an ordinary turn [s]."""
        return statistics.median(self.seconds)

    @property
    def spread(self) -> float:
        """From the least to the lower quartile [s]: a smaller difference between two runs is the clock's."""
        return float(np.quantile(self.seconds, 0.25)) - self.least

    @property
    def cores(self) -> float:
        """Cores in use on average: well below 1 for work on the CPU means that something else had the machine."""
        return sum(self.busy) / sum(self.seconds)


def time_call(run: Callable[[], Result]) -> tuple[Result, float]:
    """The finished result of a call, and its time [s]."""
    started = time.perf_counter()
    # dispatch is asynchronous: without waiting only the launch would be timed
    result = jax.block_until_ready(run())
    return result, time.perf_counter() - started


def time_repeatedly(
    run: Callable[[], Result], repeats: int, *, longest: float, total: float = math.inf
) -> tuple[Result, Timing]:
    """The result of a call, and the times of its repeats after a first one that warms up.

    A call over `longest` [s] ends the repeats; where that is the first, its time is the only one, since what it warms up
    is small next to it. So do `total` [s] of all calls together.
    """
    result, first = time_call(run)
    times: list[float] = []
    while first <= longest and len(times) < repeats and first + sum(times) < total:
        times.append(time_call(run)[1])
        if times[-1] > longest:
            break
    return result, Timing(tuple(times or [first]))


def time_in_turn(
    runs: Sequence[Callable[[], object]], *, slice_seconds: float, seconds: float, rounds: tuple[int, int]
) -> list[Timing]:
    """The times of runs that take turns: rounds of one turn each, from the least to the most of `rounds`, in `seconds` [s].

    A turn is a call that does not count and then calls for `slice_seconds` [s], whose mean is the turn's time.
    """
    turns: list[list[tuple[float, float]]] = [[] for _ in runs]
    started, (least, most) = time.perf_counter(), rounds
    while runs and (len(turns[0]) < least or (len(turns[0]) < most and time.perf_counter() - started < seconds)):
        for run, taken in zip(runs, turns, strict=True):
            taken.append(_time_turn(run, slice_seconds))
    return [Timing(tuple(s for s, _ in taken), tuple(busy for _, busy in taken)) for taken in turns]


def _time_turn(run: Callable[[], object], slice_seconds: float) -> tuple[float, float]:
    """Mean wall-clock and processor seconds of a call; a call that fills the slice by itself is not repeated."""
    busy = read_work_clock()
    warming = time_call(run)[1]
    if warming >= slice_seconds:
        return warming, read_work_clock() - busy
    calls, started, busy = 0, time.perf_counter(), read_work_clock()
    while calls == 0 or time.perf_counter() - started < slice_seconds:
        jax.block_until_ready(run())
        calls += 1
    return (time.perf_counter() - started) / calls, (read_work_clock() - busy) / calls
