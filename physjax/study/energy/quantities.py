"""Energy, momentum and angular momentum of a scene: what its physics conserves, and so what a method should."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.compiling import announce_compiling
from physjax.scene import Scene
from physjax.trajectory import Trajectory
from physjax.vectors import cross, norm

if TYPE_CHECKING:
    from physjax.study.energy.budget import Ledger


class Conserved(NamedTuple):
    """A quantity that the physics keeps constant, `value(scene, t, state)`, and the `size` that its errors are measured by.

    Both are per lane, or per scene where lanes are coupled; the value may have components behind that.

    Example:
        >>> energy.MOMENTUM.name, energy.MOMENTUM.value(shot, 0.0, ball).tolist()
        ('momentum', [6.0, 8.0])
    """

    name: str
    value: Callable[[Scene, ArrayLike, PyTree], Array]
    size: Callable[[Scene, ArrayLike, PyTree], Array]


def kinetic(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "..."]:
    """½mv² [J], of rigid bodies with ½ω·L, per lane or summed over coupled ones.

    Example:
        >>> float(energy.kinetic(shot, 0.0, ball))
        25.0
    """
    return summed(scene, state.kinetic_energy(scene.mass))


def potential(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "..."]:
    """Potential energy of all forces that have one [J], per lane or summed over coupled ones.

    Example:
        >>> float(energy.potential(shot, 0.0, ball))
        196.0
    """
    see = lambda f: state.view_for_force(f, scene.mass)  # noqa: E731
    terms = [f.potential(t, *see(f)) for f in scene.forces if f.has_potential]
    return summed(scene, sum(terms, jnp.zeros_like(state.position[..., 0])))


def total(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "..."]:
    """Kinetic and potential energy [J], per lane or summed over coupled ones.

    Example:
        >>> float(energy.total(shot, 0.0, ball))
        221.0
    """
    return kinetic(scene, t, state) + potential(scene, t, state)


def momentum(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "..."]:
    """Σmv [kg m/s], per lane or summed over coupled ones; the component last.

    Example:
        >>> print(energy.momentum(shot, 0.0, ball))
        [6. 8.]
    """
    p = state.linear_momentum(scene.mass)
    return jnp.sum(p, axis=-2) if scene.couples and scene.state.lanes else p


def angular_momentum(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "..."]:
    """Σ r × mv about the origin [kg m²/s], of rigid bodies with their own; a number in the plane, a vector in space.

    Example:
        >>> float(energy.angular_momentum(shot, 0.0, ball))
        -60.0
    """
    r, p = state.position, state.linear_momentum(scene.mass)
    if r.shape[-1] == 2:
        arms = r[..., 0] * p[..., 1] - r[..., 1] * p[..., 0]
        return summed(scene, arms + state.own_spin(scene.mass) if state.rotates else arms)
    spin = cross(r, p) + state.own_spin(scene.mass) if state.rotates else cross(r, p)
    return jnp.sum(spin, axis=-2) if scene.couples and scene.state.lanes else spin


def _angular_momentum_size(scene: Scene, state: PyTree) -> Array:
    arms = norm(state.position) * norm(state.linear_momentum(scene.mass))
    if not state.rotates:
        return arms
    own = state.own_spin(scene.mass)
    return arms + (jnp.abs(own) if state.position.shape[-1] == 2 else norm(own))


def summed(scene: Scene, per_lane: Array) -> Array:
    """Numbers per lane, summed over coupled lanes; a plain force on a single particle couples nothing.

    Example:
        >>> float(energy.summed(flag, jnp.ones(9))), energy.summed(shot, jnp.ones(3)).tolist()
        (9.0, [1.0, 1.0, 1.0])
    """
    return jnp.sum(per_lane, axis=-1) if scene.couples and jnp.ndim(per_lane) else per_lane


ENERGY = Conserved("energy", total, kinetic)
"""Total energy, its errors measured by the kinetic energy."""
MOMENTUM = Conserved("momentum", momentum, lambda scene, t, s: summed(scene, norm(s.linear_momentum(scene.mass))))
"""Total momentum, its errors measured by Σm|v|."""
ANGULAR_MOMENTUM = Conserved(
    "angular momentum",
    angular_momentum,
    lambda scene, t, s: summed(scene, _angular_momentum_size(scene, s)),
)
"""Angular momentum about the origin, its errors measured by Σm|r||v|, and |L| of rigid bodies."""


@announce_compiling("the ledger")
def ledger(trajectory: Trajectory, scene: Scene | None = None) -> "Ledger":
    """Where the energy of a run went, and its momentum and angular momentum: a `Ledger`, to be printed or drawn (`.plot()`).

    Every step is taken again from the frames and compared with the exact motion from the same start, along which the work
    and the impulse of each force are integrated: so the method's own gain or loss is measured, and that the entries sum to
    zero is a test. In float64 whatever the run's type; the rounding of a float32 run then counts as the method's. Costs a
    few hundred evaluations of the forces per step. Give the `scene` if the trajectory does not know it. Raises TypeError or
    ValueError for what is no run of a method, and for contacts with a user's own response.

    Example:
        >>> received = energy.ledger(flight).energy.totals
        >>> round(float(received["kinetic"]), 2), round(float(received["potential of Gravity"]), 2)
        (227.36, -227.36)
    """
    from physjax.study.energy.budget import build_ledger

    return build_ledger(trajectory, scene)
