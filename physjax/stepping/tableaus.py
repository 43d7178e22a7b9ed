"""Explicit Runge-Kutta methods as data: a tableau each, and one function that steps by any of them.

A step takes slopes k_i = rate(t + c_i dt, y + dt Σ_j a_ij k_j) one after the other and ends at y + dt Σ_i b_i k_i. Nodes c,
rows a and weights b are the tableau; a pair has other weights of a lower order on the same slopes, whose end differs by
about the error of a step. Zeros are skipped while tracing: they cost nothing.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.stepping.pairs import Attempt
from physjax.stepping.system import S, System, average_over_step, leaf_dtype, read_traits
from physjax.vectors import scale


class Tableau(NamedTuple):
    """Nodes, rows, weights [1] and the order of an explicit Runge-Kutta method, row i of length i.

    `errors`, of a pair, are its weights less those of the lower order: what is left is the error of a step. `dense`, of a
    method with an interpolant, has the polynomial Σ p_ij θ^(j+1) for each slope i, its weight at a share θ of a step.
    """

    nodes: tuple[float, ...]
    rows: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]
    order: int
    errors: tuple[float, ...] = ()
    dense: tuple[tuple[float, ...], ...] = ()

    @property
    def first_same_as_last(self) -> bool:
        """Whether the last slope is that at the end of the step, so that the next one may begin with it."""
        return self.rows[-1] != () and self.weights == (*self.rows[-1], 0.0)

    @property
    def stages(self) -> int:
        """Slopes that the end of a step needs; a last one that only the error needs is left out."""
        return 1 + max(i for i, weight in enumerate(self.weights) if weight)


def take_step(tableau: Tableau, system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """The state a step dt [s] after the time t [s]; where compiling costs more than running, the stages are a loop."""
    if read_traits(system).compile_bound and tableau.stages > 1:
        return _loop_over_stages(tableau, system, t, state, dt)
    slopes = _follow_stages(tableau, tableau.stages, system, t, state, dt)
    return move_along(state, slopes, tableau.weights, dt)


def move_along(state: S, slopes: list[S], shares: tuple[float, ...], dt: ArrayLike) -> S:
    """y + dt Σ aᵢkᵢ, without the terms that are zero; a common factor goes to dt, so that fewer vectors are multiplied."""
    used = [(a, k) for a, k in zip(shares, slopes, strict=False) if a]
    if not used:
        return state
    factor = used[0][0]
    ratios = [a / factor for a, _ in used]

    def move(y: Array, *terms: Array) -> Array:
        total = terms[0]
        for ratio, term in zip(ratios[1:], terms[1:], strict=True):
            total = total + (term if ratio == 1 else ratio * term)
        return y + scale(_multiply(factor, dt), total)

    return jax.tree.map(move, state, *(k for _, k in used))


def _follow_stages(
    tableau: Tableau, stages: int, system: System, t: Time, state: S, dt: ArrayLike, first: S | None = None
) -> list[S]:
    """The slopes of the first stages of a step, written out one after the other; the first of them may be known."""
    slopes = [] if first is None else [first]
    known = len(slopes)
    for node, row in zip(tableau.nodes[known:stages], tableau.rows[known:stages], strict=True):
        slopes.append(system.rate(t + _multiply(node, dt) if node else t, move_along(state, slopes, row, dt)))
    return slopes


def _multiply(share: float, dt: ArrayLike) -> ArrayLike:
    return dt if share == 1 else share * dt


def _loop_over_stages(tableau: Tableau, system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """A step whose stages are a loop with the tableau as data: the forces stand in the program once.

    What a slope adds to each later stage, and to the end, is added as soon as it is known.
    """
    count, dtype = tableau.stages, leaf_dtype(state)
    table = [*tableau.rows[:count], tableau.weights[:count]]
    columns = [[row[i] if i < len(row) else 0.0 for row in table] for i in range(count)]

    def follow(ahead: S, stage: tuple[Array, Array, Array]) -> tuple[S, None]:
        i, node, column = stage
        here = jax.tree.map(lambda y, a: y + scale(dt, lax.dynamic_index_in_dim(a, i, keepdims=False)), state, ahead)
        slope = system.rate(t + node * dt, here)
        return jax.tree.map(lambda a, k: a + scale(column, k[None]), ahead, slope), None

    nothing = jax.tree.map(lambda y: jnp.zeros((count + 1, *y.shape), y.dtype), state)
    stages = (jnp.arange(count), jnp.asarray(tableau.nodes[:count], dtype), jnp.asarray(columns, dtype))
    ahead, _ = lax.scan(follow, nothing, stages)
    return jax.tree.map(lambda y, a: y + scale(dt, a[count]), state, ahead)


class TableauPair(NamedTuple):
    """A tableau with `errors` as a pair: the step is that of the higher order, and what the lower would change its error."""

    tableau: Tableau

    @property
    def error_order(self) -> int:
        """Of the lower order."""
        return self.tableau.order - 1

    @property
    def dense_order(self) -> int:
        """Of the interpolant; 0 where there is none."""
        return len(self.tableau.dense[0]) if self.tableau.dense else 0

    @property
    def keeps_slope(self) -> bool:
        """Whether the next step may begin with the last slope."""
        return self.tableau.first_same_as_last

    def attempt(self, system: System, t: Time, state: S, dt: ArrayLike, slope: S | None) -> Attempt:
        """A step with its error and all its slopes."""
        system = average_over_step(system, t, dt)
        slopes = _follow_stages(self.tableau, len(self.tableau.nodes), system, t, state, dt, slope)
        end = move_along(state, slopes, self.tableau.weights, dt)
        nothing = jax.tree.map(jnp.zeros_like, state)
        error = move_along(nothing, slopes, self.tableau.errors, dt)
        return Attempt(end, error, slopes[-1] if self.keeps_slope else None, slopes)

    def interpolate(self, system: System, t: Time, state: S, dt: ArrayLike, attempt: Attempt, share: ArrayLike) -> S:
        """The state at a share of a step, from its slopes."""
        moved = state
        for polynomial, slope in zip(self.tableau.dense, attempt.stages, strict=True):
            weight = share * _evaluate_polynomial(polynomial, share)
            moved = jax.tree.map(lambda y, k, w=weight: y + scale(dt * w, k), moved, slope)
        return moved


def _evaluate_polynomial(coefficients: tuple[float, ...], x: ArrayLike) -> ArrayLike:
    """Σ c_j x^j, by Horner's rule."""
    return reduce(lambda total, c: total * x + c, reversed(coefficients[:-1]), coefficients[-1])


EULER = Tableau(nodes=(0.0,), rows=((),), weights=(1.0,), order=1)
"""L. Euler, 1768."""
MIDPOINT = Tableau(nodes=(0.0, 1 / 2), rows=((), (1 / 2,)), weights=(0.0, 1.0), order=2)
"""C. Runge, 1895."""
HEUN = Tableau(nodes=(0.0, 1.0), rows=((), (1.0,)), weights=(1 / 2, 1 / 2), order=2)
"""K. Heun, 1900."""
RK4 = Tableau(
    nodes=(0.0, 1 / 2, 1 / 2, 1.0),
    rows=((), (1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)),
    weights=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    order=4,
)
"""W. Kutta, 1901."""
TSIT5_END = (
    0.09646076681806523,
    0.01,
    0.4798896504144996,
    1.379008574103742,
    -3.290069515436081,
    2.324710524099774,
)
"""Its last row, and its weights: the last slope is that at the end."""
TSIT5 = Tableau(
    nodes=(0.0, 0.161, 0.327, 0.9, 0.9800255409045097, 1.0, 1.0),
    rows=(
        (),
        (0.161,),
        (-0.008480655492356989, 0.335480655492357),
        (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
        (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
        (5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383),
        TSIT5_END,
    ),
    weights=(*TSIT5_END, 0.0),
    order=5,
    errors=(
        0.0017800110522257773,
        0.0008164344596567463,
        -0.007880878010261994,
        0.1447110071732629,
        -0.5823571654525552,
        0.45808210592918686,
        -0.015151515151515152,
    ),
    dense=(
        (1.0, -2.763706197274826, 2.9132554618219126, -1.0530884977290216),
        (0.0, 0.1317, -0.2234, 0.1017),
        (0.0, 3.9302962368947516, -5.941033872131505, 2.490627285651253),
        (0.0, -12.411077166933676, 30.33818863028232, -16.548102889244902),
        (0.0, 37.50931341651104, -88.1789048947664, 47.37952196281928),
        (0.0, -27.896526289197286, 65.09189467479366, -34.87065786149661),
        (0.0, 1.5, -4.0, 2.5),
    ),
)
"""Ch. Tsitouras, Runge-Kutta pairs of order 5(4), Comput. Math. Appl. 62 (2011) 770."""
DOPRI8_END = (
    0.041747491141530244,
    0.0,
    0.0,
    0.0,
    0.0,
    -0.05545232861123931,
    0.2393128072011801,
    0.703510669403443,
    -0.7597596138144609,
    0.6605630309222863,
    0.15818748251012332,
    -0.2381095387528628,
    0.25,
)
"""Its last row, and its weights: the last slope is that at the end."""
DOPRI8 = Tableau(
    nodes=(
        0.0,
        0.05555555555555555,
        0.08333333333333333,
        0.125,
        0.3125,
        0.375,
        0.1475,
        0.465,
        0.5648654513822595,
        0.65,
        0.9246562776405044,
        1.0,
        1.0,
        1.0,
    ),
    rows=(
        (),
        (0.05555555555555555,),
        (0.020833333333333332, 0.0625),
        (0.03125, 0.0, 0.09375),
        (0.3125, 0.0, -1.171875, 1.171875),
        (0.0375, 0.0, 0.0, 0.1875, 0.15),
        (0.04791013711111111, 0.0, 0.0, 0.11224871277777777, -0.02550567377777778, 0.012846823888888888),
        (
            0.01691798978729228,
            0.0,
            0.0,
            0.3878482784860432,
            0.03597736985150033,
            0.19697021421566607,
            -0.17271385234050185,
        ),
        (
            0.0690957533591923,
            0.0,
            0.0,
            -0.6342479767288541,
            -0.16119757522460407,
            0.13865030945882525,
            0.9409286140357562,
            0.21163632648194397,
        ),
        (
            0.1835569968390454,
            0.0,
            0.0,
            -2.4687680843155926,
            -0.29128688781630047,
            -0.026473020233117376,
            2.8478387641928005,
            0.2813873314698498,
            0.12374489986331466,
        ),
        (
            -1.2154248173958881,
            0.0,
            0.0,
            16.672608665945774,
            0.915741828416818,
            -6.056605804357471,
            -16.00357359415618,
            14.849303086297663,
            -13.371575735289849,
            5.134182648179638,
        ),
        (
            0.25886091643826425,
            0.0,
            0.0,
            -4.774485785489205,
            -0.4350930137770325,
            -3.0494833320722416,
            5.5779200399360995,
            6.15583158986104,
            -5.062104586736939,
            2.193926173180679,
            0.13462799865933495,
        ),
        (
            0.8224275996265075,
            0.0,
            0.0,
            -11.658673257277664,
            -0.7576221166909362,
            0.7139735881595816,
            12.075774986890057,
            -2.127659113920403,
            1.9901662070489554,
            -0.23428647154404028,
            0.17589857770794226,
            0.0,
        ),
        DOPRI8_END,
    ),
    weights=(*DOPRI8_END, 0.0),
    order=8,
    errors=(
        0.012194277465176744,
        0.0,
        0.0,
        0.0,
        0.0,
        0.7731539478765578,
        -0.07192809284993823,
        -1.763834521196444,
        1.787182038027448,
        -0.7829855527544889,
        0.07877188662899604,
        -0.28255398319730723,
        0.25,
        0.0,
    ),
)
"""P. Prince and J. Dormand, J. Comput. Appl. Math. 7 (1981) 67."""
