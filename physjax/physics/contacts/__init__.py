"""Contact surfaces, and how contacts of particles with them are resolved.

A surface (`surface`, `shapes`) is a signed distance with restitution and friction, and moves as its `motion` says. Its
response is `project`, at the end of a step, or `impact`, at the time of impact:

- `time_of_impact` flies a step leg by leg (`legs`), from one event (`events`, `path_search`) to the next;
- `impact_response` is what an event makes of a lane: `restitution` and friction, coming to rest, the end of a slide;
- `contact_mode` decides at the start of a leg which surfaces carry a lane, and `resting` has their reactions.

`segments` are contacts of edges and faces; `face` says what all this needs of a surface.

A shape of your own gives its signed distance, exact at the surface and to first order near it; the normal and the
curvature follow by differentiation, and the picture from the distance. Closed forms may override them.

Example:
    >>> class Bowl(contacts.Surface):  # above y = c x²
    ...     curvature: jax.Array = quantity("curvature c", "1/m")
    ...
    ...     def signed_distance(self, t, position):
    ...         x, y = position[..., 0], position[..., 1]
    ...         slope = 2 * self.curvature * x
    ...         return (y - self.curvature * x**2) / jnp.sqrt(1 + slope**2)
    >>> start = Particles(jnp.array([-0.5, 1.2]), jnp.zeros(2))
    >>> bowl = Bowl(1.0, restitution=0.6, response=contacts.project)
    >>> marble = Scene(start, forces=(forces.Gravity(),), contacts=(bowl,))
    >>> marble = simulate(marble, methods.rk4, dt=0.01, duration=1.5)
    >>> bool((bowl.signed_distance(0.0, marble.position) > -1e-3).all())
    True

# Known limitations

- The time of impact is found inside the step only where lanes are independent. Coupled lanes get the response at the end
  of the step, which is first order and misses what is crossed within one step. Friction of coupled nodes (a cloth on a
  ball) is resolved there as well: what lies on a slope creeps at up to g·dt.
- A lane with more than 64 contacts in a step (8 of a body) waits, with its energy, for the next one; if a moving surface
  overruns it while it waits, its status is bad. Derivatives of a step with more than 8 are NaN.
- Resting and sliding contacts are exact: friction sticks without creep, and a slide stops at its exact time. A plane has no
  edge: a backboard or a table is an infinite plane. A flat surface cannot tilt; what turns within itself
  (`angular_velocity`) does so at a constant rate.
- A slide in space that turns around near zero speed, without quite reaching it, within less than a step loses order there:
  its error is about that lowest speed times the time that follows, for any step that does not resolve the turn. In the
  plane, and where it stops, it is exact.
- The first run of a scene with timed impacts takes one second over one plane, one and a half in a room of any number of
  walls, two among several kinds of surfaces; its gradient three to four. `response=contacts.project` compiles at once.
- Under `methods.adaptive`, what is resolved at the end of a step makes steps as short as its lateness demands; impacts that
  are timed are far cheaper. With an emitter `adaptive` refuses both, because every particle then has steps of its own.
"""

from physjax.name_hints import hint_at_names
from physjax.physics.contacts import segments, shapes
from physjax.physics.contacts.motion import Motion
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.segments import *  # noqa: F403
from physjax.physics.contacts.shapes import *  # noqa: F403
from physjax.physics.contacts.surface import Surface
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import project

# a new shape is written in `shapes`, with its name in the `__all__` there; no other file changes
__all__ = ["Coulomb", "Motion", "Surface", "impact", "project"]
__all__ += segments.__all__
__all__ += shapes.__all__


def __dir__() -> list[str]:
    return sorted(__all__)


hint_at_names(__name__)
