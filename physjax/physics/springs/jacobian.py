"""Springs linearised at a state, for implicit steps, with a Jacobian that is symmetric and negative semidefinite."""

import operator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import block_fusion
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics.springs.topology import SpringTopology


class LinearisedSlot(NamedTuple):
    """The springs of a slot at a state: differences of position d [m], by layout and by component, and g, h, γ."""

    edge: Any
    along: list[Array]
    g: Array
    h: Array
    gamma: Array | None


class LinearisedSprings(Force):
    """Springs linearised at a state: F ≈ F₀ + Σ g u + h (d·u) d + γ (d·w) d, for displacements u and velocity changes w.

    With g = k max(0, 1 - L/l) and h = (k - g)/l² this is the exact Jacobian of a stretched spring. The transverse
    stiffness k (1 - L/l) of a compressed one is negative, which can make the system of an implicit step singular: it is
    replaced by zero (K.-J. Choi, H.-S. Ko, "Stable but responsive cloth", ACM Trans. Graph. 21 (2002) 604). γ = c/l² is
    the exact Jacobian of damping by velocity; that by position is not symmetric and is left out.
    """

    couples: ClassVar[bool] = True
    dissipative_symmetric: ClassVar[bool] = True
    topology: SpringTopology = eqx.field(static=True)
    state: Particles
    force: Float[Array, "*scenes nodes dim"]
    springs: list[LinearisedSlot]

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes dim"]:
        """The force [N], affine in the state."""
        topology, near = self.topology, self.topology.neighbours
        moved = [a - b for a, b in zip(state, self.state, strict=True)]
        damped = self.springs[0].gamma is not None
        edges, parts = topology.differences(*(moved if damped else moved[:1]))
        pulls = []
        for slot, (edge, at) in enumerate(zip(edges, self.springs, strict=True)):
            pull = at.h * product(at.along, parts[0][slot])
            if at.gamma is not None:
                pull = pull + at.gamma * product(at.along, parts[1][slot])
            # materialised: every component of the force reads it
            pull = block_fusion(pull)
            terms = near.scale_edges(at.g, edge), near.scale_edges(pull, at.edge)
            pulls.append(jax.tree.map(operator.add, *terms))
        return self.force + topology.resultant(pulls)


def product(a: list[Array], b: list[Array]) -> Array:
    """a·b of vectors given as lists of components."""
    total = a[0] * b[0]
    for p, q in zip(a[1:], b[1:], strict=True):
        total = total + p * q
    return total


def spring_jacobian_coefficients(k: Array, ratio: Array, square: Array) -> tuple[Array, Array]:
    """g and h of `LinearisedSprings`, of springs of stiffness k [N/m], from the ratio L/l and the square l² [m²]."""
    g = k * jnp.maximum(1 - ratio, 0.0)
    return g, (k - g) / square
