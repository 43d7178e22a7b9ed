"""Rigid bodies: their initial state, the loads on them, and how their points move.

    from physjax import RigidBodies, Scene, forces, inertia, rigid

    brick = inertia.box(2.0, size=(0.3, 0.1, 0.2))
    thrown = Scene(rigid.bodies(brick, velocity=(5, 3, 0), angular_velocity=(0, 1, 9)), brick, (forces.Gravity(),))

Forces on particles act at the center of mass, and with `AtPoint` at any point. Everything else is a `Load`: `(t,
bodies, inertia) -> Wrench`. Points of a body are given in its own frame, from its center of mass. `ContactPoints` are
those that can touch surfaces, a `Shape` is what a body fills: `contacts=(Solids(shapes, surfaces),)` keeps bodies out of
each other, `(SurfaceContact(hull, surface),)` out of surfaces alone. `Joints` hold bodies together, exactly or as springs;
`Hinges`, `Welds`, `Sliders`, `Rods` and `Ropes` are exact.

# Known limitations

- Bodies in space touch each other as spheres, capsules and boxes (`Solids`, in sub-steps), not yet as other hulls or meshes.
  With `SurfaceContact` they touch surfaces with points (corners, spheres, capsules), which never pass through a plate or a
  ball however fast; edges do pass over balls and kerbs. There is no contact for a body on a pivot.
- `Solids` takes each step in sub-steps and bounces what would meet in one at its start: first order where bodies collide. A
  tower of ten boxes sways by up to two millimetres after it is set up and sinks by one with four sub-steps of 1/60 s, a fifth
  and a quarter of that with eight. Boxes of a pyramid creep by some 0.2 mm/s. Surfaces that turn are refused.
- Contacts do not know of joints: what they push apart, the end of the step puts back, and what that pushes into a wall, the
  next step corrects. Scenes with joints or `Balls` resolve impacts at the end of a step.
- Exact joints and `springs.Rods` make steps of order 2 under every method, of order 4 on request. They add no stiffness along
  themselves, but a link under tension T swings across at up to 2√(T/mL), which a step must resolve; `substeps=None` takes as
  many as that needs. Limits, motors and ropes make a step of order 1 where they set in, do not rebound, and take `order=2`
  alone; motors have one speed or target for a run. Joints with `breaks_at` break at the force of the end of a step, not by
  impacts. A body on a pivot cannot be joined, and an emitter is refused.
- `stability` accepts bodies in the plane as if they did not touch. Without torque the split methods are second order.
- First runs take one to five seconds, gradients five to twenty; `implicit_euler` ten for a body on a pivot. A full inertia
  tensor (a mesh, a pivot off the axes) is diagonalised before compiling, so its numbers cannot be traced.
- A batch of solids in space is slow: 1024 stacks of ten boxes take some 40 000 body-steps a second on a core, those in the
  plane a million.
"""

from physjax.name_hints import hint_at_names
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


hint_at_names(__name__)
hint_at_names(f"{__name__}.inertia")
