"""The order of a method as its errors show it: their slope where it lasts, neither too coarse nor bent by rounding."""

from collections.abc import Sequence

import numpy as np

LEAST_RUNS = 3
"""Two runs always lie on a line."""
LINE_STEPS_RATIO, FITTED_STEPS_RATIO = 10.0, 6.0
"""Steps up to this many times the finest make a line, by the first, and its slope, by the second: coarser ones still bend."""
LASTING_STEPS_RATIO = 7.0
"""Errors that keep falling over steps of at least this ratio are how the method converges, however much they scatter."""
LARGEST_BEND, LARGEST_ROUGH_BEND = 0.1, 0.25
"""The slopes of the coarser and of the finer half of a line differ from its own by no more than this share: of a straight one,
and of one that is taken for want of a straight one."""
ROUNDING_MARGIN = 10.0
"""Runs with errors of less than this many times those of runs that rounding has taken are bent by it."""
LARGEST_BENT_RATIO = 3.0
"""Rounding has bent a line over steps of at most this ratio; over more, its errors fall as they do."""
SMALLEST_ORDER = 0.5
"""Errors with a lower slope do not fall: rounding grows, and the error of the truth stays, as steps become finer."""
LEAST_SCATTERED_FALL = 10.0
"""How far errors that scatter must fall over all steps for their slope to mean something."""


def fit_order(steps: Sequence[float], errors: Sequence[float]) -> float:
    """Slope of log error against log step of runs from coarse to fine, over the finest that lie on a line; NaN if unseen.

    A line takes three runs. What is finer than it is left out where errors no longer fall: rounding, or the error of the
    truth, has bent them. Errors that go on falling there are no rounding: a kink or an impact may scatter them, and their
    slope, which is often less than what was promised, is the order.
    """
    log_step, log_error = np.log(np.asarray(steps, float)), np.log(np.asarray(errors, float))
    line = _find_line(log_step, log_error, LARGEST_BEND)
    finer = slice(None) if line is None else slice(line.stop - 1, None)
    lasting = _fit_lasting_slope(log_step[finer], log_error[finer])
    if not np.isnan(lasting):
        return lasting
    if line is not None:
        return _fit_finest(log_step, log_error, _leave_margin(log_step, log_error, line))
    line = _find_line(log_step, log_error, LARGEST_ROUGH_BEND)
    if line is None or len(_find_bent_runs(log_error, line)):
        return float("nan")
    return _fit_finest(log_step, log_error, line)


def fit_scattered_order(steps: Sequence[float], errors: Sequence[float]) -> float:
    """Slope of log error against log step of all runs, whose errors scatter; NaN where they fall by too little."""
    if len(errors) < LEAST_RUNS or max(errors) < LEAST_SCATTERED_FALL * min(errors):
        return float("nan")
    return _fit_slope(np.log(np.asarray(steps, float)), np.log(np.asarray(errors, float)))


def _leave_margin(log_step: np.ndarray, log_error: np.ndarray, line: slice) -> slice:
    """The line without its finest runs, where rounding has bent these."""
    bent = _find_bent_runs(log_error, line)
    if not len(bent):
        return line
    clear = _find_line(log_step[: bent[0]], log_error[: bent[0]], LARGEST_BEND)
    if clear is None:
        return line
    # errors that fall slowly are close to others over many steps: rounding bends a steep line at its end alone
    ratio = log_step[clear.stop - 1] - log_step[line.stop - 1]
    return clear if ratio < np.log(LARGEST_BENT_RATIO) else line


def _find_bent_runs(log_error: np.ndarray, line: slice) -> np.ndarray:
    """The runs of a line, and coarser ones, that are close to the errors of the runs finer than it."""
    rounding = log_error[line.stop :].max(initial=-np.inf)
    return np.flatnonzero(log_error[: line.stop] <= rounding + np.log(ROUNDING_MARGIN))


def _find_line(log_step: np.ndarray, log_error: np.ndarray, largest_bend: float) -> slice | None:
    """The runs of the longest line of falling errors, of lines as long the finest: a short one may be one by chance."""
    ends = range(len(log_step), LEAST_RUNS - 1, -1)
    starts = {end: int(np.argmax(log_step < log_step[end - 1] + np.log(LINE_STEPS_RATIO))) for end in ends}
    longest = max((end - start for end, start in starts.items()), default=0)
    for runs in range(longest, LEAST_RUNS - 1, -1):
        for end in ends:
            line = slice(end - runs, end)
            if line.start >= starts[end] and _is_line(log_step[line], log_error[line], largest_bend):
                return line
    return None


def _is_line(log_step: np.ndarray, log_error: np.ndarray, largest_bend: float) -> bool:
    """Whether errors fall with the same slope among the coarser and among the finer runs."""
    slope = _fit_slope(log_step, log_error)
    bend = max(abs(half - slope) for half in _fit_halves(log_step, log_error))
    return slope >= SMALLEST_ORDER and bend <= largest_bend * slope


def _fit_finest(log_step: np.ndarray, log_error: np.ndarray, line: slice) -> float:
    """The slope of the finest runs of a line, or of all where these are less straight."""
    log_step, log_error = log_step[line], log_error[line]
    runs = max(LEAST_RUNS, np.count_nonzero(log_step < log_step[-1] + np.log(FITTED_STEPS_RATIO)))
    if _is_line(log_step[-runs:], log_error[-runs:], LARGEST_BEND):
        log_step, log_error = log_step[-runs:], log_error[-runs:]
    return _fit_slope(log_step, log_error)


def _fit_lasting_slope(log_step: np.ndarray, log_error: np.ndarray) -> float:
    """Slope of errors that fall over a range of steps, and in its finer half as well, but scatter; NaN where they do not."""
    if len(log_step) <= LEAST_RUNS or log_step[0] - log_step[-1] < np.log(LASTING_STEPS_RATIO):
        return float("nan")
    slope, (_, finer) = _fit_slope(log_step, log_error), _fit_halves(log_step, log_error)
    return slope if min(slope, finer) >= SMALLEST_ORDER else float("nan")


def _fit_halves(log_step: np.ndarray, log_error: np.ndarray) -> tuple[float, float]:
    """Slopes of the coarser and of the finer runs; those in the middle are in both."""
    count = len(log_step) // 2 + 1
    return _fit_slope(log_step[:count], log_error[:count]), _fit_slope(log_step[-count:], log_error[-count:])


def _fit_slope(log_step: np.ndarray, log_error: np.ndarray) -> float:
    return float(np.polyfit(log_step, log_error, 1)[0])


__all__ = ["fit_order", "fit_scattered_order"]
