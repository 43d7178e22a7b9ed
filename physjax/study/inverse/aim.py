"""The launch that hits a target: both arcs, or the least speed, with any forces, in the plane or in space, by bounces.

```python
shot = Scene(Particles(start, jnp.zeros(2)), mass=0.145, forces=(forces.Gravity(), forces.QuadraticDrag(4.3e-3, 0.35)))
aimed = aim_at(shot, target=(40.0, 0.0), speed=30.0)
aimed.low.angle, aimed.high.angle, aimed.low.time, aimed.ok
```
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.checks import as_real_quantity
from physjax.compiling import announce_compiling
from physjax.cubics import Cubic
from physjax.linear import solve_columns
from physjax.particles import Particles
from physjax.parts import is_untransformed
from physjax.scene import Scene
from physjax.stepping.methods import rk4
from physjax.study.inverse.aim_problem import check_bounces, check_problem
from physjax.study.inverse.ricochet import find_ricochet
from physjax.study.inverse.shooting import (
    AimProblem,
    Launch,
    State,
    find_launch,
    find_nearest_launch,
    guess_launch,
    select_where,
)
from physjax.summaries import Row, format_array, write_grid, write_summary, write_table
from physjax.tracebacks import shorten_tracebacks
from physjax.trajectory import Trajectory
from physjax.vectors import components, dot, norm, stack_components
from physjax.xla_options import jit_untransformed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FLIGHT_STEPS = 200
"""Default number of steps of a flight."""
MAX_SPEED_ERROR_SHARE = 0.1
"""A speed is met if the launch is faster by no more than what moves the shot by this share of its rounding."""
LEAST_SPEED_SHARE = 0.5
"""A launch slower than this share of the speed asked for is a search that ran away."""


class Shot(NamedTuple):
    """A launch and where it leads, for each target.

    `angle` is the elevation above the horizontal [rad], beyond a right angle for a shot back along x in the plane; in
    space `azimuth` [rad] is its bearing from x towards z, where z is up from x towards y. Up is what the scene says
    (`Scene.up`), y by default. `speed` [m/s], flight `time` [s] and launch `velocity` [m/s], over ground; from a moving
    launcher angle, azimuth and speed are those relative to it, as its barrel is turned;
    `apex`, the greatest height on the way [m]; `residual`, from the target to where the flight ends [m]. Where `ok` is
    False this is the nearest miss, or what something in the way makes of the shot, and its derivatives are zero.
    """

    angle: Float[Array, "*lanes"]
    azimuth: Float[Array, "*lanes"] | None
    speed: Float[Array, "*lanes"]
    time: Float[Array, "*lanes"]
    velocity: Float[Array, "*lanes dim"]
    apex: Float[Array, "*lanes"]
    residual: Float[Array, "*lanes dim"]
    ok: Bool[Array, "*lanes"]

    def __repr__(self) -> str:
        """Its angle, speed, time, apex and miss."""
        return write_summary("Shot", self.describe())

    def _repr_html_(self) -> str:
        return write_table("Shot", self.describe())

    def describe(self) -> list[Row]:
        """What a summary says of it."""
        azimuth = [] if self.azimuth is None else [("azimuth", format_array(self.azimuth, "rad"))]
        return [
            ("angle", format_array(self.angle, "rad")),
            *azimuth,
            ("speed", format_array(self.speed, "m/s")),
            ("time", format_array(self.time, "s")),
            ("apex", format_array(self.apex, "m")),
            ("misses by", format_array(self.miss, "m")),
            ("hits", format_array(self.ok)),
        ]

    @property
    def miss(self) -> Float[Array, "*lanes"]:
        """Distance from the target at the end of the flight [m]: rounding where it hits."""
        return norm(self.residual)


class Aimed(eqx.Module):
    """The shots at each target: `low`, which arrives first, and `high`.

    They are the same at the least speed, out of reach, and where there is only one, as in a straight line without forces.
    """

    low: Shot
    high: Shot
    shots: AimProblem

    def __repr__(self) -> str:
        """Both arcs, side by side."""
        low, high = self.low.describe(), self.high.describe()
        rows = [(name, f"{a:<22}  {b}") for (name, a), (_, b) in zip(low, high, strict=True)]
        return write_summary(self._title(), [("", f"{'low arc':<22}  high arc"), *rows])

    def _repr_html_(self) -> str:
        rows = [(name, a, b) for (name, a), (_, b) in zip(self.low.describe(), self.high.describe(), strict=True)]
        return write_grid(self._title(), ("", "low arc", "high arc"), rows)

    def _title(self) -> str:
        return f"Aimed at {format_array(self.target, 'm')}"

    @property
    def ok(self) -> Bool[Array, "*lanes"]:
        """Whether either arc hits."""
        return self.low.ok | self.high.ok

    @property
    def target(self) -> Float[Array, "*lanes dim"]:
        """The targets at the launch [m]."""
        return self.shots.target

    def meeting_place(self, shot: Shot) -> Float[Array, "*lanes dim"]:
        """Where the targets are at the end of the flight of a shot [m]."""
        return self.shots.target_at(shot.time)

    def scene(self, shot: Shot) -> Scene:
        """The scene with the launch velocity of a shot, to be simulated."""
        return self.shots.with_launch_velocity(self._see_from_launcher(shot))

    def flight(self, shot: Shot) -> Trajectory:
        """The whole flight of a shot, every step a frame; it ends at the target."""
        return self.shots.flight(Launch(self._see_from_launcher(shot), shot.time), save_every=1)

    def _see_from_launcher(self, shot: Shot) -> Array:
        """The launch velocity relative to the launcher [m/s]."""
        return shot.velocity if self.shots.launcher is None else shot.velocity - self.shots.launcher

    def plot(self, *, every: int = 1, ax: "Axes | None" = None) -> "Axes":
        """Draw both arcs to one target in `every`, and the targets; returns the axes."""
        from physjax.study.inverse.chart import draw_shots

        return draw_shots(self, every=every, ax=ax)


@shorten_tracebacks
@jax.transfer_guard("allow")  # what a call is given goes to the device on purpose
@announce_compiling("aim_at")
def aim_at(
    scene: Scene,
    target: ArrayLike | Callable,
    *,
    speed: ArrayLike | None = None,
    bounces: int = 0,
    method: Callable[..., PyTree] = rk4,
    steps: int = FLIGHT_STEPS,
    launcher_velocity: ArrayLike | None = None,
    target_velocity: ArrayLike | None = None,
) -> Aimed:
    """The launches from where the scene's lanes are that hit a target `(*lanes, dim)` [m] at a speed [m/s].

    The direction of launch is free; the state's velocity is not used. Without `speed` the least speed that hits is
    found. The scene has one lane for all targets, or one for each. A flight is `steps` equal steps of the method;
    angle and flight time are solved for together, to the last digits, so that the error left is the method's own.
    From a launcher that moves at `launcher_velocity` [m/s], `(dim,)` or one for each shot, the speed is relative to it.
    A target that moves at `target_velocity` [m/s], given likewise, is at `target` at the launch; one that moves otherwise
    is a path, a function `(t) -> place` `(dim,)` of the time since then [s], the same for all shots.
    Contacts are obstacles, unless the target is to be hit after `bounces` impacts on them (`contacts.impact`). Then a
    fan of directions is tried: `low` is the soonest hit that it leads to, `high` the latest. A target out of reach gives
    `ok` False and the nearest miss. Works under `jit`, `vmap`, and any derivative with respect to the target, the speed
    and every number of the scene.

    Raises ValueError or TypeError for a speed <= 0, a target at the start, a launch that is not free.

    Example:
        >>> start = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), forces=(forces.Gravity(),))
        >>> aimed = aim_at(start, (5.0, 0.0), speed=9.9)
        >>> [round(float(np.rad2deg(shot.angle))) for shot in (aimed.low, aimed.high)]
        [15, 75]
        >>> driving = aim_at(start, (5.0, 0.0), speed=9.9, launcher_velocity=(-2.0, 0.0))
        >>> print(driving.low.velocity.round(2), round(float(np.rad2deg(driving.low.angle)), 1))
        [7.32 3.35] 19.8
        >>> running = aim_at(start, (5.0, 0.0), speed=9.9, target_velocity=(2.0, 0.0))
        >>> print(running.meeting_place(running.low).round(2))
        [6.37 0.  ]
        >>> swinging = aim_at(start, lambda t: jnp.stack([5.0 + jnp.sin(3.0 * t), 0.5 * t]), speed=9.9)
        >>> print(swinging.meeting_place(swinging.low).round(2))
        [5.93 0.32]
    """
    shots = check_problem(scene, target, method, steps, launcher_velocity, target_velocity)
    bounces = check_bounces(bounces, speed, shots.scene)
    if speed is not None:
        speed = as_real_quantity("speed [m/s]", speed, above=0).astype(shots.target.dtype)
        if speed.shape not in ((), shots.target.shape[:-1]):
            raise ValueError(
                f"speed [m/s]: got shape {speed.shape}, expected () or {shots.target.shape[:-1]}, one for each target."
            )
        speed = jnp.broadcast_to(speed, shots.target.shape[:-1])
    alone = shots.scene.compile_bound and is_untransformed((shots, speed))
    solve = _get_standalone_solver() if alone else _solve_inside
    low, high = solve(shots, speed, bounces)
    return Aimed(low, high, shots)


def _solve_both_arcs(shots: AimProblem, speed: Array | None, bounces: int) -> tuple[Shot, Shot]:
    if speed is None:
        shot = _solve_arc(shots, None, None, bounces)
        return shot, shot
    both = lax.map(lambda late: _solve_arc(shots, speed, late, bounces), jnp.array([False, True]))
    return tuple(jax.tree.map(lambda leaf, i=i: leaf[i], both) for i in (0, 1))


_solve_inside = jax.jit(_solve_both_arcs, static_argnames=("bounces",))


@functools.cache
def _get_standalone_solver() -> Callable[..., tuple[Shot, Shot]]:
    """The compiled search through contacts where no transformation is around it; made at the first, as it asks for the device."""
    return jit_untransformed(_solve_both_arcs, many_small_kernels=True, static_argnames=("bounces",))


def _solve_arc(shots: AimProblem, speed: Array | None, late: Array | None, bounces: int) -> Shot:
    """One arc. Without bounces it is searched in free flight; then it is flown with the contacts in its way."""
    if bounces and speed is not None and late is not None:
        launch, legal = _differentiate_implicitly(shots, speed, lambda: find_ricochet(shots, speed, late, bounces))
    else:
        free = eqx.tree_at(lambda shots: shots.scene, shots, shots.scene.replace(contacts=()))
        launch, legal = _differentiate_implicitly(free, speed, lambda: _search_free_flight(free, speed, late))
    up = shots.scene.up
    across = [axis for axis in range(shots.target.shape[-1]) if axis != up]
    flight = shots.flight(launch, save_every=1, record=_HEIGHT_RECORDERS[up])
    residual = _demand_end(flight) - shots.target_at(launch.time)
    ok = legal & (norm(residual) <= shots.rounding(launch))
    velocity, time = launch = _stop_gradient_unless(ok, launch)
    level = [velocity[..., axis] for axis in across]
    forward = level[0] if len(level) == 1 else norm(jnp.stack(level, axis=-1))
    return Shot(
        angle=jnp.arctan2(velocity[..., up], forward),
        azimuth=None if len(level) == 1 else jnp.arctan2(level[1], level[0]),
        speed=norm(velocity) if speed is None else speed,
        time=time,
        velocity=shots.over_ground(velocity),
        apex=_stop_gradient_unless(ok, _apex_height(flight.recorded, launch.time / shots.steps)),
        residual=_stop_gradient_unless(ok, residual),
        ok=ok,
    )


def _demand_end(flight: Trajectory) -> Array:
    """Where a flight that `simulate` returned ends [m]."""
    assert flight.final_scene is not None
    return flight.final_scene.state.position


def _search_free_flight(shots: AimProblem, speed: Array | None, late: Array | None) -> tuple[Launch, Array]:
    """The launch that hits or, at a given speed, comes nearest; and whether it is legal, as every nearest one is."""
    launch, found = find_launch(shots, speed, late)
    if speed is None:
        return launch, found
    # without a force to bring it back there is no high arc, and the search for it runs away
    launch = select_where(norm(launch.velocity) > LEAST_SPEED_SHARE * speed, launch, guess_launch(shots, speed))
    too_fast = (norm(launch.velocity) - speed) * launch.time > MAX_SPEED_ERROR_SHARE * shots.rounding(launch)
    launch, _ = find_nearest_launch(shots, launch, speed, too_fast | ~found)
    return launch, jnp.ones_like(found)


def _differentiate_implicitly(
    shots: AimProblem, speed: Array | None, search: Callable[[], tuple[Launch, Array]]
) -> tuple[Launch, Array]:
    """What the search finds, with the derivatives of the implicit function theorem: the launch is a root of `conditions`."""

    def conditions(packed):
        launch = Launch(packed[..., :-1], packed[..., -1])
        if speed is None:
            miss, turn = shots.newton_correction(launch)  # in units of velocity, which has the same root
            last = dot(launch.velocity, turn)
        else:
            miss = shots.miss(launch)
            last = dot(launch.velocity, launch.velocity) - speed * speed
        return jnp.concatenate([miss, last[..., None]], axis=-1)

    def packed_search(*_):
        launch, legal = search()
        # as a number: before jax 0.11 what comes along with a root cannot be a boolean in derivatives
        return jnp.concatenate([launch.velocity, launch.time[..., None]], axis=-1), legal.astype(start.dtype)

    start = jnp.zeros((*shots.target.shape[:-1], shots.target.shape[-1] + 1), shots.target.dtype)
    packed, legal = lax.custom_root(conditions, start, packed_search, _solve_by_lane, has_aux=True)
    return Launch(packed[..., :-1], packed[..., -1]), legal > 0


def _solve_by_lane(linear: Callable[[Array], Array], b: Array) -> Array:
    """The solution of linear(x) = b, a small system for each lane; zero where that is singular."""
    size = b.shape[-1]
    rows = jnp.eye(size, dtype=b.dtype)
    columns = jax.vmap(linear)(
        jnp.broadcast_to(rows.reshape((size,) + (1,) * (b.ndim - 1) + (size,)), (size, *b.shape))
    )
    matrix, right = [components(column) for column in columns], components(b)
    probe = solve_columns(lax.stop_gradient(matrix), [jnp.ones_like(part) for part in right])
    sound = jnp.all(jnp.isfinite(jnp.stack(probe)), axis=0)
    # the identity stands in for a singular matrix: a choice after the solve would leave NaN in its derivative
    matrix = [[jnp.where(sound, part, rows[i, j]) for j, part in enumerate(column)] for i, column in enumerate(matrix)]
    return stack_components([jnp.where(sound, part, 0.0) for part in solve_columns(matrix, right)])


def _record_height(t: Array, state: Particles, *, up: int) -> tuple[Array, Array]:
    """Height [m] and rate of climb [m/s]."""
    return state.position[..., up], state.velocity[..., up]


_HEIGHT_RECORDERS = [partial(_record_height, up=axis) for axis in range(3)]
"""What is recorded of a flight, by the axis that is up; made once, since every new function recompiles."""


def _apex_height(recorded: tuple[Array, Array], dt: Array) -> Array:
    """The greatest height [m]: of the frames, and of the cubic through two frames between which the flight turns down."""
    height, climb = recorded
    (y0, y1), (v0, v1) = ((a[:-1], a[1:]) for a in (height, climb))
    turns = (v0 > 0) & (v1 < 0)
    share = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.0)
    top = Cubic.through(y0, y1, dt[None] * v0, dt[None] * v1).at(share)
    return jnp.maximum(jnp.max(top, axis=0), height[-1])


def _stop_gradient_unless(ok: Array, values: State) -> State:
    """The values, without derivatives in lanes that are not ok."""
    return select_where(ok, values, lax.stop_gradient(values))
