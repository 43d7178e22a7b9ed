"""What can be set in a live view: numbers with a range, and the settings that are made of them."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

RESERVED = ("duration", "methods", "dt", "frames", "title")
"""Names of the live view's own arguments, which no parameter of `build` can have."""
SLIDER_STOPS = 400
"""A slider has this many stops: one for each pixel of a wide one."""
WIDE_RATIO = 30.0
"""A range of positive numbers wider than this is on a logarithmic scale."""
EXAMPLE = "e.g. speed=(10, 50), or (10, 50, 30) to start at 30"
"""How a range is written, for messages."""


class Slider(NamedTuple):
    """A number that can be set between `low` and `high`, `start` at first; `whole` numbers alone, or on a `logarithmic` scale."""

    name: str
    low: float
    high: float
    start: float
    unit: str = ""
    whole: bool = False
    logarithmic: bool = False

    def clip(self, value: object) -> float:
        """A value as it can be set; ValueError for what is no number."""
        if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(float(value)):
            raise ValueError(f"{self.name}: got {value!r}, expected a number from {self.low:g} to {self.high:g}.")
        inside = min(max(float(value), self.low), self.high)
        return round(inside) if self.whole else inside

    def describe(self) -> dict[str, Any]:
        """What the page needs to know."""
        return self._asdict() | {"stops": SLIDER_STOPS}


class Settings(NamedTuple):
    """Numbers by name, the name of the method, and dt [s]."""

    numbers: dict[str, float]
    method: str
    dt: float


def read_slider(name: str, given: Any, *, unit: str = "", whole: bool = False) -> Slider:
    """A slider from `(low, high)` or `(low, high, start)`; ValueError or TypeError for anything else."""
    try:
        numbers = [float(number) for number in given]
    except (TypeError, ValueError):
        raise TypeError(f"{name}: got {given!r}, expected a range, {EXAMPLE}.") from None
    if len(numbers) not in (2, 3) or not np.isfinite(numbers).all() or not numbers[0] < numbers[1]:
        raise ValueError(f"{name}: got {given!r}, expected two finite numbers, the lower first, {EXAMPLE}.")
    low, high = numbers[:2]
    logarithmic = not whole and low > 0 and high / low > WIDE_RATIO
    middle = np.sqrt(low * high) if logarithmic else (low + high) / 2
    start = numbers[2] if len(numbers) == 3 else float(f"{middle:.2g}")
    if not low <= start <= high:
        raise ValueError(f"{name}: got the start {start:g}, expected one from {low:g} to {high:g}.")
    return Slider(name, low, high, round(start) if whole else start, unit, whole, logarithmic)


def demand_parameters(build: Callable, given: Mapping[str, object]) -> None:
    """Raise a plain error for numbers that `build` does not take, or that it needs and are not given."""
    name = getattr(build, "__name__", type(build).__name__)
    parameters = inspect.signature(build).parameters
    reserved = [parameter for parameter in parameters if parameter in RESERVED]
    if reserved:
        raise ValueError(
            f"explore: {name} takes {reserved[0]!r}, which is an argument of explore itself. Give it another name."
        )
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    unknown = [key for key in given if key not in parameters]
    if unknown:
        known = ", ".join(parameters) or "none"
        raise ValueError(f"explore: {name} takes no {unknown[0]!r}, expected one of its own: {known}.")
    missing = [
        key
        for key, p in parameters.items()
        if p.default is p.empty and p.kind is not p.VAR_POSITIONAL and key not in given
    ]
    if missing:
        raise ValueError(f"explore: {name} needs a range for {missing[0]!r}, {EXAMPLE.replace('speed', missing[0])}.")


def takes_whole_number(build: Callable, name: str) -> bool:
    """Whether a parameter of `build` is a whole number, by its default or its annotation."""
    parameter = inspect.signature(build).parameters.get(name)
    return parameter is not None and (type(parameter.default) is int or parameter.annotation in (int, "int"))


__all__ = ["Settings", "Slider", "demand_parameters", "read_slider", "takes_whole_number"]
