"""Ragdolls, whose joints hold exactly and turn no farther than a body's do; metres, x to its left, y up, z forward."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
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
STEPS, RISE, TREAD, WIDTH = 5, 0.2, 0.35, 3.0
"""Steps of the stairs, and their height, depth and width [m]."""
BEND = 2.4
"""By how much elbows and knees bend [rad]; they do not bend the other way."""


class _Doll(NamedTuple):
    """What a ragdoll is made of: its limbs, the middles of these [m], its joints, and what each limb looks like."""

    limbs: inertia.Inertia
    middle: np.ndarray
    sockets: rigid.Joints
    hinges: rigid.Hinges
    looks: list[solids.Shape]

    @property
    def pairs(self) -> set[tuple[int, int]]:
        """The limbs that are joined."""
        return {(int(a), int(b)) for joints in (self.sockets, self.hinges) for a, b in joints.pairs}


def _build_doll() -> _Doll:
    names = list(LIMBS)
    mass, radius, length, axis, middle = zip(*LIMBS.values(), strict=True)
    moments = [
        inertia.capsule(*limb, axis=along).principal for *limb, along in zip(mass, radius, length, axis, strict=True)
    ]
    middle = np.array(middle)
    place = lambda pairs, points: np.array(points)[:, None] - middle[pairs]  # noqa: E731
    number = lambda joints: np.array([[names.index(name) for name in joint[:2]] for joint in joints])  # noqa: E731
    _, _, points, axes, cone = zip(*SOCKETS, strict=True)
    pairs = number(SOCKETS)
    sockets = rigid.Joints(pairs, place(pairs, points), axis=axes, cone=np.array(cone))
    _, _, points, axes = zip(*HINGES, strict=True)
    pairs = number(HINGES)
    hinges = rigid.Hinges(pairs, place(pairs, points), axis=axes, limits=(0.0, BEND))
    looks = [solids.capsule(*limb, axis=along) for *limb, along in zip(radius, length, axis, strict=True)]
    return _Doll(inertia.Inertia(np.array(mass), jnp.stack(moments)), middle, sockets, hinges, looks)


def _see(flight: Trajectory, measure: Callable) -> np.ndarray:
    return np.asarray(jax.vmap(measure)(jax.tree.map(jnp.asarray, flight.state)))


def _judge(doll: _Doll, played: Scene, most: float) -> tuple[Truth, ...]:
    """That no joint opens or turns too far, and that the whole gains no more energy in a frame than lifts it by `most` [m]."""

    def exceed(flight: Trajectory) -> np.ndarray:
        angle = _see(flight, doll.hinges.angle)
        return np.maximum(angle - BEND, -angle).clip(0.0)

    def gain(flight: Trajectory) -> np.ndarray:
        stored = np.asarray(jax.vmap(lambda t, s: energy.total(played, t, s))(flight.time, flight.state))
        return np.diff(stored).clip(0.0) / (np.sum(doll.limbs.mass) * 9.8)

    return (
        Truth("no joint opens [m]", lambda f: _see(f, doll.sockets.error), 0.0, 1e-9),
        Truth("elbows and knees bend one way alone, and no farther than they can [rad]", exceed, 0.0, 1e-3),
        Truth("limits and hits take energy and give none [m]", gain, 0.0, most),
    )


@scene
def hung_ragdoll(g: float = 9.8) -> Problem:
    """A ragdoll of eleven limbs falls with its arms spread, held by one hand, and dangles: no joint opens or turns too far."""
    doll = _build_doll()
    hand = np.array([0.8, 1.44, 0.0])
    held = list(LIMBS).index("left forearm")
    grip = rigid.Joints([(-1, held)], [[hand, hand - doll.middle[held]]])
    # turning as a whole about the hand, so that no limb stays in the plane of the others
    start = rigid.bodies(doll.limbs, doll.middle, velocity=np.cross(SPIN, doll.middle - hand), angular_velocity=SPIN)
    hung = Scene(start, doll.limbs, (forces.Gravity(g), doll.sockets, doll.hinges, grip))
    return Problem(hung, duration=3.0, truths=_judge(doll, hung, 1e-2), looks=doll.looks, frames=24)


@scene
def thrown_ragdoll(g: float = 9.8) -> Problem:
    """A ragdoll is thrown down five stairs, head over heels: no joint opens, and no limb goes through a step."""
    doll, count = _build_doll(), len(LIMBS)
    heights = RISE * np.arange(STEPS, 0, -1)
    steps = np.stack([np.zeros(STEPS), heights / 2, TREAD * np.arange(STEPS)], axis=1)
    place = np.concatenate([doll.middle + np.array([0.0, heights[0] + 0.1, 0.0]), steps])
    mass = np.append(doll.limbs.mass, np.ones(STEPS))
    bodies = inertia.Inertia(mass, jnp.concatenate([doll.limbs.principal, jnp.ones((STEPS, 3))]))
    spin, velocity = np.zeros_like(place), np.zeros_like(place)
    spin[:count] = 1.5, 0.2, 0.0
    velocity[:count] = np.array([0.3, 0.0, 1.2]) + np.cross(spin[0], place[:count] - place[0])
    capsules = [rigid.Shape.capsule(radius, length, axis=axis) for _, radius, length, axis, _ in LIMBS.values()]
    boxes = [rigid.Shape.box((WIDTH, height, TREAD)) for height in heights]
    rough = contacts.Coulomb(0.5, 0.5)
    ground = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0, coulomb=rough)
    pairs = [(limb, count + step) for limb in range(count) for step in range(STEPS)]
    stairs = rigid.Solids([*capsules, *boxes], (ground,), coulomb=rough, pairs=pairs)
    fall = Scene(
        rigid.bodies(bodies, place, velocity=velocity, angular_velocity=spin),
        bodies,
        (forces.Gravity(g), doll.sockets, doll.hinges),
        (stairs,),
        pinned=np.arange(count + STEPS) >= count,
    )

    def sink(flight: Trajectory) -> np.ndarray:
        """How far the middles of limbs are nearer to the tread below them than their radius [m]."""
        x, y, z = np.moveaxis(np.asarray(flight.position)[:, :count], -1, 0)
        step = np.floor(z / TREAD + 0.5).clip(0, STEPS).astype(int)
        tread = np.append(heights, 0.0)[step]
        radius = np.array([limb[1] for limb in LIMBS.values()])
        beside = np.abs(x) < WIDTH / 2
        return np.where(beside, radius - (y - tread), 0.0).clip(0.0)

    truths = (*_judge(doll, fall, 1e-2), Truth("limbs lie on the steps [m]", sink, 0.0, 1e-3))
    looks = [*doll.looks, *(solids.box((WIDTH, height, TREAD)) for height in heights)]
    return Problem(fall, duration=2.4, truths=truths, looks=looks, frames=16)
