"""A recommendation: the best way to run a scene for an error, the runners-up, and the reason, printed as a table."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from physjax.scene import Scene
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import simulate
from physjax.study.accuracy.bounds import NO_BOUND, ErrorBound
from physjax.text import format_seconds, format_table
from physjax.trajectory import Trajectory


class Choice(NamedTuple):
    """A way to run the scene that keeps the error: `error` as measured, `seconds` for each second simulated.

    `dt` [s]; `tolerance` is that of a method that chooses its own steps inside dt, otherwise None.
    """

    name: str
    method: Callable
    dtype: str
    dt: float
    steps_per_frame: int
    tolerance: float | None
    error: float
    seconds: float

    @property
    def step(self) -> str:
        """Step or tolerance in words."""
        return format_seconds(self.dt) if self.tolerance is None else f"tolerance {self.tolerance:.1e}"


class Recommendation(NamedTuple):
    """What to run for an error over a horizon [s], why, and what else would do. Printed, it is a table and a sentence.

    `best` is None, and `reason` says what stops it, where nothing keeps the error. `richardson` is the error of the best
    estimated from a run with half the step, `truth_error` that of the truth; `untried` the methods for which there was no
    time. `bound` is an error that the best stays below from starts nearby, with a confidence. `lyapunov_time` [s] is that
    in which small errors of the start grow by e, where the motion is chaotic; infinite where it is not.
    """

    scene: Scene
    error: float
    horizon: float
    frames: int
    norm: str
    best: Choice | None
    runners_up: tuple[Choice, ...]
    reason: str
    truth: str
    truth_error: float
    richardson: float
    untried: tuple[str, ...]
    bound: ErrorBound = NO_BOUND
    lyapunov_time: float = float("inf")

    @property
    def error_bound(self) -> float:
        """An error that the best stays below from a start within a percent of this one, the truth's doubt included.

        With `confidence`; NaN where no start nearby was run.
        """
        return self.bound.error

    @property
    def confidence(self) -> float:
        """The probability that the error stays below `error_bound`; 0 where no start nearby was run."""
        return self.bound.confidence

    @property
    def ok(self) -> bool:
        """Whether anything keeps the error."""
        return self.best is not None

    @property
    def evidence(self) -> str:
        """How the error of the best is known."""
        if self.best is None:
            return f"truth: {self.truth}, itself right to {self.truth_error:.1e}"
        remarks = "" if np.isnan(self.richardson) else f"; by Richardson against half its step {self.richardson:.1e}"
        return f"{self.best.error:.1e} measured against {self.truth}, itself right to {self.truth_error:.1e}{remarks}"

    def simulate(
        self, *, save_every: int | None = None, record: Callable | None = None, first_step: ArrayLike = 0
    ) -> Trajectory:
        """Run the scene as recommended, over the horizon; options as for `simulate`. ValueError where nothing keeps the error."""
        if self.best is None:
            raise ValueError(f"recommend: nothing keeps an error of {self.error:g}: {self.reason}")
        best, steps = self.best, self.best.steps_per_frame
        with jax.enable_x64(best.dtype == "float64"):
            scene = cast_floats(self.scene, best.dtype)
            return simulate(
                scene,
                best.method,
                dt=best.dt,
                steps=steps * self.frames,
                save_every=steps if save_every is None else save_every,
                record=record,
                first_step=first_step,
            )

    def __str__(self) -> str:
        title = f"error {self.error:g} ({self.norm}) over {format_seconds(self.horizon)}"
        rows = [
            [c.name, c.dtype, c.step, f"{c.error:.1e}", format_seconds(c.seconds)]
            for c in (self.best, *self.runners_up)
            if c is not None
        ]
        body = (
            [format_table(["method", "float", "step", "error", "run time per s"], rows, align="<<>>>")] if rows else []
        )
        bounds = [f"Bound: {self.bound}."] if self.bound.starts else []
        if np.isfinite(self.lyapunov_time):
            bounds.append(f"Chaos: errors of the start grow by e each {format_seconds(self.lyapunov_time)}.")
        rest = [f"Not tried for lack of time: {', '.join(self.untried)}."] if self.untried else []
        return "\n".join([title, *body, f"{self.reason}", f"Evidence: {self.evidence}.", *bounds, *rest])
