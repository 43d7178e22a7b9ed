"""A scene with its own truth: how long to run it, what must hold, and how that is known."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.compiling import announce_compiling
from physjax.constraints.constraint import Constraint
from physjax.scene import Scene
from physjax.stepping import methods
from physjax.stepping.reference import cast_floats, reference
from physjax.stepping.simulate import simulate
from physjax.study.energy.quantities import Conserved
from physjax.summaries import count, describe_scene, format_number, write_summary
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    import physjax.show.drawables  # with what draws it, which a run does without

REFERENCE_STEPS_PER_FRAME = 64
"""Steps of rk4 between two moments at which errors are measured, where diffrax cannot be the reference."""

FILM_FRAMES = 512
"""A run is drawn from at least this many moments."""
REFERENCE_TOLERANCE = 1e-12
"""Tolerance of diffrax's reference, relative and absolute: near the rounding of float64."""


class Truth(NamedTuple):
    """Something that must be true of a scene: `measure(flight)` equals `expected` within `tolerance` (absolute).

    `flight` is the problem's `reference()`, so that a truth judges the physics and not a method.
    """

    statement: str
    measure: Callable[[Trajectory], ArrayLike]
    expected: np.ndarray | np.floating | float
    tolerance: np.ndarray | np.floating | float


class Problem(NamedTuple):
    """A scene, its duration [s], and what is known about it.

    `exact(times)` is the closed form, NumPy float64 with a leading axis of times; None where there is none. `conserved`
    are quantities that the physics keeps constant. `frames` is the number of equally spaced moments at which errors are
    measured. `looks` is what it is drawn as, a lattice with faces or the shapes of bodies; by default what the scene holds.
    `name` is that in the gallery.
    """

    scene: Scene
    duration: float
    exact: Callable[[np.ndarray], PyTree] | None = None
    conserved: tuple[Conserved, ...] = ()
    truths: tuple[Truth, ...] = ()
    frames: int = 32
    looks: "physjax.show.drawables.Look | None" = None
    name: str = ""

    def __repr__(self) -> str:
        """The scene, how long it takes, and what is known about it."""
        title, rows = describe_scene(self.scene)
        known = [("exact", "in closed form")] if self.exact is not None else []
        known += [("kept", conserved.name) for conserved in self.conserved]
        known += [("truth", truth.statement) for truth in self.truths]
        time = ("duration", f"{format_number(self.duration)} s, {count(self.frames, 'frame')}")
        return write_summary(f"{self.name or 'Problem'}: {title.removeprefix('Scene: ')}", [*rows, time, *known])

    @property
    def times(self) -> np.ndarray:
        """The moments at which errors are measured [s], the start included."""
        return np.linspace(0.0, self.duration, self.frames + 1)

    @property
    def is_ode(self) -> bool:
        """Whether the scene is an ordinary differential equation: no contacts, emitter, limits, nor force that remembers."""
        smooth = not any(isinstance(part, Constraint) and part.bounded for part in self.scene.forces)
        return smooth and not self.scene.contacts and self.scene.emitter is None and not self.scene.remembers

    def reference(self) -> Trajectory:
        """The most accurate run of the scene at `times`, in float64: NumPy arrays.

        By diffrax at 1e-12. A scene that is no ordinary differential equation, with contacts or with springs that
        break, is stepped by our own rk4 with `REFERENCE_STEPS_PER_FRAME` steps from each of the times to the next, contacts
        resolved as the scene has it; `parts` and `final_scene` then hold what is remembered.
        """
        with announce_compiling(self.name or "the reference"), jax.enable_x64(True):
            if self.is_ode:
                return reference(self.scene, self.times, rtol=REFERENCE_TOLERANCE, atol=REFERENCE_TOLERANCE)
            scene = cast_floats(self.scene, jnp.float64)
            steps = REFERENCE_STEPS_PER_FRAME * self.frames
            flight = simulate(
                scene, methods.rk4, dt=self.duration / steps, steps=steps, save_every=REFERENCE_STEPS_PER_FRAME
            )
            return jax.tree.map(np.asarray, flight)

    def filmed(self) -> Trajectory:
        """The reference at enough moments for a smooth picture and a film."""
        return self._replace(frames=max(self.frames, FILM_FRAMES)).reference()

    def verify(self) -> list[tuple[Truth, np.ndarray, bool]]:
        """Every truth with its measured value and whether it holds."""
        with announce_compiling(self.name or "the reference"), jax.enable_x64(True):
            flight = self.reference()
            measured = [np.asarray(truth.measure(flight)) for truth in self.truths]
        return [
            (truth, value, bool(np.all(np.abs(value - truth.expected) <= truth.tolerance)))
            for truth, value in zip(self.truths, measured, strict=True)
        ]
