"""Which step is safe, and why: predicted before a run, measured by runs, drawn as a map, and explained after one.

`limit` and `growth` predict from the forces of a scene, `measure_limit` and `measure_growth` run it. `region` belongs to
a method alone. `map` judges runs over methods and steps, `explain` says why one went wrong.
"""

from physjax.name_hints import hint_at_names
from physjax.study.stability.explain import Explanation, explain
from physjax.study.stability.limits import Limit, Region, grows_by_itself, growth, limit, region
from physjax.study.stability.map import StabilityMap, map
from physjax.study.stability.measured import grows, measure_growth, measure_limit

__all__ = [
    "Explanation",
    "Limit",
    "Region",
    "StabilityMap",
    "explain",
    "grows",
    "grows_by_itself",
    "growth",
    "limit",
    "map",
    "measure_growth",
    "measure_limit",
    "region",
]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
