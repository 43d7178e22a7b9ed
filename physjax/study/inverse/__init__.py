"""Questions asked backwards: which launch hits, which numbers fit, which minimise; and how far gradients can be trusted."""

from physjax.study.inverse import gradients
from physjax.study.inverse.aim import Aimed, Shot, aim_at
from physjax.study.inverse.fit import Fit, fit
from physjax.study.inverse.gradients import GradientHealth, health
from physjax.study.inverse.solve import Minimum, Solution, minimise, solve

__all__ = [
    "Aimed",
    "Fit",
    "GradientHealth",
    "Minimum",
    "Shot",
    "Solution",
    "aim_at",
    "fit",
    "gradients",
    "health",
    "minimise",
    "solve",
]


def __dir__() -> list[str]:
    return __all__
