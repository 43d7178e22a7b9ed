"""The bridge to diffrax: an independent reference for every scene, and our physics for diffrax's users.

diffrax is imported when first used; it costs a second.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import as_real_quantity
from physjax.compiling import announce_compiling
from physjax.scene import Scene
from physjax.tracebacks import shorten_tracebacks
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    import diffrax

MAX_STEPS = 1_000_000
"""Steps after which the reference gives up, with `.ok` False."""


class _VectorField(eqx.Module):
    """A scene's right-hand side in diffrax's signature; a pytree, so it is differentiable and recompiles for no number."""

    scene: Scene

    def __call__(self, t: ArrayLike, y: Any, args: Any) -> Any:
        return self.scene.rate(t, y)


def ode_term(scene: Scene) -> "diffrax.ODETerm":
    """The scene as a diffrax `ODETerm` over its state, to be used with any diffrax solver: `y0=scene.state`.

    The equations of motion between steps: without contacts, and parts with memory do not advance. Forces that
    jump at known times (`Kick`) need `ClipStepSizeController(jump_ts=discontinuities(scene))`.

    Example:
        >>> print(ode_term(shot).vf(0.0, ball, None).velocity)
        [-0.  -9.8]
    """
    import diffrax

    return diffrax.ODETerm(_VectorField(scene))


def discontinuities(scene: Scene) -> Array:
    """Times [s] at which a force of the scene jumps, sorted: an adaptive solver must stop there."""
    times = [jnp.ravel(jnp.asarray(t)) for force in scene.forces for t in force.discontinuities()]
    return jnp.sort(jnp.concatenate(times)) if times else jnp.zeros(0, scene.state.dtype)


@shorten_tracebacks
@announce_compiling("the reference")
def reference(
    scene: Scene,
    times: ArrayLike | Sequence[float],
    *,
    rtol: float = 1e-10,
    atol: float = 1e-10,
    solver: Any = None,
) -> Trajectory:
    """The scene at the given times [s] through diffrax, in float64 whatever the scene's dtype: NumPy arrays come back.

    `times` are ascending and >= 0; the scene's state holds at t = 0. Dopri8 unless another diffrax solver is given; the
    largest error of any component is held below `atol + rtol |y|` a step. A solve that fails returns `.ok` False and
    non-finite frames. Raises ValueError for bad times or tolerances.

    Example:
        >>> print(reference(shot, times=[0.0, 1.0]).position)
        [[ 0.  10. ]
         [ 3.   9.1]]
    """
    times = _check_problem(scene, times)
    as_real_quantity("rtol", rtol, above=0.0)
    as_real_quantity("atol", atol, above=0.0)
    with jax.enable_x64(True):
        scene = cast_floats(scene, jnp.float64)
        end = jnp.asarray(max(times[-1], 1e-300))
        states, success, _ = solve_ode(
            scene, jnp.asarray(times), end, jnp.asarray(rtol), jnp.asarray(atol), solver or build_default_solver(), True
        )
        ok = scene.finite(jax.tree.map(lambda leaf: leaf[-1], states)) & success
        states, ok = jax.tree.map(np.asarray, (states, ok))
    return Trajectory(
        time=times,
        state=states,
        parts=(),
        recorded=None,
        ok=ok,
        scene=scene,
        final_scene=None,
        stepper=None,
        dt=None,
        first_step=np.zeros((), np.int32),
        save_every=1,
        steps=times.size - 1,
    )


def _check_problem(scene: Scene, times: ArrayLike | Sequence[float]) -> np.ndarray:
    """The times, if they ascend and the scene is an ordinary differential equation."""
    if not isinstance(scene, Scene):
        raise TypeError(f"reference: got a {type(scene).__name__}, expected a Scene.")
    moments = np.asarray(times, float)
    if (
        moments.ndim != 1
        or not moments.size
        or not np.isfinite(moments).all()
        or moments[0] < 0
        or (np.diff(moments) <= 0).any()
    ):
        raise ValueError("reference: times must be a list of ascending finite numbers >= 0 [s].")
    if scene.emitter is not None or scene.remembers:
        raise ValueError(
            "reference: the scene has parts with memory, which an ordinary differential equation has not. Remove them."
        )
    if scene.contacts:
        raise ValueError(
            "reference: the scene has contacts, which an ordinary differential equation has not. Remove them."
        )
    return moments


def build_default_solver() -> Any:
    """Dopri8: order 8, the cheapest way to ten digits."""
    import diffrax

    return diffrax.Dopri8()


def cast_floats(tree: Any, dtype: Any) -> Any:
    """A scene (or state) with all its floating-point arrays in another dtype; for float64 inside `jax.enable_x64(True)`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype) if eqx.is_inexact_array(leaf) else leaf, tree)


@eqx.filter_jit
def solve_ode(
    scene: Scene, times: Array, end: Array, rtol: Array, atol: Array, solver: Any, strict: bool
) -> tuple[Any, Array, dict]:
    """diffrax's adaptive solve, forward only: states, success, statistics. Compiles once for all tolerances.

    With `strict` its steps are chosen by the largest component of the error and land on the times, so that no lane
    hides behind the average and nothing is interpolated; without, they are diffrax's own choice.
    """
    import diffrax

    controller = (
        diffrax.PIDController(rtol=rtol, atol=atol, norm=_max_norm)
        if strict
        else diffrax.PIDController(rtol=rtol, atol=atol)
    )
    jumps = discontinuities(scene)
    if jumps.size or strict:
        controller = diffrax.ClipStepSizeController(
            controller, step_ts=times if strict else None, jump_ts=jumps if jumps.size else None
        )
    solution = diffrax.diffeqsolve(
        ode_term(scene),
        solver,
        t0=jnp.zeros((), times.dtype),
        t1=end,
        dt0=None,
        y0=scene.state,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=controller,
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS if strict else MAX_STEPS // 10,
        throw=False,
    )
    states = jax.vmap(scene.normalised)(solution.ys)
    if scene.prescribed_motion is not None:
        states = jax.vmap(scene.prescribed_motion.prescribe)(times, states)
    return states, solution.result == diffrax.RESULTS.successful, solution.stats


def _max_norm(state: Any) -> Array:
    """The largest component of a state: no lane may hide behind the others' average."""
    return jax.tree.reduce(jnp.maximum, jax.tree.map(lambda leaf: jnp.max(jnp.abs(leaf)), state))
