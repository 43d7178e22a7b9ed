"""The result of a work-precision study: every run, what it says about each method, as table, CSV and picture."""

import csv
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from physjax.files import write_atomically
from physjax.show.style import AS_GIVEN, PROJECTED
from physjax.study.accuracy.observed_order import fit_order, fit_scattered_order
from physjax.summaries import format_number, write_grid, write_summary
from physjax.text import format_seconds, format_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLE_ERRORS = (1e-2, 1e-4, 1e-6)
"""Errors (relative to the extent of the path) for which the fastest method is named."""


MAX_EXACT_FLOOR = 1e-10
"""A truth whose own error is larger than this, relative to the path, cannot say of a run that it is exact."""
LARGEST_FITTED_ERROR = 0.05
"""Error, relative to the path, above which a run is too coarse to show its order."""


class Run(NamedTuple):
    """One run of one method. Errors are relative to the extent of the path; `drifts` to the size of the conserved quantity.

    `method` is the name in tables and charts, such as "adaptive rk4, projected, float32"; what it is made of are fields of
    their own: `scheme`, the method in the registry ("" where it is not known), or a rival; `treatment` of the contacts,
    "as given" by the scene or "projected" at the end of the step; `dtype`; and `adaptive`, for what chooses its own steps.
    `dt` [s] is None for these, `tolerance` is None for fixed steps. `errors` are those in the norms that were asked for.
    `seconds` is the least and `seconds_median` the median of several timings, without compiling.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> isinstance(chart.runs[0], accuracy.Run), chart.runs[0].dt, chart.runs[0].evaluations
        (True, 0.0625, 64)
    """

    method: str
    dt: float | None
    tolerance: float | None
    steps: int
    evaluations: int
    seconds: float
    seconds_median: float
    compile_seconds: float
    final_error: float
    path_error: float
    drifts: tuple[float, ...]
    errors: tuple[float, ...] = ()
    dtype: str = "float64"
    scheme: str = ""
    treatment: str = AS_GIVEN
    adaptive: bool = False

    @property
    def status(self) -> str:
        """`ok`; `not finite`; or `off the path`: wrong by more than the path is long."""
        if not math.isfinite(self.path_error):
            return "not finite"
        return "ok" if self.path_error <= 1.0 else "off the path"


class WorkPrecision(NamedTuple):
    """All runs of a scene under its methods and rivals, their truth, and that truth's own error (`floor`).

    `promised` has the order of each method, by its name in tables. `scattered`: contacts are resolved, or springs break, at
    the end of a step, under every method. `horizon` [s] is when rounding has grown to a hundredth of the path; infinite
    without chaos. Times are those of `batch` copies, errors in `gradients` those of the derivative by the start.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> isinstance(chart, accuracy.WorkPrecision), chart.promised
        (True, {'verlet': 2.0})
    """

    name: str
    runs: tuple[Run, ...]
    promised: dict[str, float]
    truth: str
    floor: float
    duration: float
    conserved: tuple[str, ...]
    dtype: str
    path: tuple[np.ndarray, np.ndarray]
    scattered: bool = False
    norms: tuple[str, ...] = ()
    horizon: float = math.inf
    batch: int = 1
    gradients: tuple[Run, ...] = ()

    def __repr__(self) -> str:
        """Each method with its best error and what that took."""
        return write_summary(self._title(), [(name, ", ".join(cells)) for name, *cells in self._rows()])

    def _repr_html_(self) -> str:
        return write_grid(self._title(), ("method", "smallest error", "time", "runs"), self._rows())

    def _title(self) -> str:
        whose = self.name or "a scene"
        return f"WorkPrecision of {whose}: {len(self.runs)} runs over {format_seconds(self.duration)}, {self.dtype}"

    def _rows(self) -> list[tuple[str, str, str, str]]:
        rows = []
        for name in self.methods:
            runs = [run for run in self.of(name) if run.status == "ok"]
            if not runs:
                rows.append((name, "no run is ok", "-", f"{len(self.of(name))} runs"))
                continue
            best = min(runs, key=lambda run: run.path_error)
            error = f"error {format_number(best.path_error)} of the path"
            rows.append((name, error, f"in {format_seconds(best.seconds)}", f"{len(self.of(name))} runs"))
        return rows

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods and rivals in tables, in the order they ran."""
        return tuple(dict.fromkeys(run.method for run in self.runs))

    def of(self, method: str) -> tuple[Run, ...]:
        """The runs of one method, from coarse to fine."""
        return tuple(run for run in self.runs if run.method == method)

    def observed_order(self, method: str) -> float:
        """The order that errors show: their slope against dt where it lasts; inf if all is rounding, NaN if it is unseen.

        It is that of the finest three or more runs on a line, see `observed_order.fit_order`; where contacts are projected
        or springs break, of all runs: those errors scatter with where in a step it happens to fall. The truth's own error
        counts as rounding, but no run is called exact by such a truth.
        """
        runs = [run for run in self.of(method) if run.dt is not None and run.status == "ok"]
        if runs and all(run.path_error <= self._rounding_error(run) for run in runs):
            return float("inf") if self.floor <= MAX_EXACT_FLOOR else float("nan")
        resolved = [run for run in runs if self._rounding_error(run) < run.path_error < LARGEST_FITTED_ERROR]
        scattered = self.scattered or any(run.treatment == PROJECTED for run in runs)
        fit = fit_scattered_order if scattered else fit_order
        return fit([run.dt for run in resolved if run.dt is not None], [run.path_error for run in resolved])

    def fastest(self, error: float, *, rivals: bool = True) -> Run | None:
        """The run with the least time whose path error stays below `error`; None if none does."""
        return _find_cheapest([run for run in self.runs if rivals or run.tolerance is None], error)

    @property
    def front(self) -> tuple[Run, ...]:
        """The Pareto front: the runs that no other beats in both time and error, from fast to accurate."""
        front: list[Run] = []
        for run in sorted((run for run in self.runs if run.status == "ok"), key=lambda run: run.seconds):
            if not front or run.path_error < front[-1].path_error:
                front.append(run)
        return tuple(front)

    def table(self) -> str:
        """A line for each method: order promised and observed, its least time to each of `TABLE_ERRORS`, and where it failed."""
        headers = ["method", "order", "seen", *(f"to {e:.0e}" for e in TABLE_ERRORS), "fails at dt", "compile"]
        rows = []
        for method in self.methods:
            runs = self.of(method)
            cheapest = [_find_cheapest(runs, error) for error in TABLE_ERRORS]
            failed = [run.dt for run in runs if run.dt is not None and run.status != "ok"]
            rows.append(
                [
                    method,
                    _format_number(self.promised.get(method), ".0f"),
                    _format_order(self.observed_order(method)) if method in self.promised else "-",
                    *(format_seconds(run.seconds) if run else "-" for run in cheapest),
                    format_seconds(min(failed)) if failed else "-",
                    format_seconds(runs[0].compile_seconds),
                ]
            )
        return format_table(headers, rows)

    def to_csv(self, path: str | os.PathLike) -> None:
        """Write every run as one line of a CSV file; whole or absent."""
        fields = [name for name in Run._fields if name not in ("drifts", "errors")]
        drifts = [f"drift of {name}" for name in self.conserved]
        errors = [f"error of {name}" for name in self.norms]
        with write_atomically(path) as file:
            writer = csv.writer(file)
            writer.writerow(["scene", *fields, *drifts, *errors, "status", "truth", "floor"])
            for run in self.runs:
                values = run._asdict()
                numbers = [values[name] for name in fields]
                writer.writerow([self.name, *numbers, *run.drifts, *run.errors, run.status, self.truth, self.floor])

    def plot(self, figure: "Figure | None" = None) -> "Figure":
        """Draw the study: the path, error against time, error against step, and drift or cost. Returns the matplotlib figure."""
        from physjax.study.accuracy.chart import draw_work_precision

        return draw_work_precision(self, figure)

    def _rounding_error(self, run: Run) -> float:
        """Errors below this are rounding, which grows like a random walk over the steps, or the truth's own."""
        return max(10 * self.floor, 100 * float(np.finfo(run.dtype).eps) * math.sqrt(run.steps))


def _find_cheapest(runs: Sequence[Run], error: float) -> Run | None:
    return min((run for run in runs if run.path_error <= error), key=lambda run: run.seconds, default=None)


def _format_order(order: float) -> str:
    return "exact" if math.isinf(order) else _format_number(order, ".2f")


def _format_number(value: float | None, spec: str) -> str:
    return "-" if value is None or math.isnan(value) else format(value, spec)
