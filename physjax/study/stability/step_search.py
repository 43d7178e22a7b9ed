"""The largest step at which a method keeps every small motion bounded: by the rates alone, or by the step's own matrix.

A method that steps the whole state along its rate (`follows_rates`), or any method without damping, treats each mode by
itself: its limit is where the ray λ dt leaves the method's region. Otherwise damping couples the modes in a step that
kicks and drifts, and the eigenvalues of the step's matrix decide.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from physjax.study.stability.linearisation import (
    DRIFT_RATE_SHARE,
    ROUNDING_RATE_SHARE,
    SmallMotion,
    follows_rates,
    spectral_radius,
    step_matrices,
)

GROWTH_TOLERANCE = 1e-6
"""Growth of a step matrix's eigenvalue beyond what rounding, which splits the double ones, can imitate."""
DRIFT_EIGENVALUE_TOLERANCE = 1e-5
"""How far rounding splits the double eigenvalue 1 of a drift."""
RADIUS_TOLERANCE = 1e-13
"""Rounding of a spectral radius of 1."""
DIRECTION_DECIMALS = 13
"""Directions of λ that agree to this many decimals are one: many modes share theirs."""
SHORTEST_REACH, LONGEST_REACH, REACH_TRIALS, REACH_HALVINGS = 1e-6, 100.0, 161, 50
"""|λ dt| between which the end of a region is looked for, in how many trials, and how often the gap is then halved."""
CLOSE_TRIALS = np.arange(0.02, 8.0, 0.01)
"""|λ dt| tried as well: beyond the limit of a method of many stages the growth may be in narrow strips."""
NEGLIGIBLE_GROWTH = 2e-4
"""Growth a step that counts as none, as it does for what methods promise: an oscillation of 1000 periods gains a few per cent."""
NEGLIGIBLE_REACH_RATIO = 1.02
"""A limit that allows for such growth is reported where it is further than this from the strict one, relative to that."""
AXIS_GROWTH_REACH = 0.02
"""On the imaginary axis a step below this grows by less than rounding: a method first seen to grow here always does."""
FIRST_STEP, STEP_DOUBLINGS, STEP_HALVINGS = 0.01, 15, 14
"""dt times the fastest rate at which the search by matrices begins, how often it is doubled, and halved afterwards."""

ModeFinder = Callable[[tuple[int, ...]], np.ndarray]
"""The worst mode of a block: the displacements of its coordinates, then their velocities."""


def bounded_rates(motion: SmallMotion, method: Callable) -> np.ndarray:
    """Rates with those of drifts and of motions that grow by themselves set to 0, and undamped ones without rounding.

    Without damping a mode that grows has a partner that decays: a body that falls from a hilltop, and one that climbs it.
    Methods that kick and drift keep both at any step.
    """
    rates = motion.rates()
    fastest = np.abs(rates).max(axis=-1, keepdims=True)
    rates = np.where(np.abs(np.real(rates)) < ROUNDING_RATE_SHARE * fastest, 1j * np.imag(rates), rates)
    excluded = (np.abs(rates) < DRIFT_RATE_SHARE * fastest) | (np.real(rates) > 0)
    if motion.undamped and not follows_rates(method):
        excluded |= np.real(rates) != 0
    return np.where(excluded, 0.0, rates)


def find_limits_by_rates(method: Callable, motion: SmallMotion, fastest: np.ndarray) -> tuple[np.ndarray, ModeFinder]:
    """The limit of each block where the rates decide: the first λ dt on its ray that leaves the region."""
    rates = bounded_rates(motion, method)
    speed = np.abs(rates)
    directions = np.where(speed > 0, rates / np.where(speed > 0, speed, 1.0), -1.0)
    reach = _find_reach(method, directions)
    limits = np.where(speed > 0, reach / np.where(speed > 0, speed, 1.0), np.inf)

    def find_worst_mode(block: tuple[int, ...]) -> np.ndarray:
        λ, modes = motion.modes(block)
        # under a method that is always or never stable all limits are equal: the fastest mode then speaks for them
        tie = limits[block] == limits[block].min()
        target = rates[block][np.argmax(np.where(tie, speed[block], -1.0))]
        return modes[:, np.argmin(np.abs(λ - target))]

    return limits.min(axis=-1), find_worst_mode


def _find_reach(method: Callable, directions: np.ndarray) -> np.ndarray:
    """How far from 0 each direction of the complex plane stays in the region; 0 if not at all, inf if beyond 100."""
    unique, back = np.unique(np.round(directions, DIRECTION_DECIMALS), return_inverse=True)
    reach = _find_exits(method, unique, RADIUS_TOLERANCE)
    axis = np.flatnonzero(np.real(unique) == 0)
    # on the axis the growth of tiny steps is lost in rounding: an exit this early means that no step is stable
    never = axis[reach[axis] < AXIS_GROWTH_REACH]
    # methods of many stages leave it by so little, and so early, that no run shows it
    rest = np.setdiff1d(axis, never)
    tolerant = _find_exits(method, unique[rest], NEGLIGIBLE_GROWTH) if rest.size else reach[rest]
    reach[rest] = np.where(tolerant > NEGLIGIBLE_REACH_RATIO * reach[rest], tolerant, reach[rest])
    reach[never] = 0.0
    return reach[back].reshape(directions.shape)


def _find_exits(method: Callable, directions: np.ndarray, tolerance: float) -> np.ndarray:
    """Where each direction first leaves the part of the plane in which a step grows by no more than a tolerance."""
    inside = lambda s: np.asarray(spectral_radius(method, jnp.asarray(s * directions))) <= 1 + tolerance  # noqa: E731
    trials = np.union1d(np.geomspace(SHORTEST_REACH, LONGEST_REACH, REACH_TRIALS), CLOSE_TRIALS)
    # the first exit, not the last: some regions have islands beyond it
    outside = ~inside(trials[:, None])
    out, first = outside.any(axis=0), outside.argmax(axis=0)
    low, high = np.where(first > 0, trials[first - 1], 0.0), trials[first]
    for _ in range(REACH_HALVINGS):
        middle = (low + high) / 2
        good = inside(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return np.where(out, low, np.inf)


def find_limits_by_steps(method: Callable, motion: SmallMotion, fastest: np.ndarray) -> tuple[np.ndarray, ModeFinder]:
    """The limit of each block by the eigenvalues of the step itself: doubled until one leaves 1, then halved."""
    fastest_rate = np.where(fastest > 0, fastest, 1.0)
    rates, rest = motion.rates(), build_growth_filter(motion)
    grows = lambda dt: np.any(compute_growths(method, motion, dt, rest) > 1 + GROWTH_TOLERANCE, axis=-1)  # noqa: E731
    low, high, out = np.zeros(fastest_rate.shape), FIRST_STEP / fastest_rate, np.zeros(fastest_rate.shape, bool)
    for _ in range(STEP_DOUBLINGS):
        out = out | grows(high)
        low, high = np.where(out, low, high), np.where(out, high, 2 * high)
        if out.all():
            break
    for _ in range(STEP_HALVINGS):
        middle = (low + high) / 2
        bad = grows(middle)
        low, high = np.where(bad, low, middle), np.where(bad, middle, high)
    limits = np.where(out & (fastest > 0), np.where(low < FIRST_STEP / fastest_rate, 0.0, low), np.inf)

    def find_worst_mode(block: tuple[int, ...]) -> np.ndarray:
        n = motion.stiffness.shape[-1]
        dt = np.where(out, high * 1.01, 1 / fastest_rate)
        μ, modes = np.linalg.eig(_build_step_matrices(method, motion, dt, rest)[block])
        # of those that leave, the one that is furthest from any eigenvalue of the exact motion
        strange = np.abs(μ[:, None] - np.exp(rates[block] * dt[block])).min(axis=-1)
        leaves = np.abs(μ) > 1 + GROWTH_TOLERANCE
        mode = modes[:, np.argmax(np.where(leaves, 1 + strange, np.abs(μ) / np.abs(μ).max()))]
        return mode if out[block] else np.concatenate([mode[:n], mode[n:]])

    return limits, find_worst_mode


def build_growth_filter(motion: SmallMotion) -> np.ndarray | None:
    """The projector that removes the part of a motion that grows whatever the method, for each block; None without growth.

    Growth of what is left is the method's alone. To compare eigenvalues instead would need to know which of the
    step's belongs to which of the motion's, and a slow growth is soon lost among drifts.
    """
    growth_projector = motion.growth_projector()
    return None if growth_projector is None else np.eye(growth_projector.shape[-1]) - growth_projector


def _build_step_matrices(method: Callable, motion: SmallMotion, dt: np.ndarray, rest: np.ndarray | None) -> np.ndarray:
    """The step's matrix of each block, within the range of the projector `rest` where there is one."""
    n = motion.stiffness.shape[-1]
    stiffness, damping = (jnp.asarray(a.reshape(-1, n, n)) for a in (motion.stiffness, motion.damping))
    found = step_matrices(method, stiffness, damping, jnp.asarray(np.reshape(dt, -1)))
    found = np.asarray(found).reshape(*motion.stiffness.shape[:-2], 2 * n, 2 * n)
    return found if rest is None else rest @ found @ rest


def compute_growths(method: Callable, motion: SmallMotion, dt: np.ndarray, rest: np.ndarray | None) -> np.ndarray:
    """The size of each eigenvalue of each block's step; the double 1 of a drift, which rounding splits, counts as 1."""
    μ = np.linalg.eigvals(_build_step_matrices(method, motion, dt, rest))
    return np.where(np.abs(μ - 1) < DRIFT_EIGENVALUE_TOLERANCE, 1.0, np.abs(μ))
