"""The largest stable dt of a scene and what sets it, predicted from its forces before anything runs.

The forces are linearised about a state; their small motions have rates λ, and each method a region of λ dt in which it
keeps them bounded. Beyond the limit the fastest mode grows in every step, however accurate the rest is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.checks import as_real_quantity
from physjax.particles import Particles, callable_name
from physjax.parts import Force, as_module
from physjax.physics.springs.springs import Springs
from physjax.scene import Scene
from physjax.study.stability.linearisation import (
    DRIFT_RATE_SHARE,
    ROUNDING_RATE_SHARE,
    SmallMotion,
    follows_rates,
    linearise,
    prepare_linearisation,
    rate_text,
    spectral_radius,
    step_matrices,
)
from physjax.text import format_seconds

GROWTH_TOLERANCE = 1e-6
"""Growth of a step matrix's eigenvalue that rounding, which splits the double ones, cannot feign."""


class Region(NamedTuple):
    """Spectral radius of a method's step over a grid of z = λ dt: stable where it is at most 1.

    Example:
        >>> square = stability.region(methods.euler, real=(-1.0, 1.0), imaginary=(0.0, 1.0), points=(3, 2))
        >>> isinstance(square, stability.Region), square.radius.shape
        (True, (2, 3))
    """

    name: str
    z: np.ndarray
    radius: np.ndarray

    def plot(self, ax: Any = None) -> Any:
        """Draw where the method is stable; returns the axes."""
        from physjax.study.stability.chart import draw_region

        return draw_region(self, ax)


class Limit(NamedTuple):
    """The largest stable step of a scene under a method, and what sets it. Printed, it is a sentence.

    `dt` [s] is infinite if nothing sets it and 0 if no step is stable. `each` [s] is the same for every lane (scene,
    where lanes are coupled). `cause` is "stiffness", "damping" or "nothing"; `force` the name of the force, `spring`
    the two nodes of the spring that takes the largest part in the mode (None for other forces), `node` the lane that
    moves most, as an index. `rate` is the mode's λ [1/s].

    Example:
        >>> print(stability.limit(swing, methods.verlet))
        verlet: 1 s, set by the stiffness of Anchor, λ = ±2i 1/s
    """

    method: str
    dt: float
    each: np.ndarray
    cause: str
    force: str
    spring: tuple[int, int] | None
    node: tuple[int, ...]
    rate: complex

    def __str__(self) -> str:
        if self.cause == "nothing":
            return f"{self.method}: any step is stable, nothing swings or decays"
        if np.isinf(self.dt):
            return f"{self.method}: any step is stable"
        where = "" if self.spring is None else f" (the spring between nodes {self.spring[0]} and {self.spring[1]})"
        what = f"set by the {self.cause} of {self.force}{where}, λ = {rate_text(self.rate)} 1/s"
        return f"{self.method}: {format_seconds(self.dt) if self.dt else 'no step is stable'}, {what}"


def region(
    method: Callable, *, real: tuple = (-5.0, 1.0), imaginary: tuple = (-3.5, 3.5), points: tuple = (241, 281)
) -> Region:
    """The spectral radius of one step of a method over a grid of complex λ dt, by running the method itself.

    On x″ = −|λ|²x + 2Re(λ)x′, all grid points in one batched call, so it serves methods that kick and drift as well.

    Example:
        >>> line = stability.region(methods.euler, real=(-2.0, 0.0), imaginary=(0.0, 0.0), points=(3, 1))
        >>> print(line.radius)
        [[1. 0. 1.]]
    """
    with jax.enable_x64(True):
        z = np.linspace(*real, points[0]) + 1j * np.linspace(*imaginary, points[1])[:, None]
        return Region(callable_name(method), z, np.asarray(spectral_radius(check_method(method), jnp.asarray(z))))


def limit(scene: Scene, method: Callable, at: Particles | None = None) -> Limit:
    """The largest stable dt of a scene under a method, predicted from its forces about a state (the start, if not given).

    Modes that do not move (a free body as a whole) and those that grow by themselves (a pendulum upside down) set no
    limit. All modes of scenes with up to 300 coordinates are looked at, of larger ones the fastest. Contacts are not.

    Example:
        >>> limit = stability.limit(swing, methods.verlet)
        >>> round(limit.dt, 3), limit.cause
        (1.0, 'stiffness')
    """
    with jax.enable_x64(True):
        scene, state = prepare_linearisation(scene, at)
        module, name = check_method(method), callable_name(method)
        motion = linearise(scene, state)
        fastest = np.abs(motion.rates()).max(axis=-1)
        if not np.any(fastest > 0):
            return Limit(name, np.inf, np.full(fastest.shape, np.inf), "nothing", "", None, (), 0j)
        find = _find_limits_by_rates if motion.undamped or follows_rates(module) else _find_limits_by_steps
        each, worst_mode = find(module, motion, fastest)
        # where several blocks are as bad, or nothing sets a limit, the one that moves fastest speaks for all
        block = np.unravel_index(np.argmax(np.where(each == each.min(), fastest, -1.0)), each.shape)
        return Limit(name, float(each[block]), each, *_attribute_mode(scene, state, motion, block, worst_mode(block)))


def growth(scene: Scene, method: Callable, dt: Any, at: Particles | None = None) -> np.ndarray:
    """How much the fastest growing small motion grows in one step of dt [s]: the spectral radius of the linearised step.

    Shaped like `scene.status_shape`, as `dt` may be; 1 for a stable step. Drifts are left out. For methods without a
    stable step this is what to expect of a run.

    Example:
        >>> round(float(stability.growth(swing, methods.euler, 0.5)) ** 2, 3)
        2.0
    """
    with jax.enable_x64(True):
        scene, state = prepare_linearisation(scene, at)
        motion, method = linearise(scene, state), check_method(method)
        dt = np.broadcast_to(np.asarray(as_real_quantity("dt [s]", dt, above=0.0), float), scene.status_shape)
        if motion.undamped or follows_rates(method):
            z = _bounded_rates(motion, method) * dt[..., None]
            return np.asarray(spectral_radius(method, jnp.asarray(z))).max(axis=-1, initial=1.0)
        return np.maximum(1.0, _compute_growths(method, motion, dt, _build_growth_filter(motion)).max(axis=-1))


def grows_by_itself(scene: Scene, at: Particles | None = None) -> np.ndarray:
    """Whether small motions about a state grow whatever the method: a pendulum upside down, bodies that pass each other.

    Shaped like `scene.status_shape`. What a method adds to that cannot be seen in a run.

    Example:
        >>> bool(stability.grows_by_itself(swing))
        False
    """
    with jax.enable_x64(True):
        rates = linearise(*prepare_linearisation(scene, at)).rates()
        return rates.real.max(axis=-1) > DRIFT_RATE_SHARE * np.abs(rates).max(axis=-1)


def check_method(method: Callable) -> Any:
    """The method as part of a compiled function; a TypeError for what is none, or chooses its own steps."""
    if not callable(method):
        raise TypeError(f"stability: got the method {method!r}, expected one such as methods.rk4.")
    if hasattr(method, "method"):
        raise TypeError("stability: an adaptive method chooses its own steps; ask for the limit of the method inside.")
    return as_module(method)


def _bounded_rates(motion: SmallMotion, method: Any) -> np.ndarray:
    """Rates without those of drifts and of motions that grow by themselves, set to 0; rounding taken off undamped ones.

    Without damping a mode that grows has a partner that decays: a body that falls from a hilltop, and one that climbs it.
    Methods that kick and drift keep both at any step.
    """
    rates = motion.rates()
    fastest = np.abs(rates).max(axis=-1, keepdims=True)
    rates = np.where(np.abs(rates.real) < ROUNDING_RATE_SHARE * fastest, 1j * rates.imag, rates)
    gone = (np.abs(rates) < DRIFT_RATE_SHARE * fastest) | (rates.real > 0)
    if motion.undamped and not follows_rates(method):
        gone |= rates.real != 0
    return np.where(gone, 0.0, rates)


def _find_limits_by_rates(method: Any, motion: SmallMotion, fastest: np.ndarray) -> tuple:
    """The limit of each block where the rates decide: the first λ dt on its ray that leaves the region."""
    swinging = _bounded_rates(motion, method)
    speed = np.abs(swinging)
    directions = np.where(speed > 0, swinging / np.where(speed > 0, speed, 1.0), -1.0)
    reach = _find_reach(method, directions)
    limits = np.where(speed > 0, reach / np.where(speed > 0, speed, 1.0), np.inf)

    def worst_mode(block):
        λ, modes = motion.modes(block)
        # all are infinite or 0 under a method that is always or never stable: the fastest is then the first to go
        tie = limits[block] == limits[block].min()
        target = swinging[block][np.argmax(np.where(tie, speed[block], -1.0))]
        return modes[:, np.argmin(np.abs(λ - target))]

    return limits.min(axis=-1), worst_mode


def _find_reach(method: Any, directions: np.ndarray) -> np.ndarray:
    """How far from 0 each direction of the complex plane stays in the region; 0 if not at all, inf if beyond 100."""
    unique, back = np.unique(np.round(directions, 13), return_inverse=True)
    inside = lambda s: np.asarray(spectral_radius(method, jnp.asarray(s * unique))) <= 1 + 1e-13  # noqa: E731
    low, high, out = np.zeros(unique.shape), np.zeros(unique.shape), np.zeros(unique.shape, bool)
    for s in np.geomspace(1e-6, 100.0, 161):
        left = ~out & ~inside(s)
        low, high, out = np.where(out | left, low, s), np.where(left, s, high), out | left
    for _ in range(50):
        middle = (low + high) / 2
        good = inside(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    # on the axis a tiny step grows by less than rounding: where a larger one still inside the first exit does not, none is stable
    never = out & (unique.real == 0) & (low < 0.02)
    return np.where(out, np.where(never, 0.0, low), np.inf)[back].reshape(directions.shape)


def _find_limits_by_steps(method: Any, motion: SmallMotion, fastest: np.ndarray) -> tuple:
    """The limit of each block by the eigenvalues of the step itself: doubled until one leaves 1, then halved."""
    fastest_rate = np.where(fastest > 0, fastest, 1.0)
    rates, rest = motion.rates(), _build_growth_filter(motion)
    grows = lambda dt: np.any(_compute_growths(method, motion, dt, rest) > 1 + GROWTH_TOLERANCE, axis=-1)  # noqa: E731
    low, high, out = np.zeros(fastest_rate.shape), 0.01 / fastest_rate, np.zeros(fastest_rate.shape, bool)
    for _ in range(15):
        out = out | grows(high)
        low, high = np.where(out, low, high), np.where(out, high, 2 * high)
        if out.all():
            break
    for _ in range(14):
        middle = (low + high) / 2
        bad = grows(middle)
        low, high = np.where(bad, low, middle), np.where(bad, middle, high)
    limits = np.where(out & (fastest > 0), np.where(low < 0.01 / fastest_rate, 0.0, low), np.inf)

    def worst_mode(block):
        n = motion.stiffness.shape[-1]
        dt = np.where(out, high * 1.01, 1 / fastest_rate)
        μ, modes = np.linalg.eig(_build_step_matrices(method, motion, dt, rest)[block])
        # of those that leave, the one that is furthest from what the scene does by itself
        strange = np.abs(μ[:, None] - np.exp(rates[block] * dt[block])).min(axis=-1)
        leaves = np.abs(μ) > 1 + GROWTH_TOLERANCE
        mode = modes[:, np.argmax(np.where(leaves, 1 + strange, np.abs(μ) / np.abs(μ).max()))]
        return mode if out[block] else np.concatenate([mode[:n], mode[n:]])

    return limits, worst_mode


def _build_growth_filter(motion: SmallMotion) -> np.ndarray | None:
    """What takes the part out of a motion that grows whatever the method, for each block; None where nothing grows.

    A step of what is left is the method's doing alone. To compare eigenvalues instead would need to know which of the
    step's belongs to which of the motion's, and a slow growth is soon lost among drifts.
    """
    growth_projector = motion.growth_projector()
    return None if growth_projector is None else np.eye(growth_projector.shape[-1]) - growth_projector


def _build_step_matrices(method: Any, motion: SmallMotion, dt: np.ndarray, rest: np.ndarray | None) -> np.ndarray:
    """The step's matrix of each block, of `rest` alone where there is such."""
    n = motion.stiffness.shape[-1]
    flat = [jnp.asarray(a.reshape(-1, n, n)) for a in motion[:2]]
    found = step_matrices(method, *flat, jnp.asarray(np.reshape(dt, -1)))
    found = np.asarray(found).reshape(*motion.stiffness.shape[:-2], 2 * n, 2 * n)
    return found if rest is None else rest @ found @ rest


def _compute_growths(method: Any, motion: SmallMotion, dt: np.ndarray, rest: np.ndarray | None) -> np.ndarray:
    """The size of each eigenvalue of each block's step; the double 1 of a drift, which rounding splits, counts as 1."""
    μ = np.linalg.eigvals(_build_step_matrices(method, motion, dt, rest))
    return np.where(np.abs(μ - 1) < 1e-5, 1.0, np.abs(μ))


def _attribute_mode(scene: Scene, state: Particles, motion: SmallMotion, block: tuple, mode: np.ndarray) -> tuple:
    """Cause, force, spring, node and rate of a mode."""
    inner = motion.displacement(block, mode)
    shape = state.position.shape[len(block) :]
    weight = np.broadcast_to(np.sqrt(np.asarray(scene.mass))[..., None], state.position.shape)[block]
    moved = np.zeros(state.position.shape, complex)
    moved[block] = inner.reshape(shape) / weight
    parts = [np.asarray(_force_shares(force, scene, state, jnp.asarray(moved))) for force in scene.forces]
    stiffness, damping = np.sum(parts, axis=0)
    root = np.sqrt(complex(damping**2 / 4 - stiffness))
    rate = -damping / 2 - root
    kind = int(abs(rate.real) >= abs(rate.imag))
    force = scene.forces[int(np.argmax([abs(part[kind]) for part in parts]))]
    size = np.sum(np.abs(moved) ** 2, axis=-1)
    node = tuple(int(i) for i in np.unravel_index(np.argmax(size), size.shape))
    spring = _find_worst_spring(force, state, moved, kind, block) if isinstance(force, Springs) else None
    return ("stiffness", "damping")[kind], callable_name(force), spring, node, complex(rate)


@jax.jit
def _force_shares(force: Force, scene: Scene, state: Particles, moved: Any) -> Any:
    """What a force has in a mode's stiffness and damping: -d·∂F/∂x d and -d·∂F/∂v d."""
    held = 1.0 if scene.held is None else 1 - jnp.asarray(scene.held)[..., None].astype(state.dtype)
    still = jnp.zeros_like(state.position)
    push = lambda s: force(jnp.zeros((), s.dtype), s, scene.mass)  # noqa: E731
    change = lambda *tangent: jax.jvp(push, (state,), (Particles(*tangent),))[1]  # noqa: E731
    total = jnp.zeros(2, state.dtype)
    for part in (moved.real * held, moved.imag * held):
        total = total - jnp.stack([jnp.sum(part * change(part, still)), jnp.sum(part * change(still, part))])
    return total


def _find_worst_spring(
    springs: Springs, state: Particles, moved: np.ndarray, kind: int, block: tuple
) -> tuple[int, int]:
    """The spring that holds most of a mode's energy, or takes most of its power."""
    stretch = [
        np.asarray(
            jax.jvp(springs.length, (state,), (Particles(jnp.asarray(part), jnp.zeros_like(state.velocity)),))[1]
        )
        for part in (moved.real, moved.imag)
    ]
    number = np.asarray(springs.damping if kind else springs.stiffness)
    share = np.broadcast_to(number, stretch[0].shape) * (stretch[0] ** 2 + stretch[1] ** 2)
    first, second = springs.pairs[int(np.argmax(share[block]))]
    return int(first), int(second)
