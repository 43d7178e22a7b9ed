"""How long the gradient of a run can be trusted: how its sensitivity to the start grows, and whether `jax.grad` is right."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import as_real_quantity, demand_known
from physjax.compiling import announce_compiling
from physjax.scene import Scene
from physjax.stepping.simulate import simulate
from physjax.trajectory import Trajectory
from physjax.vectors import dot, norm

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MISMATCH_ROUNDING_FACTOR = 100.0
"""The two modes may differ by this many times the share to which rounding grows along a path."""
MAX_PROBES = 32
"""Directions of deviation: all of them up to this number; else random ones, whose mean square is right to a quarter."""
STILL_ROUNDINGS = 64
"""Roundings of the largest place within which a path counts as one that never leaves its start."""


class GradientHealth(eqx.Module):
    """How a small deviation of the start grows, for each lane, or for each scene where lanes are coupled.

    `sensitivity` is its root mean square growth over all directions, |∂x(t)/∂x(0)|/√n: [m per m], or [m per m/s] if the
    deviation is `of` the velocity. It grows as e^(rate t) where it is `exponential`, else as t^power; the other number is
    then 0. `limit` is the sensitivity at which the error of the start has become the given fraction of the path, `horizon`
    [s] the time at which it does: beyond it a gradient says nothing about the true path. A horizon beyond the run is
    extrapolated by the law found. `mismatch` is how far `jax.grad` is from forward mode, relative to the derivative,
    infinite where it is not finite (None where it was not measured): where that is more than rounding, the gradient is not
    `ok`, and its horizon is 0.

    Example:
        >>> found = gradients.health(shot, methods.verlet, dt=0.1, steps=20, of="velocity")
        >>> isinstance(found, gradients.GradientHealth), bool(found.exponential)
        (True, False)
    """

    time: Float[Array, "frames *units"]
    sensitivity: Float[Array, "frames *units"]
    exponential: Bool[Array, "*units"]
    rate: Float[Array, "*units"]
    power: Float[Array, "*units"]
    limit: Float[Array, "*units"]
    horizon: Float[Array, "*units"]
    mismatch: Float[Array, "*units"] | None
    ok: Bool[Array, "*units"]
    fraction: Float[Array, ""]
    of: str = eqx.field(static=True)

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw the sensitivity over time, its limit and the horizon; returns the axes."""
        from physjax.study.inverse.gradient_chart import draw_gradient_health

        return draw_gradient_health(self, ax)


@announce_compiling("the gradients")
def health(
    scene: Scene,
    method: Callable,
    *,
    dt: ArrayLike,
    steps: int | None = None,
    duration: float | None = None,
    save_every: int = 1,
    of: str = "position",
    error: ArrayLike | None = None,
    size: ArrayLike | None = None,
    fraction: ArrayLike = 0.1,
    reverse: bool | None = None,
) -> GradientHealth:
    """How the sensitivity of a run to its start grows with its length, and until when its gradient can be trusted.

    Forward mode carries deviations of the start, `of` its "position" or its "velocity", along the frames of
    `simulate(scene, method, dt=..., steps=..., save_every=...)`: every direction where there are up to 32, as many random
    ones where there are more. `error` [m] or [m/s] is the error of the start: rounding by default, ε times the largest
    position (velocity); for that of the method give its error over a characteristic time. The horizon is where error
    times sensitivity reaches the `fraction` of `size` [m], by default of the extent of the path at its frames. Reverse
    mode is compared with it along one random mixture of the frames, unless `reverse=False`. Works under vmap and jit. Raises
    ValueError or TypeError for bad numbers, as `simulate` does; a run that blows up has an infinite sensitivity from there
    on.

    Example:
        >>> found = gradients.health(shot, methods.verlet, dt=0.1, steps=20, of="velocity")
        >>> round(float(found.power), 3), round(float(found.sensitivity[-1]), 3)
        (1.0, 2.0)
    """
    demand_known("kind of deviation", of, ("position", "velocity"))
    fraction = as_real_quantity("fraction", fraction, above=0.0)
    if error is not None:
        error = as_real_quantity(f"error [{'m' if of == 'position' else 'm/s'}]", error, above=0.0)
    if size is not None:
        size = as_real_quantity("size [m]", size, above=0.0)
    start = scene.state.position if of == "position" else scene.state.velocity

    def positions(leaf: Array) -> tuple[Array, Trajectory]:
        moved = scene.replace(state=scene.state._replace(**{of: leaf}))
        run = simulate(moved, method, dt=dt, steps=steps, duration=duration, save_every=save_every)
        return jnp.asarray(run.position), run

    spread = _push_deviations(scene, positions, start)
    run, sensitivity = spread.run, spread.sensitivity
    limit = _find_limit(scene, run, of, error, size, fraction)
    moments = jnp.asarray(run.time)
    time = moments.reshape(moments.shape + (1,) * (sensitivity.ndim - moments.ndim))
    law = _fit_growth_law(time, sensitivity)
    horizon = _find_horizon(time, sensitivity, limit, *law)
    mismatch, ok = None, jnp.ones(horizon.shape, bool)
    if reverse is not False:
        pull = jax.vjp(lambda leaf: positions(leaf)[0], start)[1]
        mismatch, ok, whole = _check_reverse_mode(scene, spread, pull, limit)
        horizon = jnp.where(ok | ~whole, horizon, 0.0)
    return GradientHealth(moments, sensitivity, *law, limit, horizon, mismatch, ok, fraction, of)


def _check_reverse_mode(
    scene: Scene, spread: "_Spread", pull: Callable[[Array], tuple[Array]], limit: Array
) -> tuple[Array, Array, Array]:
    """How far reverse mode is from forward mode, whether that is rounding, and for which units forward mode is finite."""
    mismatch, whole = _measure_mismatch(scene, spread, pull)
    # where paths from rounded starts go apart, so do the two programs
    growth = jnp.max(spread.sensitivity, axis=0) / limit
    allowed = float(jnp.finfo(spread.sensitivity.dtype).eps) ** 0.5 + MISMATCH_ROUNDING_FACTOR * growth
    return mismatch, jnp.isfinite(mismatch) & (mismatch <= allowed), whole


class _Spread(NamedTuple):
    """A run, the directions in which its start deviates, how its frames move with each, and the root mean square of that."""

    run: Trajectory
    directions: Float[Array, "ways *lanes dim"]
    moves: Float[Array, "ways frames *lanes dim"]
    sensitivity: Float[Array, "frames *units"]


def _push_deviations(scene: Scene, positions: Callable[[Array], tuple[Array, Trajectory]], start: Array) -> _Spread:
    """The run with deviations of its start carried along it in forward mode."""
    directions = _choose_directions(scene)
    push = lambda way: jax.jvp(positions, (start,), (jnp.broadcast_to(way, start.shape),), has_aux=True)  # noqa: E731
    _, moves, run = jax.vmap(push, out_axes=(None, 0, None))(directions)
    square = jnp.mean(dot(moves, moves), axis=0)
    sensitivity = jnp.sqrt(jnp.sum(square, axis=-1) if scene.couples else square)
    return _Spread(run, jnp.broadcast_to(directions, (len(directions), *start.shape)), moves, sensitivity)


def _find_limit(
    scene: Scene, run: Trajectory, of: str, error: Array | None, size: Array | None, fraction: Array
) -> Float[Array, "*units"]:
    """The sensitivity at which the error of the start has become the fraction of the size of the path."""
    position = jnp.asarray(run.position)
    eps = float(jnp.finfo(position.dtype).eps)
    if error is None:
        typical = _find_largest(scene, norm(position if of == "position" else jnp.asarray(run.velocity)))
        error = eps * jnp.where(typical > 0, typical, 1.0)
    if size is None:
        extent, place = (_find_largest(scene, norm(x)) for x in (position - position[:1], position))
        # frames at which it is always back at its start show no extent, but for rounding
        size = jnp.where(extent > STILL_ROUNDINGS * eps * place, extent, place)
    return jnp.broadcast_to(fraction.astype(position.dtype) * size / error, scene.status_shape)


def _measure_mismatch(
    scene: Scene, spread: _Spread, pull: Callable[[Array], tuple[Array]]
) -> tuple[Float[Array, "*units"], Bool[Array, "*units"]]:
    """How far reverse mode is from forward mode, as a share; and for which units forward mode is finite.

    Both give the derivative of one random mixture of all frames' positions along every direction that was pushed.
    """
    moves, sensitivity = spread.moves, spread.sensitivity
    shape = sensitivity.shape + (1,) * (moves.ndim - 1 - sensitivity.ndim)
    whole = jnp.all(jnp.isfinite(sensitivity), axis=0)
    known = whole[None] & (sensitivity > 0)
    # frames weigh alike: the last ones would drown the first in a run whose sensitivity grows exponentially
    weight = jnp.where(known, 1.0 / jnp.where(known, sensitivity, 1.0), 0.0).reshape(shape)
    mixture = weight * jax.random.normal(jax.random.key(1), moves.shape[1:], moves.dtype)
    (gradient,) = pull(mixture)
    over_nodes = lambda number: jnp.sum(number, axis=-1) if scene.couples else number  # noqa: E731
    forward = over_nodes(jnp.sum(dot(jnp.broadcast_to(mixture, moves.shape), moves), axis=1))
    backward = over_nodes(dot(jnp.broadcast_to(gradient, spread.directions.shape), spread.directions))
    size = jnp.sqrt(jnp.mean(forward**2, axis=0))
    apart = jnp.sqrt(jnp.mean((backward - forward) ** 2, axis=0)) / jnp.where(size > 0, size, 1.0)
    return jnp.where(jnp.isfinite(apart), apart, jnp.inf), whole


def _choose_directions(scene: Scene) -> Array:
    """Directions of the start's deviation, of length 1 on average: `(ways, *lanes, dim)`, with 1 for independent lanes."""
    shape = scene.state.position.shape[-1 - scene.couples :]
    count = shape[0] * shape[-1] if scene.couples else shape[-1]
    if count <= MAX_PROBES:
        return jnp.eye(count, dtype=scene.state.dtype).reshape(count, *_leading_shape(scene), *shape)
    random = jax.random.normal(jax.random.key(0), (MAX_PROBES, *shape), scene.state.dtype) / count**0.5
    return random.reshape(MAX_PROBES, *_leading_shape(scene), *shape)


def _leading_shape(scene: Scene) -> tuple[int, ...]:
    """An axis of length 1 for each axis of independent lanes or scenes: all deviate alike."""
    return (1,) * len(scene.status_shape)


def _find_largest(scene: Scene, length: Array) -> Array:
    """The largest finite length over the frames, and over the nodes where they are coupled."""
    largest = jnp.max(jnp.where(jnp.isfinite(length), length, 0.0), axis=0)
    return jnp.max(largest, axis=-1) if scene.couples else largest


def _log_peak_sensitivity(sensitivity: Array) -> Array:
    """The logarithm of the largest sensitivity so far; infinite from where the run blew up."""
    whole = jnp.where(jnp.isfinite(sensitivity), sensitivity, jnp.inf)
    return jnp.log(jnp.maximum(lax.cummax(whole, axis=0), float(jnp.finfo(sensitivity.dtype).tiny)))


def _fit_growth_law(time: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
    """Whether the growth is exponential, its rate [1/s], and else its power of time, by least squares of its logarithm.

    Over a short span the two are alike: nine tenths of the run decide which it is, the second half how fast it grows.
    """
    grown = _log_peak_sensitivity(sensitivity)

    def fit_both_laws(first):
        return [_fit_slope(t, grown[first:]) for t in (time[first:], jnp.log(time[first:]))]

    (_, exponential_misfit), (_, power_misfit) = fit_both_laws(1 + len(time) // 10)
    (rate, _), (power, _) = fit_both_laws(len(time) // 2)
    exponential = exponential_misfit < power_misfit
    return exponential, jnp.where(exponential, rate, 0.0), jnp.where(exponential, 0.0, power)


def _fit_slope(x: Array, y: Array) -> tuple[Array, Array]:
    """The slope of the straight line through points along the first axis, and the sum of squares that it leaves."""
    x, y = x - jnp.mean(x, axis=0, keepdims=True), y - jnp.mean(y, axis=0, keepdims=True)
    slope = jnp.sum(x * y, axis=0) / jnp.sum(x * x, axis=0)
    return slope, jnp.sum((y - slope[None] * x) ** 2, axis=0)


def _find_horizon(
    time: Array, sensitivity: Array, limit: Array, exponential: Array, rate: Array, power: Array
) -> Float[Array, "*units"]:
    """When the sensitivity reaches its limit [s]: between two frames on a straight line of its logarithm, else by its law."""
    grown, goal = _log_peak_sensitivity(sensitivity), jnp.log(limit)
    time = jnp.broadcast_to(time, grown.shape)
    over = grown >= goal[None]
    i = jnp.clip(jnp.argmax(over, axis=0), 1, len(time) - 1)[None]
    (t0, t1), (s0, s1) = ([jnp.take_along_axis(leaf, at, axis=0)[0] for at in (i - 1, i)] for leaf in (time, grown))
    within = t0 + jnp.clip((goal - s0) / jnp.where(s1 > s0, s1 - s0, 1.0), 0.0, 1.0) * (t1 - t0)
    left = goal - grown[-1]
    later = jnp.where(
        exponential,
        time[-1] + left / jnp.where(rate > 0, rate, 1.0),
        time[-1] * jnp.exp(left / jnp.where(power > 0, power, 1.0)),
    )
    later = jnp.where((rate > 0) | (power > 0), later, jnp.inf)
    return jnp.where(jnp.any(over, axis=0), within, later)


__all__ = ["GradientHealth", "health"]


def __dir__() -> list[str]:
    return __all__
