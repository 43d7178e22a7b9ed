"""Small motions about a state: which rates a scene has, in which modes, and what a method's step makes of them.

About a state, a deviation d (in coordinates √m δx, which make springs symmetric) moves as d̈ = -K d - C ḋ. A method
that steps the whole state along its rate sees nothing but the eigenvalues λ of that; one that kicks and drifts sees K
and C themselves. Contacts are left out: they act at impacts, not in between, or hold implicitly what rests.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from physjax.particles import Particles, demand_particles
from physjax.parts import Force
from physjax.physics.rigid.planar import PlanarBodies
from physjax.scene import Scene
from physjax.stepping.reference import cast_floats
from physjax.study.stability.planar import State, convert_scene

MAX_DENSE_COORDINATES = 300
"""Coordinates of a scene up to which all its modes are found; of larger ones those that move fastest."""
KRYLOV_VECTORS = 60
"""Vectors for the fastest modes of stiffness and as many for damping."""


DRIFT_RATE_SHARE = 1e-6
"""Modes slower than this share of the fastest are drifts (a body free to move as a whole): they grow with time, not dt."""
ROUNDING_RATE_SHARE = 1e-9
"""A real part below this share of the fastest rate is rounding."""
INDEPENDENT_SHARE = 1e-10
"""A vector of which the basis leaves less than this share is in its span."""
COMMUTATOR_TOLERANCE = 1e-12
"""Rounding of the commutator of two matrices of order 1."""


class SmallMotion(NamedTuple):
    """Stiffness K [1/s²] and damping C [1/s] in coordinates √m δx, `(*blocks, n, n)`: a block for each entry of a status.

    The rows of `basis` `(*blocks, n, coordinates)` are the n coordinates; None where they are the lanes' components one
    after the other.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    basis: np.ndarray | None

    def rates(self) -> np.ndarray:
        """Eigenvalues λ [1/s] of each block, `(*blocks, 2n)`: Re λ is growth, Im λ an angular frequency."""
        return np.linalg.eigvals(self._rate_matrix())

    def modes(self, block: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues of one block and its modes as columns: positions above, velocities below."""
        return np.linalg.eig(self._rate_matrix()[block])

    def growth_projector(self, partners: bool = False) -> np.ndarray | None:
        """Projectors on the modes that grow by themselves, as matrices on (d, ḋ), `(*blocks, 2n, 2n)`; None without any.

        Growth is e^(λt) however slow, drifts excepted. They project along all the other modes, so that a motion without
        that part goes on as if none of it grew. With `partners` modes that decay as fast as another grows are included:
        without damping they have the same displacements.
        """
        # in units in which displacements and velocities of the fastest motion are of one size: well conditioned
        fastest = self.fastest_rate()
        fastest_rate = np.where(fastest > 0, fastest, 1.0)
        unit = np.concatenate(
            [np.broadcast_to(a, self.stiffness.shape[:-1]) for a in (fastest_rate[..., None], 1.0)], axis=-1
        )
        scaled = self._rate_matrix() * unit[..., :, None] / unit[..., None, :]
        found = np.zeros_like(scaled)
        for block in np.ndindex(scaled.shape[:-2]):
            λ, right = np.linalg.eig(scaled[block])
            growth = np.real(λ)
            size = np.abs(growth) if partners else growth
            grows = (size > ROUNDING_RATE_SHARE * fastest_rate[block]) & (
                np.abs(λ) > DRIFT_RATE_SHARE * fastest_rate[block]
            )
            if not grows.any():
                continue
            same, left = np.linalg.eig(scaled[block].T)
            # a matrix and its transpose have the same eigenvalues, in another order: match each with the nearest
            matched = []
            for number in λ[grows]:
                distance = np.abs(same - number)
                distance[matched] = np.inf
                matched.append(int(np.argmin(distance)))
            right, left = right[:, grows], left[:, matched]
            found[block] = (right @ np.linalg.solve(left.T @ right, left.T)).real
        return found / unit[..., :, None] * unit[..., None, :] if found.any() else None

    def fastest_rate(self) -> np.ndarray:
        """The fastest rate of each block [1/s]."""
        return np.abs(self.rates()).max(axis=-1)

    def displacement(self, block: tuple[int, ...], mode: np.ndarray) -> np.ndarray:
        """The positions of a mode of a block, `(coordinates,)` complex, of length 1."""
        n = self.stiffness.shape[-1]
        # a drift has velocities alone; every other mode has displacements
        moved = mode[:n] if np.linalg.norm(mode[:n]) > 0 else mode[n:]
        moved = moved if self.basis is None else moved @ self.basis[block]
        return moved / np.linalg.norm(moved)

    @property
    def undamped(self) -> bool:
        """Whether forces depend on positions alone: every method then steps each mode by itself."""
        return not np.any(self.damping)

    def _rate_matrix(self) -> np.ndarray:
        zero = np.zeros_like(self.stiffness)
        one = zero + np.eye(zero.shape[-1])
        return np.block([[zero, one], [-self.stiffness, -self.damping]])


def prepare_linearisation(scene: Scene, at: State | None) -> tuple[Scene, Particles]:
    """A scene in float64 and the state about which its small motions are asked for: its own, if none is given.

    Bodies in the plane are particles with three coordinates each, without contacts.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"stability: got a {type(scene).__name__}, expected a Scene.")
    scene = cast_floats(scene, jnp.float64)
    kind = type(scene.state)
    if at is not None and len(at) != len(scene.state):
        raise TypeError(f"at: got a state of type {type(at).__name__}, expected the scene's {kind.__name__}.")
    state = scene.state if at is None else kind(*(jnp.asarray(a, jnp.float64) for a in at))
    if state.position.shape != scene.state.position.shape:
        raise ValueError(
            f"at: got positions of shape {state.position.shape}, expected the scene's {scene.state.position.shape}."
        )
    return convert_scene(scene, state) if isinstance(state, PlanarBodies) else (scene, state)


def linearise(scene: Scene, state: Particles) -> SmallMotion:
    """K and C of a scene about a state; held lanes do not move. Of large coupled scenes, their fastest modes."""
    demand_particles("small motions", state, "what turns in space is not linearised")
    inside = scene.state.lanes[-1:] if scene.couples else ()
    size = int(np.prod(inside)) * state.position.shape[-1]
    if size <= MAX_DENSE_COORDINATES:
        stiffness, damping = _build_dense_matrices(scene, state, size)
        return SmallMotion(np.asarray(stiffness), np.asarray(damping), None)

    def apply(vector: np.ndarray, damping: bool) -> np.ndarray:
        pair = (vector, np.zeros_like(vector))
        return np.asarray(
            _apply_stiffness_and_damping(scene, state, *map(jnp.asarray, pair[::-1] if damping else pair))
        )

    # Krylov vectors K^i d and C^i d of a random d span the fastest modes of each; the rest is too slow to set a limit
    start = np.random.default_rng(0).normal(size=(*scene.status_shape, size))
    basis: list[np.ndarray] = []
    for damping in (False, True):
        vector, fresh = start, True
        for _ in range(KRYLOV_VECTORS):
            vector, fresh = _orthonormalise(vector, basis)
            if not fresh:
                break
            basis.append(vector)
            vector = apply(vector, damping)
    rows = np.stack(basis, axis=-2)
    project = lambda damping: rows @ np.stack([apply(vector, damping) for vector in basis], axis=-1)  # noqa: E731
    return SmallMotion(project(False), project(True), rows)


def _orthonormalise(vector: np.ndarray, basis: list[np.ndarray]) -> tuple[np.ndarray, bool]:
    """The part of a vector that is orthogonal to the basis, of length 1, and whether there is any."""
    before = np.linalg.norm(vector, axis=-1, keepdims=True)
    for _ in range(2):  # the first pass leaves rounding errors of the size of what it removes
        for other in basis:
            vector = vector - np.sum(vector * other, axis=-1, keepdims=True) * other
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 0, length, 1.0), bool(np.all(length > INDEPENDENT_SHARE * before))


@eqx.filter_jit
def _apply_stiffness_and_damping(scene: Scene, state: Particles, moved: Array, speed: Array) -> Array:
    """K d + C ḋ for coordinates d and ḋ, `(*blocks, n)`."""
    weight = sqrt_mass(scene, state)
    tangent = Particles(*(_zero_held(scene, a.reshape(state.position.shape)) / weight for a in (moved, speed)))
    change = jax.jvp(lambda s: scene.acceleration(jnp.zeros((), s.dtype), s), (state,), (tangent,))[1]
    return -(weight * _zero_held(scene, change)).reshape(moved.shape)


@eqx.filter_jit
def _build_dense_matrices(scene: Scene, state: Particles, size: int) -> tuple[Array, Array]:
    """K and C column by column."""
    blocks = scene.status_shape
    unit = jnp.eye(2 * size, dtype=state.dtype).reshape((2 * size, *(1,) * len(blocks), 2 * size))
    moved, speed = jnp.split(jnp.broadcast_to(unit, (2 * size, *blocks, 2 * size)), 2, axis=-1)
    columns = jax.vmap(lambda moved, speed: _apply_stiffness_and_damping(scene, state, moved, speed))(moved, speed)
    stiffness, damping = (jnp.moveaxis(a, 0, -1) for a in jnp.split(columns, 2))
    return stiffness, damping


def sqrt_mass(scene: Scene, state: Particles) -> Array:
    """√m for each component of each lane: displacements times this are the coordinates."""
    return jnp.broadcast_to(jnp.sqrt(scene.mass)[..., None], state.position.shape)


def _zero_held(scene: Scene, a: Array) -> Array:
    return a if scene.held is None else a * (1 - jnp.asarray(scene.held)[..., None].astype(a.dtype))


class _LinearForce(Force):
    """F = -(K x + C v)."""

    couples: ClassVar[bool] = True
    stiffness: Array
    damping: Array

    def __call__(self, t: ArrayLike, state: Particles, mass: Array) -> Array:
        return -(self.stiffness @ state.position + self.damping @ state.velocity)


@eqx.filter_jit
def step_matrices(method: Callable, stiffness: Array, damping: Array, dt: Array) -> Array:
    """The matrix of one step of a method on each block's small motion, `(blocks, 2n, 2n)`; `dt` is `(blocks,)`."""

    def build_matrix(stiffness: Array, damping: Array, dt: Array) -> Array:
        n = stiffness.shape[0]
        still = jnp.zeros((n, 1), stiffness.dtype)
        scene = Scene(Particles(still, still), forces=(_LinearForce(stiffness, damping),))

        def step_column(y: Array) -> Array:
            after = method(scene, jnp.zeros((), y.dtype), Particles(y[:n, None], y[n:, None]), dt)
            return jnp.concatenate(after)[:, 0]

        return jax.vmap(step_column, out_axes=1)(jnp.eye(2 * n, dtype=stiffness.dtype))

    return jax.vmap(build_matrix)(stiffness, damping, dt)


@eqx.filter_jit
def spectral_radius(method: Callable, z: Complex[Array, "..."]) -> Float[Array, "..."]:
    """Spectral radius of one step of a method at z = λ dt, on x″ = −|λ|²x + 2Re(λ)x′, for complex numbers of any shape."""
    flat = jnp.ravel(z)
    stiffness, damping = (jnp.abs(flat) ** 2)[:, None, None], (-2 * flat.real)[:, None, None]
    m = step_matrices(method, stiffness, damping, jnp.ones_like(flat.real))
    half, product = (m[:, 0, 0] + m[:, 1, 1]) / 2, m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    # a real pair of eigenvalues, or a complex one, whose radius is the root of the determinant
    discriminant = half * half - product
    real = jnp.abs(half) + jnp.sqrt(jnp.maximum(discriminant, 0.0))
    return jnp.where(discriminant > 0, real, jnp.sqrt(jnp.maximum(product, 0.0))).reshape(z.shape)


def follows_rates(method: Callable) -> bool:
    """Whether a step is a function of the rate's matrix alone: it then commutes with it, whatever K and C are.

    Tried on one pair of matrices that do not commute, which no other step passes by chance.
    """
    stiffness, damping = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[0.3, -0.4], [-0.4, 1.5]])
    rate = SmallMotion(stiffness, damping, None)._rate_matrix()
    step = step_matrices(method, jnp.asarray(stiffness[None]), jnp.asarray(damping[None]), jnp.full(1, 0.3))
    step = np.asarray(step)[0]
    return bool(np.abs(step @ rate - rate @ step).max() < COMMUTATOR_TOLERANCE)


def rate_text(rate: complex) -> str:
    """A rate in few digits: real, imaginary or a conjugate pair."""
    if abs(rate.imag) < ROUNDING_RATE_SHARE * abs(rate):
        return f"{rate.real:.4g}"
    return (
        f"±{abs(rate.imag):.4g}i"
        if abs(rate.real) < ROUNDING_RATE_SHARE * abs(rate)
        else f"{rate.real:.4g} ± {abs(rate.imag):.4g}i"
    )
