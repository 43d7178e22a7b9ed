"""Loads on particles: weight, drag, lift, springs to a point, gravitation, kicks and controls.

`laws` are functions of position and velocity, `tabulated_drag` is drag by a table, `air` is wind and density that
change and the lift of spin, `weight` is gravity near the ground and buoyancy, `gravitation` acts between all pairs, and
`soft_spheres` where they overlap,
`time_dependent` forces are functions of time, `rocket` burns its mass, and `flows` are velocity fields of the air.

A force of your own needs nothing here: any subclass of `Force` (or any function) goes into a scene, and is plotted, swept
and ablated there. To add one to this package, write the class in the file of its kind and its name into that file's
`__all__`; this face exports what those lists hold, so no other file changes. Its numbers are fields made with `quantity`.
A new kind of force is a new file and two lines here.

Numbers declared with `quantity` are checked and may have one entry per lane; an array that is not declared is shared by
all lanes. A `potential` puts the force into the energy audit.

Example:
    >>> class HardSpring(Force):  # to the origin: F = -(k + c r²) r
    ...     stiffness: jax.Array = quantity("stiffness k", "N/m", at_least=0)
    ...     hardening: jax.Array = quantity("hardening c", "N/m³", default=0.0)
    ...
    ...     def __call__(self, t, state, mass):
    ...         r2 = jnp.sum(state.position**2, axis=-1, keepdims=True)
    ...         return -(self.stiffness + self.hardening * r2) * state.position
    ...
    ...     def potential(self, t, state, mass):
    ...         r2 = jnp.sum(state.position**2, axis=-1)
    ...         return self.stiffness * r2 / 2 + self.hardening * r2**2 / 4
    >>> start = Particles(jnp.array([1.0, 0.0]), jnp.array([0.0, 0.5]))
    >>> duffing = Scene(start, mass=2.0, forces=(HardSpring(4.0, 1.0),))
    >>> print(stability.limit(duffing, methods.verlet))
    verlet: 1.07 s, set by the stiffness of HardSpring, λ = ±1.871i 1/s
"""

from physjax.name_hints import hint_at_names
from physjax.physics.forces import air, gravitation, laws, rocket, soft_spheres, tabulated_drag, time_dependent, weight
from physjax.physics.forces.air import *  # noqa: F403
from physjax.physics.forces.gravitation import *  # noqa: F403
from physjax.physics.forces.laws import *  # noqa: F403
from physjax.physics.forces.rocket import *  # noqa: F403
from physjax.physics.forces.soft_spheres import *  # noqa: F403
from physjax.physics.forces.tabulated_drag import *  # noqa: F403
from physjax.physics.forces.time_dependent import *  # noqa: F403
from physjax.physics.forces.weight import *  # noqa: F403
from physjax.scene import loads

# wildcards and sums of `__all__` are what type checkers and editors can read; a loop over the folder they cannot
__all__ = ["loads"]
__all__ += air.__all__
__all__ += gravitation.__all__
__all__ += laws.__all__
__all__ += rocket.__all__
__all__ += soft_spheres.__all__
__all__ += tabulated_drag.__all__
__all__ += time_dependent.__all__
__all__ += weight.__all__


def __dir__() -> list[str]:
    return sorted(__all__)


hint_at_names(__name__)
