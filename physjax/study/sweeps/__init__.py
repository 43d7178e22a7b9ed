"""Parameter sweeps: a measure at every point of a design, in batches, resumable, each failure with a reason of its own."""

from physjax.study.sweeps.design import latin_hypercube, sobol
from physjax.study.sweeps.result import Sweep, load
from physjax.study.sweeps.sweep import sweep

__all__ = ["Sweep", "latin_hypercube", "load", "sobol", "sweep"]


def __dir__() -> list[str]:
    return __all__
