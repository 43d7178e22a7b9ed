"""The program of a setting: what to write to have the run that is seen."""

from collections.abc import Callable

from physjax.live.sources import Built
from physjax.particles import callable_name
from physjax.stepping.methods import METHODS, SPECIAL_METHODS


def write_code(
    build: Callable, scene_name: str | None, numbers: dict[str, float], method: Callable, steps: int, built: Built
) -> str:
    """Lines that run the scene with these settings, in a number of steps that fill its duration."""
    arguments = ", ".join(f"{name}={_write_number(value)}" for name, value in numbers.items())
    own_name = callable_name(method)
    known = (METHODS | SPECIAL_METHODS).get(own_name) is method
    step = _write_number(built.duration / steps)
    run = f"simulate(scene, {'methods.' if known else ''}{own_name}, dt={step}, steps={steps})"
    if scene_name is not None:
        first = [
            f"from physjax import {'methods, ' if known else ''}scenes, simulate",
            "",
            f'scene = scenes.SCENES["{scene_name}"]({arguments}).scene',
        ]
    else:
        builder = getattr(build, "__name__", "build")
        called = f"{'build' if builder == '<lambda>' else builder}({arguments})"
        first = [
            f"from physjax import {'methods, ' if known else ''}simulate",
            "",
            f"scene = {called}{'.scene' if built.problem is not None else ''}",
        ]
    return "\n".join([*first, f"flight = {run}", "flight.plot()"])


def _write_number(value: float) -> str:
    return repr(value) if isinstance(value, int) else repr(float(f"{value:.8g}"))


__all__ = ["write_code"]
