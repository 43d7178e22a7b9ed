"""Methods that have been renamed: a class of a user that overrides one by its old name is served, with a note."""

import sys
import warnings
from typing import Any

FORCE_OLD_NAMES = {"during": "averaged_over_step", "near": "linearised_at", "definite": "dissipative_symmetric"}
"""What the abilities of a force were called in the first edition."""
CONTACT_OLD_NAMES = {
    "gap": "signed_distance",
    "answered": "resolve",
    "forgetting": "forget_lanes",
    "prepared": "prepare",
}
"""What the methods of a contact were called in the first edition."""


def serve_old_names(cls: type, new_names: dict[str, str]) -> None:
    """Let a class be written and called with the old names of its methods; `new_names` maps each to the name it has now.

    Call it from `__init_subclass__`, and once for the base class itself. Where a class defines an old name, the new one is
    bound to the same function and a FutureWarning says so, once for each class. Where it defines the new one, the old one
    is an alias. A field of data may have an old name and is left alone, unless the new name is itself a flag and no method.
    """
    for old, new in new_names.items():
        old_owner, new_owner = _find_owner(cls, old), _find_owner(cls, new)
        if old_owner < new_owner:
            _bind_new_name(cls, old, new, vars(cls.__mro__[old_owner])[old])
        elif new_owner < old_owner:
            setattr(cls, old, OldName(old, new, cls.__mro__[new_owner]))


class OldName:
    """The old name of a method, as a descriptor: what a class has under the new name, bound to the instance.

    On the class itself it is absent: a dataclass takes every attribute of a base for the default of a field of that name.
    It looks the new name up in the class that defines it and not on the instance, so that `super().gap(...)` in a method
    that overrides it reaches the parent's and not itself.
    """

    def __init__(self, old: str, new: str, owner: type):
        self.old, self.new, self.owner = old, new, owner

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        """The method under its new name; an AttributeError on the class."""
        if instance is None:
            raise AttributeError(f"type object {self.owner.__name__!r} has no attribute {self.old!r}")
        value = vars(self.owner)[self.new]
        return value.__get__(instance, owner) if hasattr(value, "__get__") else value


def _find_owner(cls: type, name: str) -> int:
    """The place in the order of method resolution of the class that defines a name; behind all if none does.

    An alias made here is no definition.
    """
    defined = (vars(base).get(name) for base in cls.__mro__)
    owners = (place for place, value in enumerate(defined) if value is not None and not isinstance(value, OldName))
    return next(owners, len(cls.__mro__))


def _bind_new_name(cls: type, old: str, new: str, value: Any) -> None:
    """Give a class under the new name what it, or a base of its own, defines under the old one."""
    if callable(value) or hasattr(value, "__get__"):
        bound = value
    elif callable(getattr(cls, new, None)):
        return  # a number that happens to be called so
    else:
        bound = _read_attribute(old)
    setattr(cls, new, bound)
    file, line = _find_line_in(cls.__module__)
    warnings.warn_explicit(
        f"{cls.__name__}: got the method {old}, which is now called {new}. It works as before; rename it to {new}.",
        FutureWarning,
        file,
        line,
    )


def _read_attribute(name: str) -> property:
    """A property that reads another attribute: a flag may be a field, whose value only the instance knows."""

    def read(self):
        return getattr(self, name)

    return property(read)


def _find_line_in(module: str) -> tuple[str, int]:
    """File and line where the module is that defines a class, up the stack: metaclasses and type checkers stand between."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__") != module:
        frame = frame.f_back
    return frame.f_code.co_filename, frame.f_lineno
