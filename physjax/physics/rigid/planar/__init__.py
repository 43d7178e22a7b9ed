"""Rigid bodies in the plane: their state and inertia, their shapes, and contact between them.

    from physjax import Scene, contacts, forces, inertia, rigid

    crate, floor = inertia.planar_plate(2.0, (1.0, 1.0)), contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0)
    pile = rigid.planar_bodies(crate, [[0.0, 0.5], [0.0, 1.5], [0.0, 2.5]])
    solids = rigid.Solids(rigid.PlanarShape.box((1.0, 1.0)), surfaces=(floor,), coulomb=contacts.Coulomb(0.5, 0.5))
    Scene(pile, crate, (forces.Gravity(),), contacts=(solids,))

A body turns by one angle about one axis: nothing of quaternions or tensors is compiled. `bodies` is the state record,
`manifolds` and `surfaces` find where shapes touch, and `impulses` holds them apart; `mechanics` hands these to the step of
`rigid.solids`. `contact_state` tells between steps where bodies touch.
"""

from physjax.physics.rigid.planar.bodies import PlanarBodies, planar_bodies
from physjax.physics.rigid.planar.contact_state import PlanarContacts, find_planar_contacts
from physjax.physics.rigid.planar.shapes import PlanarShape
from physjax.physics.rigid.planar_inertia import PlanarInertia

__all__ = [
    "PlanarBodies",
    "PlanarContacts",
    "PlanarInertia",
    "PlanarShape",
    "find_planar_contacts",
    "planar_bodies",
]


def __dir__() -> list[str]:
    return __all__
