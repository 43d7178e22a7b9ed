"""Runge-Kutta-Nyström methods as data, for accelerations that depend on place and time alone: x'' = f(t, x).

A step takes accelerations k_i = f(t + c_i dt, x + c_i dt v + dt² Σ_j a_ij k_j) and ends at x + dt v + dt² Σ_i b_i k_i with
the velocity v + dt Σ_i b'_i k_i. It needs no velocities within the step, and so fewer stages; those that its stages have are
right to first order only. A system whose force looks at the velocity is refused, and so is one whose places do not drift
straight, as where bodies rotate in space.
"""

from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.stepping.dependence import find_dependent, find_kicked, name_forces_of_velocity, pick_leaves
from physjax.stepping.pairs import Attempt
from physjax.stepping.system import S, System, average_over_step, leaf_dtype, push_drift
from physjax.vectors import scale

Share = float | Array
"""A share [1]: of a tableau a float, within a step one for each lane or scene."""


class NystromTableau(NamedTuple):
    """Nodes c, rows a, weights b of the place and b' of the velocity [1], and the order of a Nyström method.

    The row of the last stage is b: it is at the place where the step ends, and the next one may begin with its acceleration.
    `place_errors` and `velocity_errors` are the weights less those of the method of `error_order`. After a share s of a step
    the place is x + s dt v + (s dt)² Σ_i b_i(s) k_i, and the velocity its derivative: `within` has the coefficients of each
    b_i, from the constant on, and makes a state right to dt^(dense_order + 1).
    """

    nodes: tuple[float, ...]
    rows: tuple[tuple[float, ...], ...]
    place_weights: tuple[float, ...]
    velocity_weights: tuple[float, ...]
    order: int
    place_errors: tuple[float, ...]
    velocity_errors: tuple[float, ...]
    error_order: int
    within: tuple[tuple[float, ...], ...]
    dense_order: int


class NystromPair(NamedTuple):
    """What a Nyström method knows of its steps (`stepping.pairs.Pair`): stages are the accelerations that count within one."""

    tableau: NystromTableau
    keeps_slope: bool = True

    @property
    def error_order(self) -> int:
        """An error falls as dt^(error_order + 1)."""
        return self.tableau.error_order

    @property
    def dense_order(self) -> int:
        """A state within a step is right to dt^(dense_order + 1)."""
        return self.tableau.dense_order

    def attempt(self, system: System, t: Time, state: S, dt: ArrayLike, slope: S | None) -> Attempt:
        """A step dt [s] from the time t [s]; `slope` is the rate there, None where it is to be computed."""
        tableau, moves = self.tableau, _Moves.of(average_over_step(system, t, dt), t, state)
        end, found = moves.take_stages(tableau, t, state, dt, slope)
        start = jax.tree.map(jnp.zeros_like, state)
        error = moves.move(start, found, tableau.place_errors, tableau.velocity_errors, dt)
        stages = tuple(k for k, row in zip(found, tableau.within, strict=True) if row)
        return Attempt(end, error, moves.complete_rate(end, found[-1]), stages)

    def interpolate(self, system: System, t: Time, state: S, dt: ArrayLike, attempt: Attempt, share: ArrayLike) -> S:
        """The state at a share [1] of an attempted step from `state`, one number for each lane or scene."""
        rows = [row for row in self.tableau.within if row]
        place = [_evaluate(row, share) for row in rows]
        # the derivative of s² sⁿ is (n + 2) s sⁿ
        velocity = [_evaluate([(n + 2) * a for n, a in enumerate(row)], share) for row in rows]
        return _Moves(system, find_kicked(system, state)).move(
            state, attempt.stages, place, velocity, jnp.asarray(share) * dt
        )


class _Moves(NamedTuple):
    """How a system moves, and which arrays of its state a kick changes: the velocities. Accelerations are lists of these."""

    system: System
    kicked: list[bool]

    @classmethod
    def of(cls, system: System, t: Time, state: Any) -> "_Moves":
        """The moves of a system, if places drift straight and no force looks at the velocity; ValueError otherwise."""
        kicked = find_kicked(system, state)
        _demand_straight_drift(system, state, kicked)
        _demand_forces_of_place(system, t, state, kicked)
        return cls(system, kicked)

    def take_stages(
        self, tableau: NystromTableau, t: Time, state: S, dt: ArrayLike, slope: S | None = None
    ) -> tuple[S, list[list[Array]]]:
        """The end of a step, and the accelerations of its stages."""
        system, here = self.system, state
        found = [self.pick(system.rate(t, state) if slope is None else slope)]
        for node, row in zip(tableau.nodes[1:], tableau.rows[1:], strict=True):
            elapsed = dt if node == 1 else node * dt
            here = system.drift(self.kick(state, found, [a / node for a in row], dt), elapsed)
            found.append(self.pick(system.rate(t + elapsed, here)))
        rest = _subtract(tableau.velocity_weights, tableau.place_weights)
        return self.kick(here, found, rest, dt), found

    def move(
        self, state: S, found: Sequence[list[Array]], place: Sequence[Share], velocity: Sequence[Share], dt: ArrayLike
    ) -> S:
        """x + dt v + dt² Σ_i b_i k_i and v + dt Σ_i b'_i k_i."""
        arrived = self.system.drift(self.kick(state, found, place, dt), dt)
        return self.kick(arrived, found, _subtract(velocity, place), dt)

    def kick(self, state: S, found: Sequence[list[Array]], shares: Sequence[Share], dt: ArrayLike) -> S:
        """v + dt Σ_i a_i k_i, without the terms that are zero."""
        used = [(a, k) for a, k in zip(shares, found, strict=False) if not isinstance(a, float) or a]
        total = [reduce(add, (scale(a, k[i]) for a, k in used)) for i in range(sum(self.kicked))]
        return self.system.kick(state, self.fill(state, total), dt)

    def pick(self, tree: Any) -> list[Array]:
        """The arrays of a state or a rate that a kick changes."""
        return pick_leaves(tree, self.kicked)

    def fill(self, tree: S, found: list[Array]) -> S:
        """The tree with these in place of the arrays that a kick changes; a kick looks at no others."""
        leaves, structure = jax.tree.flatten(tree)
        rest = iter(found)
        return structure.unflatten([next(rest) if k else leaf for leaf, k in zip(leaves, self.kicked, strict=True)])

    def complete_rate(self, state: S, found: list[Array]) -> S:
        """The rate of a state whose accelerations are known: that of the places is how they drift."""
        return self.fill(push_drift(self.system, state, 0.0, 1.0), found)


def take_nystrom_step(tableau: NystromTableau, system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """The state a step dt [s] after the time t [s]; ValueError where a force looks at the velocity, or a body rotates."""
    return _Moves.of(system, t, state).take_stages(tableau, t, state, dt)[0]


def _demand_straight_drift(system: System, state: Any, kicked: list[bool]) -> None:
    """Raise a ValueError where what drifts does so in a way that depends on where it is, as orientations in space."""
    drift = lambda y, h: push_drift(system, y, h, 1.0)  # noqa: E731
    places = [not mark for mark in kicked]
    if any(find_dependent(drift, state, jnp.zeros((), leaf_dtype(state)), marked=[*places, True])):
        raise ValueError(
            f"Nyström method: got a state of type {type(state).__name__}, whose places do not drift straight, expected x'' = "
            "f(t, x): bodies that rotate in space have no such equation. Use another method, such as methods.tsit5."
        )


def _demand_forces_of_place(system: System, t: Time, state: Any, kicked: list[bool]) -> None:
    """Raise a ValueError where accelerations look at the velocity."""
    names = name_forces_of_velocity(system, t, state, kicked)
    if names:
        raise ValueError(
            f"Nyström method: got forces that look at the velocity ({names}), expected x'' = f(t, x), forces of place and time "
            "alone. Use a method for forces of any kind, such as methods.tsit5 or methods.dopri8."
        )


def _subtract(these: Sequence[Share], those: Sequence[Share]) -> list[Share]:
    return [a - b for a, b in zip(these, those, strict=True)]


def _evaluate(coefficients: Sequence[float], share: ArrayLike) -> Share:
    """Σ_n a_n sⁿ."""
    total = coefficients[-1]
    for a in reversed(coefficients[:-1]):
        total = total * jnp.asarray(share) + a
    return total


DPRKN6_END = (0.07811016144349478, 0.0, 0.2882917411897668, 0.12242553717457041, 0.011172560192168035)
"""Its last row, and its weights of the place: the last stage is where the step ends."""
DPRKN6 = NystromTableau(
    nodes=(0.0, 0.12929590313670442, 0.25859180627340883, 0.67029708261548, 0.9, 1.0),
    rows=(
        (),
        (0.008358715283968025,),
        (0.011144953711957367, 0.022289907423914734),
        (0.1454747428010918, -0.22986064052264749, 0.3090349872029675),
        (-0.20766826295078997, 0.6863667842925143, -0.19954927787234925, 0.12585075653062489),
        DPRKN6_END,
    ),
    place_weights=(*DPRKN6_END, 0.0),
    velocity_weights=(0.07811016144349478, 0.0, 0.3888434787059826, 0.3713207579288423, 0.11172560192168035, 0.05),
    order=6,
    place_errors=(
        -0.9807490989269235,
        2.406751371924452,
        -1.559600370364267,
        0.12242553717457041,
        0.011172560192168035,
        0.0,
    ),
    velocity_errors=(
        0.023504273504273504,
        0.0,
        -0.07242330719764424,
        0.17543989844952962,
        -0.2765208647561589,
        0.15,
    ),
    error_order=4,
    within=(
        (0.5, -1.245014245014245, 1.5161443494776827, -0.9066951566951567, 0.21367521367521367),
        (),
        (0.0, 1.9859371988705032, -3.577652872294921, 2.5384011164109506, -0.6583937017967658),
        (0.0, -1.8559358276926614, 5.547586751052329, -5.164133553908094, 1.5949081677229964),
        (0.0, 2.178649237472767, -6.926987319144182, 7.273336685101391, -2.513826043237808),
        (0.0, -1.0636363636363637, 3.440909090909091, -3.7409090909090907, 1.3636363636363635),
    ),
    dense_order=5,
)
"""J. Dormand and P. Prince, Runge-Kutta-Nyström triples, Comput. Math. Appl. 13 (1987) 937: their RKN6(4)6FD."""
