"""Rigid bodies in space that may not pass each other: their shapes, where these touch, and the impulses of a contact.

    from physjax import Scene, contacts, forces, inertia, rigid

    crate, floor = inertia.box(2.0, (1.0, 1.0, 1.0)), contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0)
    pile = rigid.bodies(crate, [[0.0, 0.5, 0.0], [0.0, 1.5, 0.0], [0.0, 2.5, 0.0]])
    solids = rigid.Solids(rigid.Shape.box((1.0, 1.0, 1.0)), surfaces=(floor,), coulomb=contacts.Coulomb(0.5, 0.5))
    Scene(pile, crate, (forces.Gravity(),), contacts=(solids,))

`boxes`, `segments`, `hulls`, `round_hulls` and `surfaces` find where shapes touch, and `impulses` holds them apart;
`mechanics` hands these to the step of `rigid.solids`.
"""
