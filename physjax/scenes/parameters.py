"""The numbers that scenes are built from: their units, what they may be, and over which range they are worth a look.

A number has one meaning in all scenes, and so one unit and one set of values that make sense. A scene of yours may
have numbers that are not listed here: they have no unit, any value, and a range around their default.
"""

import inspect
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

LARGEST = 1e9
"""Stands for no upper bound: numbers in SI units beyond it are mistakes."""
BOUNDS: dict[str, tuple[str, float, float]] = {
    "amplitude": ("rad", 0.01, 3.1),
    "angle": ("rad", -1.5, 1.55),
    "area": ("m²", 1e-6, LARGEST),
    "arm": ("m", 0.1, 0.9),
    "breaks_at": ("strain", 1e-4, 1.0),
    "coefficient": ("", 1e-3, 100.0),
    "cone": ("rad", 0.0, 1.5),
    "cooling": ("s", 0.01, 100.0),
    "count": ("", 2, 4096),
    "columns": ("", 2, 200),
    "density": ("kg/m³", 1.0, 990.0),
    "drop": ("m", 0.0, 100.0),
    "eccentricity": ("", 0.0, 0.999),
    "eddies": ("m/s", 0.0, 10.0),
    "fall": ("m/s", 0.1, 10.0),
    "friction": ("", 0.0, 5.0),
    "g": ("m/s²", 0.1, 100.0),
    "heavy": ("kg", 0.5, 20.0),
    "height": ("m", 0.2, 10.0),
    "impulse": ("N s", 0.0, 1e6),
    "jump": ("m", 0.1, 5.0),
    "lean": ("rad", -0.7, 0.7),
    "length": ("m", 1e-3, 1e3),
    "lift": ("rad", 0.0, 1.5),
    "links": ("", 2, 400),
    "mass": ("kg", 1e-6, LARGEST),
    "nodes": ("", 2, 200),
    "nudge": ("rad/s", 0.0, 10.0),
    "offset": ("m", -0.04, 0.04),
    "orbits": ("", 1, 100),
    "particles": ("", 1, 100_000),
    "push": ("rad/s", 0.0, 10.0),
    "radius": ("m", 1e-4, 1e3),
    "rate": ("1/s", 1e-9, 1e6),
    "ratio": ("", 0.01, 1e5),
    "response_time": ("s", 0.05, 10.0),
    "restitution": ("", 0.0, 1.0),
    "rise": ("m/s", 0.0, 20.0),
    "rows": ("", 2, 200),
    "seed": ("", 0, 2**31 - 1),
    "side": ("m", 1e-3, 1e3),
    "sizes": ("", 2, 8),
    "slope": ("rad", 0.0, 1.5),
    "spacing": ("m", 1e-6, 1e3),
    "span": ("m", 1e-3, 1e4),
    "speed": ("m/s", 0.0, 1e4),
    "spin": ("rad/s", 0.1, 1e4),
    "steepness": ("", 0.05, 1.5),
    "stiffness": ("N/m", 1e-3, LARGEST),
    "tilt": ("rad", 0.01, 3.1),
    "torque": ("N m", 0.0, 1e4),
    "travel": ("m", 0.1, 10.0),
    "wind": ("m/s", -100.0, 100.0),
    "wobble": ("rad/s", 0.0, 1e4),
}
"""Unit, least and greatest value, by the name of the number."""
OWN_UNITS = {"breaking_bridge.rate": "N/s", "motor_car.speed": "rad/s"}
"""Units that differ from those of the name, by scene."""
OWN_RANGES = {
    "fire.rate": (50.0, 400.0),
    "fountain.rate": (20.0, 200.0),
    "hanging_rope.length": (1.1, 2.6),
    "hanging_rope.span": (0.4, 1.25),
    "heavy_top.length": (0.02, 0.06),
    "heavy_top.spin": (80.0, 200.0),
    "projectile.angle": (0.1, 1.5),
    "smoke.rate": (20.0, 150.0),
    "snow.rate": (10.0, 100.0),
    "sparks.rate": (30.0, 250.0),
}
"""Ranges that are not around the default, by scene and number: what is beyond them cannot be built."""
RANGE_RATIO = 2.0
"""Numbers are looked at from half their default to twice it, where their bounds allow."""


class Parameter(NamedTuple):
    """A number of a scene: its default, its unit, and the range that is worth a look; None for what is no single number."""

    name: str
    default: object
    unit: str
    low: float | None
    high: float | None


def read_parameters(build: Callable) -> list[Parameter]:
    """The numbers that a scene is built from, in the order of its arguments."""
    return [_describe(build, p) for p in inspect.signature(build).parameters.values()]


def _describe(build: Callable, parameter: inspect.Parameter) -> Parameter:
    name, default = parameter.name, parameter.default
    unit, least, most = BOUNDS.get(name, ("", -LARGEST, LARGEST))
    unit = OWN_UNITS.get(f"{build.__name__}.{name}", unit)
    if isinstance(default, bool) or not isinstance(default, int | float) or name == "seed":
        return Parameter(name, default, unit, None, None)
    if f"{build.__name__}.{name}" in OWN_RANGES:
        return Parameter(name, default, unit, *OWN_RANGES[f"{build.__name__}.{name}"])
    around = sorted((default / RANGE_RATIO, default * RANGE_RATIO)) if default else [-1.0, 1.0]
    low, high = max(around[0], least), min(around[1], most)
    if isinstance(default, int):
        low, high = int(np.ceil(low)), int(high)
    return Parameter(name, default, unit, low, high)


def demand_sensible(build: Callable, arguments: tuple, numbers: dict[str, object]) -> None:
    """Raise a plain error for a number that the scene cannot be built from."""
    parameters = inspect.signature(build).parameters
    given = dict(zip(parameters, arguments, strict=False)) | numbers
    for name, value in given.items():
        if name not in parameters:
            known = ", ".join(parameters) or "it has none"
            raise TypeError(f"{build.__name__}: got a number {name!r}, expected one of its own: {known}.")
        default = parameters[name].default
        if isinstance(default, bool) or not isinstance(default, int | float):
            continue
        if isinstance(value, str | bytes | bool) or value is None:
            raise TypeError(f"{build.__name__}: {name}: got {value!r}, expected a number, e.g. {name}={default}.")
        if isinstance(value, int | float | np.number):
            _demand_in_bounds(build.__name__, name, default, value)


def _demand_in_bounds(scene: str, name: str, default: float, value: "float | np.number") -> None:
    unit, least, most = BOUNDS.get(name, ("", -LARGEST, LARGEST))
    unit = OWN_UNITS.get(f"{scene}.{name}", unit)
    title = f"{scene}: {name}{f' [{unit}]' if unit else ''}"
    if isinstance(default, int) and not isinstance(value, int | np.integer):
        raise TypeError(f"{title}: got {value!r}, expected a whole number, e.g. {name}={default}.")
    if not least <= value <= most:
        ends = f"from {least:g}" + (f" to {most:g}" if most < LARGEST else " on")
        ends = "a finite number" if least == -LARGEST else ends
        raise ValueError(f"{title}: got {value:g}, expected {ends}, e.g. {name}={default:g}.")


__all__ = ["Parameter", "demand_sensible", "read_parameters"]


def __dir__() -> list[str]:
    return __all__
