"""A ragdoll, in metres: x in the direction it is dragged, y up, z to its right."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, quantity
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.show import solids
from physjax.study.problem import Problem, Truth
from physjax.vectors import broadcast_vector, scale

LIMBS = {
    # mass [kg], radius [m], length of the axis of its capsule [m], x and z of its centre [m]
    "torso": (32.0, 0.13, 0.36, 0.0, 0.0),
    "head": (5.0, 0.1, 0.06, 0.44, 0.0),
    "arm": (2.2, 0.05, 0.2, 0.32, 0.2),
    "forearm": (1.6, 0.045, 0.22, 0.62, 0.2),
    "other arm": (2.2, 0.05, 0.2, 0.04, -0.2),
    "other forearm": (1.6, 0.045, 0.22, -0.26, -0.2),
    "thigh": (8.0, 0.075, 0.3, -0.5, 0.1),
    "shin": (4.0, 0.055, 0.34, -0.92, 0.1),
    "other thigh": (8.0, 0.075, 0.3, -0.5, -0.1),
    "other shin": (4.0, 0.055, 0.34, -0.92, -0.1),
}
JOINT_PLACES = (
    # the two limbs, x and z of the joint [m]
    ("torso", "head", 0.31, 0.0),
    ("torso", "arm", 0.18, 0.2),
    ("arm", "forearm", 0.47, 0.2),
    ("torso", "other arm", 0.18, -0.2),
    ("other arm", "other forearm", -0.1, -0.2),
    ("torso", "thigh", -0.3, 0.1),
    ("thigh", "shin", -0.7, 0.1),
    ("torso", "other thigh", -0.3, -0.1),
    ("other thigh", "other shin", -0.7, -0.1),
)


class TowSpring(Force):
    """A damped spring to a point that starts smoothly: F = k (X - x) + c (X' - v), X = X₀ + U (t - τ(1 - e^(-t/τ)))."""

    couples: ClassVar[bool] = False
    start: Numbers = quantity("position at t = 0", "m", kind="place")
    velocity: Numbers = quantity("final velocity of the point", "m/s", kind="vector")
    soft: Numbers = quantity("time constant τ of the start", "s", above=0)
    stiffness: Numbers = quantity("stiffness k", "N/m", at_least=0)
    damping: Numbers = quantity("damping c", "kg/s", at_least=0)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The pull [N]."""
        x, v = state
        begun = 1 - jnp.exp(-t / self.soft)  # pyright: ignore[reportOperatorIssue]  # a time is no boolean, which has no minus
        place = broadcast_vector(self.start, x) + scale(
            jnp.subtract(t, self.soft * begun), broadcast_vector(self.velocity, v)
        )
        slip = scale(begun, broadcast_vector(self.velocity, v)) - v
        return scale(self.stiffness, place - x) + scale(self.damping, slip)


@scene
def ragdoll(speed: float = 1.5, friction: float = 0.4, g: float = 9.8) -> Problem:
    """A ragdoll of ten limbs and nine ball joints, dragged over the ground by one hand.

    The joints are stiff springs, the tow a soft one; the ends of the limbs slide with friction.
    """
    limbs, radius, length, middle, joints = _build_limbs()
    towed = np.array(list(LIMBS)) == "forearm"
    hand = np.array([length[towed][0] / 2, 0.0, 0.0])
    lead = {"soft": 0.3, "stiffness": 1e4 * towed, "damping": 500.0 * towed}
    tow = rigid.AtPoint(hand, TowSpring(middle[towed][0] + hand, (speed, 0.0, 0.0), **lead))
    ends = np.multiply.outer(length, [[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    rough = contacts.Coulomb(friction, friction)
    ground = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0, coulomb=rough)
    touching = rigid.SurfaceContact(rigid.ContactPoints(ends, radius), ground)
    dragged = Scene(rigid.bodies(limbs, middle), limbs, (forces.Gravity(g), joints, tow), (touching,))
    duration, frames = 4.0, 64

    def joint_error(flight):
        return jax.vmap(joints.error)(jax.tree.map(jnp.asarray, flight.state))

    def pace(flight):
        mass = np.asarray(limbs.mass)
        place = mass @ flight.position[[frames // 2, -1], :, 0].T / mass.sum()
        return np.diff(place)[0] / (speed * duration / 2)

    def pull(flight):
        state = jax.tree.map(jnp.asarray, flight.state)
        force = jax.vmap(lambda t, state: tow(t, state, limbs).force)(flight.time, state)
        along, up, _ = np.asarray(force)[frames // 2 :, towed].mean(axis=(0, 1))
        return along / (friction * (np.sum(limbs.mass) * g - up))

    looks = [solids.capsule(*limb, axis=0) for limb in zip(radius, length, strict=True)]
    return Problem(
        dragged,
        duration=duration,
        truths=(
            Truth("no joint opens by a millimetre at any frame [m]", joint_error, 0.0, 1e-3),
            Truth("moves with the mean velocity of the hand [relative]", pace, 1.0, 0.02),
            Truth("pulls with F_x/(μ(mg - F_y)) of 0.9 to 1: some of the slip is sideways [1]", pull, 0.95, 0.05),
        ),
        looks=looks,
        frames=frames,
    )


def _build_limbs() -> tuple[inertia.Inertia, np.ndarray, np.ndarray, np.ndarray, rigid.Joints]:
    """Inertia, radius, length and centre [m] of each limb, lying on the ground, and the joints between them."""
    names = list(LIMBS)
    mass, radius, length, x, z = np.array(list(LIMBS.values())).T
    height = radius.max()
    middle = np.stack([x, np.full_like(x, height), z], axis=-1)
    pairs = np.array([[names.index(name) for name in pair] for *pair, _, _ in JOINT_PLACES])
    where = np.array([[x, height, z] for *_, x, z in JOINT_PLACES])
    joints = rigid.Joints(pairs, where[:, None] - middle[pairs], stiffness=1e6, damping=300.0)
    moments = [inertia.capsule(*limb, axis=0).principal for limb in zip(mass, radius, length, strict=True)]
    return inertia.Inertia(mass, jnp.stack(moments)), radius, length, middle, joints
