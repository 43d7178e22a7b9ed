"""The rarer options of the two questions of this folder, as records whose fields are accepted as keywords as well."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from jax.typing import ArrayLike, DTypeLike

from physjax.checks import demand_known
from physjax.study.accuracy.error_measures import ErrorMeasure
from physjax.study.energy.quantities import Conserved

if TYPE_CHECKING:
    import diffrax

TOLERANCES = tuple(10.0**-k for k in range(2, 13))
"""Tolerances at which adaptive methods run."""


class Budget(NamedTuple):
    """How long a study may take: refine a step until one run costs `seconds`, time each run `repeats` times.

    Example:
        >>> accuracy.Budget(seconds=0.2)
        Budget(seconds=0.2, repeats=5, refinement=1.5)
    """

    seconds: float = 0.05
    repeats: int = 5
    refinement: float = 1.5


THOROUGH = Budget()
"""Step sizes half an order apart, each timed well."""
QUICK = Budget(seconds=0.01, repeats=2, refinement=2.0)
"""A look in a few seconds."""


class Options(NamedTuple):
    """The rarer options of `work_precision`, each accepted there as a keyword as well.

    `conserved`: quantities that the physics of a scene keeps. `norms`: errors measured besides those of the path and its
    end. `rivals`: diffrax solvers, run adaptively at the `tolerances`; Tsit5 and Dopri8 by default, none where the scene
    has contacts or forces that remember. `dtype` may be several, side by side. Times are those of `batch` copies at once.
    With `gradient` the derivative of the path by the start's velocity, in a random direction, is studied as well. `name`
    is the scene's in titles. `progress(what)` is called before each method.

    Example:
        >>> accuracy.Options(batch=100).batch
        100
    """

    conserved: Sequence[Conserved] = ()
    norms: Sequence[ErrorMeasure | Callable] = ()
    rivals: Sequence["diffrax.AbstractERK"] | None = None
    tolerances: Sequence[float] = TOLERANCES
    dtype: DTypeLike | list[DTypeLike] | tuple[DTypeLike, ...] = np.float64
    batch: int = 1
    gradient: bool = False
    name: str = "scene"
    progress: Callable[[str], object] = lambda what: None


class SearchOptions(NamedTuple):
    """The rarer options of `recommend`, each accepted there as a keyword as well.

    With `gradient` the derivative of the path by the start's velocity, in a random direction, must keep the error as well,
    and its time by forward mode counts. Errors are in units of `scale` where it is given. `dtypes`: float types to choose
    from. Errors are measured at `frames` equally spaced moments. `starts`: how many starts nearby are run for the bound on
    the error, whose confidence is starts / (starts + 1); fewer where there is no time. `progress`: show a bar.

    Example:
        >>> accuracy.SearchOptions(gradient=True).frames
        32
    """

    gradient: bool = False
    scale: ArrayLike | None = None
    dtypes: Sequence[DTypeLike] = (np.float64, np.float32)
    frames: int = 32
    starts: int = 19
    progress: bool = True


AnyOptions = TypeVar("AnyOptions", Options, SearchOptions)


def merge_options(call: str, options: AnyOptions, keywords: Mapping[str, object]) -> AnyOptions:
    """The options with keywords in place of their fields; a TypeError for a keyword that is none of them."""
    for name in keywords:
        try:
            demand_known(f"{call}: option", name, options._fields)
        except ValueError as error:
            raise TypeError(str(error)) from None
    return options._replace(**keywords)
