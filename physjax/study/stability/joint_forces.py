"""What joints exert, as a force: it depends on where bodies are and how they move, as any other, and bodies swing by it."""

from typing import Any, ClassVar, Self

import equinox as eqx
import jax
from jaxtyping import Array, PyTree

from physjax.loops import Time
from physjax.particles import callable_name
from physjax.parts import Force
from physjax.scene import Scene
from physjax.vectors import scale


class JointForces(Force):
    """The forces of all joints of a scene of particles [N].

    The numbers of the scene are kept apart from their declarations, which are of its own lanes.
    """

    couples: ClassVar[bool] = True
    numbers: list[Any]
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Those of a scene."""
        return cls(*jax.tree.flatten(scene))

    @property
    def scene(self) -> Scene:
        """The scene with the joints."""
        return jax.tree.unflatten(self.structure, self.numbers)

    @property
    def __name__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  of what it stands for
        return name_joints(self.scene)

    def __call__(self, t: Time, state: PyTree, mass: PyTree) -> Array:
        """What the joints add to the forces."""
        return scale(mass, find_joint_rate(self.scene, t, state).velocity)


def find_joint_rate(scene: Scene, t: Time, state: PyTree) -> PyTree:
    """By how much the joints of a scene change the rate of its state."""
    free = scene.replace(forces=tuple(force for force in scene.forces if force.response is None))
    return jax.tree.map(lambda held, free: held - free, scene.rate(t, state), free.rate(t, state))


def name_joints(scene: Scene) -> str:
    """What the joints of a scene are called in sentences."""
    return " and ".join(dict.fromkeys(callable_name(part) for part in scene.constraints))


__all__ = ["JointForces", "find_joint_rate", "name_joints"]
