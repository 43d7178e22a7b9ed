"""Symplectic methods of higher order, composed of the kick and the drift of a system: data and a loop each.

Every stage is a kick and a drift for a share of dt, some of them back in time, so that the errors of the lower orders
cancel. The stages are a loop with their shares as data: the forces stand in the program once, however many stages there
are, and XLA on a CPU does not compute a chain of them again for each array that leaves it.
"""

from itertools import accumulate
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.stepping.system import S, System, leaf_dtype


class Splitting(NamedTuple):
    """Shares of a step [1] for which it kicks and drifts in turn, a kick first; as many of one as of the other."""

    kicks: tuple[float, ...]
    drifts: tuple[float, ...]


def take_split_step(splitting: Splitting, system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """The state a step dt [s] after the time t [s]: kick, drift, kick, drift and so on."""

    def follow(state: S, stage: Array) -> tuple[S, None]:
        begun, kick, drift = stage
        rate = system.rate(t + begun * dt, state)
        return system.drift(system.kick(state, rate, kick * dt), drift * dt), None

    begun = accumulate(splitting.drifts[:-1], initial=0.0)
    stages = jnp.asarray([*zip(begun, splitting.kicks, splitting.drifts, strict=True)], leaf_dtype(state))
    return lax.scan(follow, state, stages)[0]


def compose_leapfrogs(shares: tuple[float, ...], system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """The state a step dt [s] after the time t [s]: leapfrog steps for shares of dt.

    Neighbouring drifts stay apart: where bodies rotate a drift is of second order, and only a whole leapfrog is symmetric.
    """

    def follow(state: S, stage: Array) -> tuple[S, None]:
        begun, share = stage
        half = system.drift(state, share / 2 * dt)
        rate = system.rate(t + (begun + share / 2) * dt, half)
        return system.drift(system.kick(half, rate, share * dt), share / 2 * dt), None

    begun = accumulate(shares[:-1], initial=0.0)
    stages = jnp.asarray([*zip(begun, shares, strict=True)], leaf_dtype(state))
    return lax.scan(follow, state, stages)[0]


def mirror(half: tuple[float, ...], middle: float) -> tuple[float, ...]:
    """There, the middle, and back."""
    return (*half, middle, *reversed(half))


def _build_blanes_moan() -> Splitting:
    """Their coefficients b and a: half of them, as the splitting is symmetric, each without the one in the middle."""
    kicks = (0.0829844064174052, 0.396309801498368, -0.0390563049223486)
    drifts = (0.245298957184271, 0.604872665711080)
    middle = 1 / 2 - sum(drifts)
    return Splitting(mirror(kicks, 1 - 2 * sum(kicks)), (*drifts, middle, middle, *reversed(drifts), 0.0))


BLANES_MOAN_4 = _build_blanes_moan()
"""S. Blanes and P. Moan, J. Comput. Appl. Math. 142 (2002) 313: their RKN 6b, for accelerations of position alone."""
KAHAN_LI_8 = mirror(
    (
        0.13020248308889008,
        0.56116298177510838,
        -0.38947496264484729,
        0.15884190655515560,
        -0.39590389413323758,
        0.18453964097831571,
        0.25837438768632205,
        0.29501172360931030,
    ),
    -0.60550853383003452,
)
"""W. Kahan and R.-C. Li, Math. Comput. 66 (1997) 1089: 17 steps of a symmetric method of order 2 make one of order 8."""
