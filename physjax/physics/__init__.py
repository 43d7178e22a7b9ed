"""What acts on a scene: forces, springs, contacts, rigid bodies and emitters, each usable under every method.

# A walk with a force's value

`forces.Gravity` is built with g checked by `quantity`. `Scene` casts its numbers to the state's type, lets all forces agree on g
and on which axis is up, and checks every number against the lanes. At each stage of a method, `Scene.rate` calls
`Particles.generalised_force`. It evaluates fields such as gravity as accelerations, so that free fall never reads the mass,
and all other forces in newtons divided by the mass; held nodes get zero, and a lane at rest on a surface is corrected by its
reaction (`physjax.physics.contacts.resting`). `Particles.rate` pairs the velocity with that acceleration, and the method applies
it: `kick` adds a dt to the velocity, `drift` adds v dt to the position. `Scene.normalised` finishes the step (for bodies, unit
quaternions), and the frame's position is in `flight.position`. `loads(scene, t)` shows the newtons of each force at any moment.
"""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
