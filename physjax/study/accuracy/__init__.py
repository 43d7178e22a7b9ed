"""Speed against accuracy: how wrong is a run, what does it cost, and which method is cheapest for an error you can bear?

Everything is computed in float64 unless another dtype is asked for, errors are measured in positions, relative to how
far the reference moves, and a run that fails is kept and marked, never dropped.
"""

from physjax.study.ablation.ablate import ablate
from physjax.study.accuracy.error_measures import energy, final, momentum, outcome, path, penetration
from physjax.study.accuracy.recommend import recommend
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.study.accuracy.runs import Budget
from physjax.study.accuracy.work_precision import QUICK, THOROUGH, TOLERANCES, default_rivals, work_precision

__all__ = [
    "QUICK",
    "THOROUGH",
    "TOLERANCES",
    "Budget",
    "Run",
    "WorkPrecision",
    "ablate",
    "default_rivals",
    "energy",
    "final",
    "momentum",
    "outcome",
    "path",
    "penetration",
    "recommend",
    "work_precision",
]


def __dir__() -> list[str]:
    return __all__
