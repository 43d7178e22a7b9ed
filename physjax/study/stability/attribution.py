"""What sets a limit: the force with the largest part in a mode, the spring that is strained most, and the lane that moves."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from physjax.particles import Particles, callable_name
from physjax.parts import Force
from physjax.physics.springs.springs import Springs
from physjax.scene import Scene
from physjax.study.stability.joint_forces import JointForces
from physjax.study.stability.linearisation import SmallMotion
from physjax.study.stability.planar import strip_angles


class Attribution(NamedTuple):
    """Cause ("stiffness" or "damping"), name of the force, its spring if any, the lane that moves most, and λ [1/s]."""

    cause: str
    force: str
    spring: tuple[int, int] | None
    node: tuple[int, ...]
    rate: complex


def attribute_mode(
    scene: Scene, state: Particles, motion: SmallMotion, block: tuple[int, ...], mode: np.ndarray
) -> Attribution:
    """What sets the rate of a mode of a block: each force's share in its stiffness and damping, as Rayleigh's quotient."""
    inner = motion.displacement(block, mode)
    shape = state.position.shape[len(block) :]
    weight = np.broadcast_to(np.sqrt(np.asarray(scene.mass))[..., None], state.position.shape)[block]
    moved = np.zeros(state.position.shape, complex)
    moved[block] = inner.reshape(shape) / weight
    forces = [force for force in scene.forces if force.response is None]
    joints = [JointForces.of(scene)] if scene.constraints else []
    acting = [*forces, *joints]
    shares = [np.asarray(_measure_force_shares(force, scene, state, jnp.asarray(moved))) for force in acting]
    stiffness, damping = np.sum(shares, axis=0)
    # λ² + damping λ + stiffness = 0, for a mode of length 1 as if it were an oscillator of its own
    root = np.sqrt(complex(damping**2 / 4 - stiffness))
    rate = -damping / 2 - root
    kind = int(abs(rate.real) >= abs(rate.imag))
    force = acting[int(np.argmax([abs(share[kind]) for share in shares]))]
    size = np.sum(np.abs(moved) ** 2, axis=-1)
    node = tuple(int(i) for i in np.unravel_index(np.argmax(size), size.shape))
    load, seen = strip_angles(force, state)
    moved = moved[..., : seen.position.shape[-1]]
    spring = _find_worst_spring(load, seen, moved, kind, block) if isinstance(load, Springs) else None
    return Attribution(("stiffness", "damping")[kind], callable_name(force), spring, node, complex(rate))


@jax.jit
def _measure_force_shares(
    force: Force, scene: Scene, state: Particles, moved: Complex[Array, "*lanes dim"]
) -> Float[Array, "2"]:
    """A force's share in a mode's stiffness and damping: -d·∂F/∂x d and -d·∂F/∂v d."""
    free = 1.0 if scene.held is None else 1 - jnp.asarray(scene.held)[..., None].astype(state.dtype)
    still = jnp.zeros_like(state.position)
    push = lambda s: force(jnp.zeros((), s.dtype), s, scene.mass)  # noqa: E731
    change = lambda *tangent: jax.jvp(push, (state,), (Particles(*tangent),))[1]  # noqa: E731
    total = jnp.zeros(2, state.dtype)
    for part in (moved.real * free, moved.imag * free):
        total = total - jnp.stack([jnp.sum(part * change(part, still)), jnp.sum(part * change(still, part))])
    return total


def _find_worst_spring(
    springs: Springs, state: Particles, moved: np.ndarray, kind: int, block: tuple[int, ...]
) -> tuple[int, int]:
    """The spring that stores most of a mode's energy, or dissipates most of its power."""
    still = jnp.zeros_like(state.velocity)
    stretch = [
        np.asarray(jax.jvp(springs.length, (state,), (Particles(jnp.asarray(part), still),))[1])
        for part in (np.real(moved), np.imag(moved))
    ]
    number = np.asarray(springs.damping if kind else springs.stiffness)
    share = np.broadcast_to(number, stretch[0].shape) * (stretch[0] ** 2 + stretch[1] ** 2)
    first, second = springs.pairs[int(np.argmax(share[block]))]
    return int(first), int(second)
