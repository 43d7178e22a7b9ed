"""Loads on particles: weight, drag, lift, springs to a point, gravitation, kicks and controls.

`laws` are functions of position and velocity, `tabulated_drag` is drag by a table, `air` is wind and density that
change and the lift of spin, `weight` is gravity near the ground and buoyancy, `gravitation` acts between all pairs,
`time_dependent` forces are functions of time, and `flows` are velocity fields of the air.

A force of your own needs nothing here: any subclass of `Force` (or any function) goes into a scene, and is plotted, swept
and ablated there. To add one to this package, write the class in the file of its kind and its name into that file's
`__all__`; this face exports what those lists hold, so no other file changes. Its numbers are fields made with `quantity`.
A new kind of force is a new file and two lines here.
"""

from physjax.physics.forces import air, gravitation, laws, tabulated_drag, time_dependent, weight
from physjax.physics.forces.air import *  # noqa: F403
from physjax.physics.forces.gravitation import *  # noqa: F403
from physjax.physics.forces.laws import *  # noqa: F403
from physjax.physics.forces.tabulated_drag import *  # noqa: F403
from physjax.physics.forces.time_dependent import *  # noqa: F403
from physjax.physics.forces.weight import *  # noqa: F403
from physjax.scene import loads

# wildcards and sums of `__all__` are what type checkers and editors can read; a loop over the folder they cannot
__all__ = ["loads"]
__all__ += air.__all__
__all__ += gravitation.__all__
__all__ += laws.__all__
__all__ += tabulated_drag.__all__
__all__ += time_dependent.__all__
__all__ += weight.__all__


def __dir__() -> list[str]:
    return sorted(__all__)
