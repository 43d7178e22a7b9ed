"""The gallery of scenes: each is one decorated function with its own truths; every file in this folder is imported.

To add a scene, write a function that returns a `Problem` under `@scene`, in a file of this folder, old or new, and let
`catalogue.write_table()` note what `physjax scenes` says of it.
"""

from importlib import import_module
from pkgutil import iter_modules

from physjax.scenes.registry import FAILURES, SCENES, failure, scene, title

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["FAILURES", "SCENES", "failure", "scene", "title"]


def __dir__() -> list[str]:
    return __all__
