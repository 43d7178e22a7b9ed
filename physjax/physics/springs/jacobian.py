"""What an implicit step sees of springs: the force near a state, with a derivative that always pushes back."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import block_fusion
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics.springs.topology import SpringTopology


class LinearisedSprings(Force):
    """Springs near a state: F ≈ F₀ + Σ g u + h (d·u) d + γ (d·w) d, for ends displaced by u and faster by w.

    With g = k max(0, 1 - L/l) and h = (k - g)/l² this is the exact derivative of a stretched spring by position. A
    compressed one would push sideways out of line (1 - L/l < 0), which may leave an implicit step without an answer;
    here it only does not resist that (Choi and Ko 2002). γ = c/l² is the exact derivative of damping by velocity; that
    by position, which is not symmetric, is left out. The matrix is then symmetric and never positive.
    """

    couples: ClassVar[bool] = True
    dissipative_symmetric: ClassVar[bool] = True
    topology: SpringTopology = eqx.field(static=True)
    state: Particles
    force: Float[Array, "*scenes nodes dim"]
    springs: list[tuple]

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes dim"]:
        """The force [N], affine in the state."""
        topology = self.topology
        moved = [a - b for a, b in zip(state, self.state, strict=True)]
        damped = self.springs[0][-1] is not None
        parts = topology.parts(*(moved if damped else moved[:1]))
        pulls = []
        for slot, (edge, (along, parts_along, g, h, gamma)) in enumerate(
            zip(topology.edges(moved[0]), self.springs, strict=True)
        ):
            pull = h * product(parts_along, parts[0][slot])
            if damped:
                pull = pull + gamma * product(parts_along, parts[1][slot])
            pull = block_fusion(pull)
            pulls.append(topology.neighbours.scale_edges(g, edge) + topology.neighbours.scale_edges(pull, along))
        return self.force + topology.resultant(pulls)


def product(a: list[Array], b: list[Array]) -> Any:
    """a·b from lists of components."""
    total = a[0] * b[0]
    for p, q in zip(a[1:], b[1:], strict=True):
        total = total + p * q
    return total


def spring_jacobian_coefficients(k: Array, ratio: Array, square: Array) -> tuple[Array, Array]:
    """g and h of a spring of stiffness k [N/m], from L/l and l²."""
    g = k * jnp.maximum(1 - ratio, 0.0)
    return g, (k - g) / square
