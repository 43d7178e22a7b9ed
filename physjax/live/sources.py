"""Where the scene of a setting comes from, such that another number is data of the compiled program and not another program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from physjax.scene import Scene
from physjax.stepping.reference import cast_floats
from physjax.study.problem import Problem


class Built(NamedTuple):
    """A scene of certain numbers, how long it runs [s], and the problem that it came with, if any."""

    scene: Scene
    duration: float
    problem: Problem | None


class Given(eqx.Module):
    """A scene that was built before: its numbers are those of the compiled program."""

    scene: Scene

    def make(self) -> Scene:
        """The scene."""
        return self.scene


class Traced(eqx.Module):
    """A scene that is built inside of the compiled program, where its own functions may close over what is set."""

    build: Callable = eqx.field(static=True)
    whole: tuple[tuple[str, int], ...] = eqx.field(static=True)
    numbers: dict[str, Array]

    def make(self) -> Scene:
        """The scene, built from traced numbers."""
        built = self.build(**dict(self.whole), **self.numbers)
        return cast_floats(built.scene if isinstance(built, Problem) else built, jnp.float64)


Source = Given | Traced


class Builder:
    """Builds scenes from numbers, and knows what of them the compiled program is given.

    A scene whose parts are the same from one build to the next is given as it is. One with functions made anew by every
    build would be another program each time, so it is built inside of the program; where that fails, because `build` asks
    for the numbers themselves, `recompiles` is True.
    """

    def __init__(self, build: Callable, duration: float | None, numbers: dict[str, float]):
        self._build, self._duration = build, duration
        self._traces = self.recompiles = False
        if not _is_same_program(self(numbers).scene, self(numbers).scene):
            self._traces = True
            try:
                jax.eval_shape(lambda: eqx.filter(self._trace(numbers).make(), eqx.is_array))
            except (jax.errors.JAXTypeError, TypeError, ValueError):
                self._traces, self.recompiles = False, True

    def __call__(self, numbers: dict[str, float]) -> Built:
        """The scene of certain numbers, in float64; TypeError where `build` returns something else."""
        built = self._build(**numbers)
        if isinstance(built, Problem):
            scene, duration = built.scene, self._duration or float(built.duration)
            return Built(cast_floats(scene, jnp.float64), duration, built)
        if not isinstance(built, Scene):
            name = getattr(self._build, "__name__", "build")
            raise TypeError(f"explore: {name} returned a {type(built).__name__}, expected a Scene or a Problem.")
        if self._duration is None:
            raise ValueError("explore: a Scene does not say how long to run it. Give duration= [s], e.g. duration=3.0.")
        return Built(cast_floats(built, jnp.float64), self._duration, None)

    def source(self, built: Built, numbers: dict[str, float]) -> Source:
        """What the compiled program is given."""
        return self._trace(numbers) if self._traces else Given(built.scene)

    def _trace(self, numbers: dict[str, float]) -> Traced:
        whole = tuple((name, value) for name, value in numbers.items() if isinstance(value, int))
        arrays = {
            name: jnp.asarray(value, jnp.float64) for name, value in numbers.items() if not isinstance(value, int)
        }
        return Traced(self._build, whole, arrays)


def _is_same_program(a: Scene, b: Scene) -> bool:
    """Whether two scenes differ in numbers alone."""
    structures: list[Any] = [jax.tree.structure(eqx.filter(scene, eqx.is_array)) for scene in (a, b)]
    return structures[0] == structures[1]


__all__ = ["Builder", "Built", "Given", "Source", "Traced"]
