"""One policy of timing: warm calls, turns, the least and the median."""

import time

import pytest

from physjax.timing import Timing, time_call, time_in_turn, time_repeatedly


def sleeper(*seconds):
    """A run that sleeps for these times [s], the last of them from then on, and counts its calls."""
    calls = []

    def run():
        calls.append(seconds[min(len(calls), len(seconds) - 1)])
        time.sleep(calls[-1])
        return len(calls)

    return run, calls


def test_a_call_returns_its_result_and_its_time():
    run, _ = sleeper(0.01)
    result, seconds = time_call(run)
    assert result == 1
    assert seconds >= 0.01


def test_the_first_call_warms_up_and_does_not_count():
    run, calls = sleeper(0.05, 0.001)
    result, timing = time_repeatedly(run, 3, longest=1.0)
    assert result == 1
    assert len(calls) == 4
    assert len(timing.seconds) == 3
    assert timing.median < 0.05


@pytest.mark.parametrize(("longest", "total", "calls_made"), [(0.005, 9.0, 1), (9.0, 0.1, 2)])
def test_a_long_run_is_not_repeated(longest, total, calls_made):
    run, calls = sleeper(0.055)
    _, timing = time_repeatedly(run, 5, longest=longest, total=total)
    assert len(calls) == calls_made
    assert len(timing.seconds) == 1


def test_runs_take_turns_of_equal_length():
    (short, short_calls), (long, long_calls) = sleeper(0.001), sleeper(0.03)
    timings = time_in_turn([short, long], slice_seconds=0.01, seconds=0.0, rounds=(3, 9))
    assert [len(timing.seconds) for timing in timings] == [3, 3]
    assert len(long_calls) == 3  # fills its turn by itself
    assert len(short_calls) > 3 * 2
    assert timings[0].least < timings[1].least
    assert all(timing.cores < 0.9 for timing in timings)  # asleep
    assert time_in_turn([], slice_seconds=0.01, seconds=0.0, rounds=(3, 9)) == []


def test_a_timing_tells_its_least_its_median_and_its_spread():
    timing = Timing((4.0, 1.0, 2.0, 3.0, 5.0))
    assert (timing.least, timing.median, timing.spread) == (1.0, 3.0, 1.0)
