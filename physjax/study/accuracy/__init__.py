"""Speed against accuracy: how wrong is a run, what does it cost, and which method is cheapest for an error that you accept?

Everything is computed in float64 unless another dtype is asked for, errors are measured in positions, relative to how
far the reference moves, and a run that fails is kept and marked, never dropped.
"""

from physjax.name_hints import hint_at_names
from physjax.study.ablation.ablate import ablate
from physjax.study.accuracy.error_measures import energy, final, momentum, outcome, path, penetration
from physjax.study.accuracy.options import QUICK, THOROUGH, TOLERANCES, Budget, Options, SearchOptions
from physjax.study.accuracy.recommend import recommend
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.study.accuracy.work_precision import default_rivals, list_compared_methods, work_precision

__all__ = [
    "QUICK",
    "THOROUGH",
    "TOLERANCES",
    "Budget",
    "Options",
    "Run",
    "SearchOptions",
    "WorkPrecision",
    "ablate",
    "default_rivals",
    "energy",
    "final",
    "list_compared_methods",
    "momentum",
    "outcome",
    "path",
    "penetration",
    "recommend",
    "work_precision",
]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
