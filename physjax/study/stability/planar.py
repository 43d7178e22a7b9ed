"""Bodies in the plane as particles with three coordinates, x, y and k θ, whose small motions are the same.

With k² = I/m, the radius of gyration, kinetic energy is ½m(v_x² + v_y² + (k ω)²), and a torque τ pushes along k θ with τ/k.
What is known of the small motions of particles, and of what steps make of them, then holds for bodies.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.particles import Particles, callable_name
from physjax.parts import Force
from physjax.physics.rigid.planar import PlanarBodies, PlanarInertia
from physjax.physics.rigid.solids.contact import Solids
from physjax.scene import Scene
from physjax.study.stability.joint_forces import JointForces, find_joint_rate
from physjax.vectors import scale

State = Particles | PlanarBodies
"""A state about which small motions are known."""


class PlanarForce(Force):
    """A load on bodies in the plane as a force on their three coordinates.

    The numbers of the load are kept apart from their declarations, which are of vectors in the plane.
    """

    numbers: list[Any]
    structure: Any = eqx.field(static=True)
    coupled: bool = eqx.field(static=True)

    @property
    def couples(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  as the scene's parts do
        """Whether the parts of the scene couple its bodies."""
        return self.coupled

    @property
    def load(self) -> tuple[Any, PlanarInertia]:
        """The load itself, and the inertia of the bodies."""
        return jax.tree.unflatten(self.structure, self.numbers)

    @property
    def __name__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  of what it stands for
        return callable_name(self.load[0])

    def __call__(self, t: Time, state: Particles, mass: Array) -> Array:
        """Force [N] and τ/k [N] on each body."""
        load, inertia = self.load
        bodies = _read_bodies(state, inertia)
        force, torque = bodies.sum_loads([bodies.evaluate_load(load, t, inertia)])
        # the sum of loads has both parts
        assert force is not None
        assert torque is not None
        return _join(force, torque / _find_gyration(inertia))


class PlanarJoints(JointForces):
    """The forces of all joints of a scene of bodies in the plane, on their three coordinates."""

    def __call__(self, t: Time, state: Particles, mass: Array) -> Array:
        """Force [N] and τ/k [N] on each body."""
        scene = self.scene
        rate = find_joint_rate(scene, t, _read_bodies(state, scene.mass))
        return _join(rate.momentum, rate.angular_momentum / _find_gyration(scene.mass))


def convert_scene(scene: Scene, state: PlanarBodies) -> tuple[Scene, Particles]:
    """A scene of bodies in the plane, without its contacts, and a state of it, as those of particles."""
    inertia = scene.mass
    forces: list[Force] = []
    if scene.constraints:
        forces.append(PlanarJoints.of(scene))
    for force in scene.forces:
        if force.response is None:
            numbers, structure = jax.tree.flatten((force, inertia))
            forces.append(PlanarForce(numbers, structure, scene.couples))
    mass = jnp.broadcast_to(inertia.mass, scene.state.lanes)
    particles = _read_particles(state, inertia)
    return Scene(particles, mass, tuple(forces), pinned=scene.held), particles


def count_substeps(scene: Scene) -> int:
    """Steps that a method takes within a step of the scene: those of its `rigid.Solids`."""
    contacts = scene.contacts if isinstance(scene, Scene) else ()  # what is no scene is refused where it is linearised
    return next((contact.substeps for contact in contacts if isinstance(contact, Solids)), 1)


def strip_angles(force: Any, state: Particles) -> tuple[Any, Particles]:
    """The load behind a force, and the state as it sees it: places and velocities alone."""
    if not isinstance(force, PlanarForce):
        return force, state
    return force.load[0], Particles(state.position[..., :2], state.velocity[..., :2])


def _find_gyration(inertia: PlanarInertia) -> Array:
    """The radius of gyration k [m] of each body."""
    return jnp.sqrt(inertia.moment / inertia.mass)


def _read_particles(state: PlanarBodies, inertia: PlanarInertia) -> Particles:
    reach = _find_gyration(inertia)
    velocity = scale(1 / inertia.mass, state.momentum)
    turning = state.angular_momentum / inertia.moment
    return Particles(_join(state.position, reach * state.angle), _join(velocity, reach * turning))


def _read_bodies(state: Particles, inertia: PlanarInertia) -> PlanarBodies:
    reach, (x, v) = _find_gyration(inertia), state
    momentum = scale(inertia.mass, v[..., :2])
    return PlanarBodies(x[..., :2], x[..., 2] / reach, momentum, inertia.moment * v[..., 2] / reach)


def _join(vector: Array, number: ArrayLike) -> Array:
    return jnp.concatenate([vector, jnp.asarray(number)[..., None]], axis=-1)


__all__ = ["PlanarForce", "State", "convert_scene", "count_substeps", "strip_angles"]
