"""A ragdoll whose joints hold exactly and turn no farther than a body's do; metres, x to its left, y up, z forward."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.show import solids
from physjax.study import energy
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

LIMBS = {
    # mass [kg], radius [m], length of the axis of its capsule [m], the axis along it, and its centre [m]
    "pelvis": (12.0, 0.12, 0.12, 0, (0.0, 1.0, 0.0)),
    "chest": (22.0, 0.14, 0.2, 1, (0.0, 1.3, 0.0)),
    "head": (5.0, 0.1, 0.06, 1, (0.0, 1.67, 0.0)),
    "left arm": (2.2, 0.05, 0.2, 0, (0.34, 1.44, 0.0)),
    "left forearm": (1.6, 0.045, 0.22, 0, (0.64, 1.44, 0.0)),
    "right arm": (2.2, 0.05, 0.2, 0, (-0.34, 1.44, 0.0)),
    "right forearm": (1.6, 0.045, 0.22, 0, (-0.64, 1.44, 0.0)),
    "left thigh": (8.0, 0.075, 0.3, 1, (0.1, 0.72, 0.0)),
    "left shin": (4.0, 0.055, 0.34, 1, (0.1, 0.3, 0.0)),
    "right thigh": (8.0, 0.075, 0.3, 1, (-0.1, 0.72, 0.0)),
    "right shin": (4.0, 0.055, 0.34, 1, (-0.1, 0.3, 0.0)),
}
SOCKETS = (
    # the two limbs, the place of the joint [m], the axis that the second turns away from, and by how much at most [rad]
    ("pelvis", "chest", (0.0, 1.12, 0.0), (0.0, 1.0, 0.0), 0.5),
    ("chest", "head", (0.0, 1.55, 0.0), (0.0, 1.0, 0.0), 0.6),
    ("chest", "left arm", (0.2, 1.44, 0.0), (1.0, 0.0, 0.0), 1.5),
    ("chest", "right arm", (-0.2, 1.44, 0.0), (-1.0, 0.0, 0.0), 1.5),
    ("pelvis", "left thigh", (0.1, 0.92, 0.0), (0.0, -1.0, 0.0), 0.9),
    ("pelvis", "right thigh", (-0.1, 0.92, 0.0), (0.0, -1.0, 0.0), 0.9),
)
HINGES = (
    # the two limbs, the place of the joint [m] and its axis: elbows bend forward, knees back
    ("left arm", "left forearm", (0.49, 1.44, 0.0), (0.0, -1.0, 0.0)),
    ("right arm", "right forearm", (-0.49, 1.44, 0.0), (0.0, 1.0, 0.0)),
    ("left thigh", "left shin", (0.1, 0.51, 0.0), (1.0, 0.0, 0.0)),
    ("right thigh", "right shin", (-0.1, 0.51, 0.0), (1.0, 0.0, 0.0)),
)
SPIN = (1.0, 1.5, 0.0)
"""Its angular velocity at the start [rad/s]."""
BEND = 2.4
"""By how much elbows and knees bend [rad]; they do not bend the other way."""


@scene
def hung_ragdoll(g: float = 9.8) -> Problem:
    """A ragdoll of eleven limbs falls with its arms spread, held by one hand, and dangles: no joint opens or turns too far."""
    names = list(LIMBS)
    mass, radius, length, axis, middle = zip(*LIMBS.values(), strict=True)
    shapes = zip(mass, radius, length, axis, strict=True)
    moments = [inertia.capsule(*limb, axis=along).principal for *limb, along in shapes]
    limbs = inertia.Inertia(np.array(mass), jnp.stack(moments))
    middle = np.array(middle)
    place = lambda pairs, points: np.array(points)[:, None] - middle[pairs]  # noqa: E731
    number = lambda joints: np.array([[names.index(name) for name in joint[:2]] for joint in joints])  # noqa: E731
    _, _, points, axes, cone = zip(*SOCKETS, strict=True)
    pairs = number(SOCKETS)
    sockets = rigid.Joints(pairs, place(pairs, points), axis=axes, cone=np.array(cone))
    _, _, points, axes = zip(*HINGES, strict=True)
    pairs = number(HINGES)
    hinges = rigid.Hinges(pairs, place(pairs, points), axis=axes, limits=(0.0, BEND))
    hand = np.array([0.8, 1.44, 0.0])
    held = names.index("left forearm")
    grip = rigid.Joints([(-1, held)], [[hand, hand - middle[held]]])
    # turning as a whole about the hand, so that no limb stays in the plane of the others
    start = rigid.bodies(limbs, middle, velocity=np.cross(SPIN, middle - hand), angular_velocity=SPIN)
    hung = Scene(start, limbs, (forces.Gravity(g), sockets, hinges, grip))

    def see(flight: Trajectory, measure) -> np.ndarray:
        return np.asarray(jax.vmap(measure)(jax.tree.map(jnp.asarray, flight.state)))

    def exceed(flight: Trajectory) -> np.ndarray:
        angle = see(flight, hinges.angle)
        return np.maximum(angle - BEND, -angle).clip(0.0)

    def gain(flight: Trajectory) -> np.ndarray:
        stored = np.asarray(jax.vmap(lambda t, s: energy.total(hung, t, s))(flight.time, flight.state))
        return np.diff(stored).clip(0.0) / (np.sum(mass) * g)

    return Problem(
        hung,
        duration=3.0,
        truths=(
            Truth("no joint opens [m]", lambda f: see(f, sockets.error), 0.0, 1e-9),
            Truth("elbows and knees bend one way alone, and no farther than they can [rad]", exceed, 0.0, 1e-3),
            Truth("limits take energy and give none [m]", gain, 0.0, 1e-2),
        ),
        looks=[solids.capsule(*limb, axis=along) for *limb, along in zip(radius, length, axis, strict=True)],
        frames=24,
    )
