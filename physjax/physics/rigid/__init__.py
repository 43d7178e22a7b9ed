"""Rigid bodies: their initial state, the loads on them, and how their points move.

    from physjax import RigidBodies, Scene, forces, inertia, rigid

    brick = inertia.box(2.0, size=(0.3, 0.1, 0.2))
    thrown = Scene(rigid.bodies(brick, velocity=(5, 3, 0), angular_velocity=(0, 1, 9)), brick, (forces.Gravity(),))

Forces on particles act at the center of mass, and with `AtPoint` at any point. Everything else is a `Load`: `(t,
bodies, inertia) -> Wrench`. Points of a body are given in its own frame, from its center of mass. `ContactPoints` are
those that can touch surfaces, a `Shape` is what a body fills: `contacts=(Solids(shapes, surfaces),)` keeps bodies out of
each other, `(SurfaceContact(hull, surface),)` out of surfaces alone. `Joints` hold bodies together, exactly or as springs;
`Hinges`, `Welds`, `Sliders`, `Rods` and `Ropes` are exact.
"""

from physjax.physics.rigid.axis_joints import Hinges, Sliders
from physjax.physics.rigid.body_points import (
    angular_acceleration,
    angular_velocity,
    point,
    point_acceleration,
    point_velocity,
)
from physjax.physics.rigid.contact_points import ContactPoints
from physjax.physics.rigid.joint_kinds import Rods, Ropes, Welds
from physjax.physics.rigid.joints import Joints, hinge
from physjax.physics.rigid.loads import (
    AtPoint,
    RotationalDrag,
    Thrust,
    Torque,
    bodies,
    on_bodies,
)
from physjax.physics.rigid.pairs import Balls
from physjax.physics.rigid.planar import (
    PlanarBodies,
    PlanarContacts,
    PlanarInertia,
    PlanarShape,
    find_planar_contacts,
    planar_bodies,
)
from physjax.physics.rigid.solids.contact import Solids
from physjax.physics.rigid.space.shapes import Shape
from physjax.physics.rigid.spatial import Load, RigidBodies, Wrench
from physjax.physics.rigid.surface_contact import Hull, SurfaceContact, Touch

__all__ = [
    "AtPoint",
    "Balls",
    "ContactPoints",
    "Hinges",
    "Hull",
    "Joints",
    "Load",
    "PlanarBodies",
    "PlanarContacts",
    "PlanarInertia",
    "PlanarShape",
    "RigidBodies",
    "Rods",
    "Ropes",
    "RotationalDrag",
    "Shape",
    "Sliders",
    "Solids",
    "SurfaceContact",
    "Thrust",
    "Torque",
    "Touch",
    "Welds",
    "Wrench",
    "angular_acceleration",
    "angular_velocity",
    "bodies",
    "find_planar_contacts",
    "hinge",
    "on_bodies",
    "planar_bodies",
    "point",
    "point_acceleration",
    "point_velocity",
]


def __dir__() -> list[str]:
    return __all__
