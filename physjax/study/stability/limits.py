"""The largest stable dt of a scene and what sets it, predicted from its forces before anything runs.

The forces are linearised about a state; their small motions have rates λ, and each method a region of λ dt in which it
keeps them bounded. Beyond the limit the fastest mode grows in every step, however accurate the rest is.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import callable_name
from physjax.parts import as_module
from physjax.physics.rigid import RigidBodies
from physjax.scene import Scene
from physjax.stepping.adaptive import Adaptive
from physjax.study.stability.attribution import attribute_mode
from physjax.study.stability.linearisation import (
    DRIFT_RATE_SHARE,
    follows_rates,
    linearise,
    prepare_linearisation,
    rate_text,
    spectral_radius,
)
from physjax.study.stability.planar import State, count_substeps
from physjax.study.stability.spinning import find_fastest_spin, measure_spin_limit
from physjax.study.stability.step_search import (
    bounded_rates,
    build_growth_filter,
    compute_growths,
    find_limits_by_rates,
    find_limits_by_steps,
)
from physjax.text import format_seconds
from physjax.tracebacks import shorten_tracebacks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw where the method is stable; returns the axes."""
        from physjax.study.stability.chart import draw_region

        return draw_region(self, ax)


class Limit(NamedTuple):
    """The largest stable step of a scene under a method, and what sets it. Printed, it is a sentence.

    `dt` [s] is infinite if nothing sets it and 0 if no step is stable. `each` [s] is the same for every lane (scene,
    where lanes are coupled). `cause` is "stiffness", "damping", "spin" or "nothing"; `force` the name of the force, `spring`
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

    def __repr__(self) -> str:
        """The sentence that is printed."""
        return f"<Limit: {self}>"

    def __str__(self) -> str:
        if self.cause == "nothing":
            return f"{self.method}: any step is stable, nothing swings or decays"
        if self.cause == "spin":
            what = f"set by the spin of a body, {abs(self.rate):.4g} rad/s; loads on bodies in space are not considered"
            found = (
                "any step is stable"
                if np.isinf(self.dt)
                else format_seconds(self.dt)
                if self.dt
                else "no step is stable"
            )
            return f"{self.method}: {found}, {what}"
        if np.isinf(self.dt):
            return f"{self.method}: any step is stable"
        where = "" if self.spring is None else f" (the spring between nodes {self.spring[0]} and {self.spring[1]})"
        what = f"set by the {self.cause} of {self.force}{where}, λ = {rate_text(self.rate)} 1/s"
        return f"{self.method}: {format_seconds(self.dt) if self.dt else 'no step is stable'}, {what}"


def region(
    method: Callable,
    *,
    real: tuple[float, float] = (-5.0, 1.0),
    imaginary: tuple[float, float] = (-3.5, 3.5),
    points: tuple[int, int] = (241, 281),
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


@shorten_tracebacks
@announce_compiling("the limit")
def limit(scene: Scene, method: Callable, at: State | None = None) -> Limit:
    """The largest stable dt of a scene under a method, predicted from its forces about a state (the start, if not given).

    Modes without a restoring force (a free body as a whole) and those that grow by themselves (a pendulum upside down) set
    no limit. All modes of scenes with up to 300 coordinates are considered, of larger ones the fastest; contacts are not.
    Of bodies in the plane angles are coordinates as well. `rigid.Solids` take the method's step dt/substeps at a time: the
    limit is that of the forces alone, as many times longer. What touches is held implicitly, and sets no limit of its own.

    Of bodies in space only their spin is considered: the limit is the step beyond which some free body, that turns as far in
    it, gains or loses more than a tenth of its energy in 4000 steps. Measured, that is 1.8 rad for what drifts whole steps
    (`verlet`, `semi_implicit_euler`), 3.6 for `leapfrog`, which drifts half steps, 0.36 for `rk4`, 0.2 for `tsit5`, 0.5 for
    `dopri8`; under `euler`, `midpoint` and `heun` the energy grows at any step. Bodies near a sphere or a steady spin bear
    more. Phases are another matter: they are off by much less than a turn only well below it.

    Example:
        >>> limit = stability.limit(swing, methods.verlet)
        >>> round(limit.dt, 3), limit.cause
        (1.0, 'stiffness')
    """
    with jax.enable_x64(True):
        substeps = count_substeps(scene)
        scene, state = prepare_linearisation(scene, at)
        module, name = check_method(method), callable_name(method)
        if isinstance(state, RigidBodies):
            return _limit_spin(scene, state, method, substeps)
        motion = linearise(scene, state)
        fastest = np.abs(motion.rates()).max(axis=-1)
        if not np.any(fastest > 0):
            return Limit(name, np.inf, np.full(fastest.shape, np.inf), "nothing", "", None, (), 0j)
        find = find_limits_by_rates if motion.undamped or follows_rates(module) else find_limits_by_steps
        each, find_worst_mode = find(module, motion, fastest)
        # where several blocks have the same limit, or none has one, the one that moves fastest speaks for all
        worst = np.argmax(np.where(each == each.min(), fastest, -1.0))
        block = tuple(int(i) for i in np.unravel_index(worst, each.shape))
        found = attribute_mode(scene, state, motion, block, find_worst_mode(block))
        return Limit(name, substeps * float(each[block]), substeps * each, **found._asdict())


def _limit_spin(scene: Scene, state: RigidBodies, method: Callable, substeps: int) -> Limit:
    """The limit that the spin of bodies in space sets; none of those that are held."""
    spin = find_fastest_spin(state, scene.mass)
    spin = np.where(False if scene.held is None else np.asarray(scene.held), 0.0, spin)
    worst = tuple(int(i) for i in np.unravel_index(np.argmax(spin), spin.shape))
    angle = measure_spin_limit(method) if spin[worst] > 0 else np.inf
    each = np.full(spin.shape, np.inf)
    each[spin > 0] = substeps * angle / spin[spin > 0]
    if scene.couples and spin.ndim:
        each = each.min(axis=-1)
    return Limit(callable_name(method), float(each.min()), each, "spin", "free rotation", None, worst, 1j * spin[worst])


def growth(scene: Scene, method: Callable, dt: ArrayLike, at: State | None = None) -> np.ndarray:
    """The factor by which small motions grow in one step of dt [s]: the spectral radius of the linearised step.

    That of the fastest growing one, shaped like `scene.status_shape`, as `dt` may be; 1 for a stable step. Drifts are left
    out. For methods without a stable step it predicts the growth in a run. Of `rigid.Solids` a step is all of its sub-steps.

    Example:
        >>> round(float(stability.growth(swing, methods.euler, 0.5)) ** 2, 3)
        2.0
    """
    with jax.enable_x64(True):
        substeps = count_substeps(scene)
        scene, state = prepare_linearisation(scene, at)
        motion, method = linearise(scene, state), check_method(method)
        dt = (
            np.broadcast_to(np.asarray(as_real_quantity("dt [s]", dt, above=0.0), float), scene.status_shape) / substeps
        )
        if motion.undamped or follows_rates(method):
            z = bounded_rates(motion, method) * dt[..., None]
            found = np.asarray(spectral_radius(method, jnp.asarray(z))).max(axis=-1, initial=1.0)
        else:
            found = np.maximum(1.0, compute_growths(method, motion, dt, build_growth_filter(motion)).max(axis=-1))
        return found**substeps


def grows_by_itself(scene: Scene, at: State | None = None) -> np.ndarray:
    """Whether small motions about a state grow whatever the method: a pendulum upside down, bodies that pass each other.

    Shaped like `scene.status_shape`. There a run cannot show what the method adds.

    Example:
        >>> bool(stability.grows_by_itself(swing))
        False
    """
    with jax.enable_x64(True):
        rates = linearise(*prepare_linearisation(scene, at)).rates()
        return np.real(rates).max(axis=-1) > DRIFT_RATE_SHARE * np.abs(rates).max(axis=-1)


def check_method(method: Callable) -> Callable:
    """The method as part of a compiled function; a TypeError for anything else, or a method that chooses its own steps."""
    if not callable(method):
        raise TypeError(f"stability: got the method {method!r}, expected one such as methods.rk4.")
    if isinstance(method, Adaptive):
        raise TypeError("stability: an adaptive method chooses its own steps; ask for the limit of the method inside.")
    module = as_module(method)
    assert callable(module)
    return module
