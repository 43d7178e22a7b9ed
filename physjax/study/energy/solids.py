"""What a step of bodies in the plane consists of, as the audit of a run sees it: free motion, and what contacts change."""

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.loops import Time
from physjax.physics.contacts.time_of_impact import Flight
from physjax.physics.rigid.solids.contact import Solids
from physjax.physics.rigid.solids.response import solve_contacts
from physjax.scene import Scene

B = TypeVar("B")


def fold_solid_flights(
    motion: Callable, scene: Scene, t: Time, dt: ArrayLike, record: Callable[[B, Flight], B], budget: B
) -> tuple[B, PyTree]:
    """The budget after a step of solids, and the state at its end.

    The step is one flight, along which the method takes the sub-steps of the contact without it; all by which the state at
    the end is another is the contact's. So forces are accounted for along the free motion, which departs from the
    bodies' own path by what contacts change within one step.
    """
    (solids,) = (contact for contact in scene.contacts if isinstance(contact, Solids))
    dt = jnp.asarray(dt, scene.state.dtype)
    h = dt / solids.substeps

    def take(number: ArrayLike, state: PyTree) -> PyTree:
        return motion(scene.replace(state=state), t + jnp.asarray(number, h.dtype) * h, h).state

    free = lax.fori_loop(0, solids.substeps, take, scene.state)
    after = solve_contacts(motion, scene, t, dt).state
    return record(budget, Flight(scene.state, scene, t, dt, free, after, None)), after


__all__ = ["fold_solid_flights"]
