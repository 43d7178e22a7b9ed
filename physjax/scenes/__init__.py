"""The gallery: each scene is one decorated function that carries its own truth. A new file in this folder is found by itself."""

from importlib import import_module
from pkgutil import iter_modules

from physjax.scenes.registry import FAILURES, SCENES, failure, scene, title

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["FAILURES", "SCENES", "failure", "scene", "title"]


def __dir__() -> list[str]:
    return __all__
