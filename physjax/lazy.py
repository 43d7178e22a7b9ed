"""Folders whose modules are loaded when they are first named, so that importing one does not import its neighbours."""

from collections.abc import Callable, Iterable
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from physjax.name_hints import refuse_module_name


def serve_submodules(
    package: str, path: Iterable[str]
) -> tuple[list[str], Callable[[str], ModuleType], Callable[[], list[str]]]:
    """`__all__`, `__getattr__` and `__dir__` of a package of modules, for its `__init__`."""
    names = sorted(module.name for module in iter_modules(path))

    def load(name: str) -> ModuleType:
        if name in names:
            return import_module(f"{package}.{name}")
        raise refuse_module_name(package, name, lambda: names)

    return names, load, lambda: names


def call_late(name: str, *arguments: Any) -> Any:
    """Call `module:function`, loaded now: for what a noun offers and a part of the house above it does, such as drawing."""
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)(*arguments)
