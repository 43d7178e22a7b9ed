"""Where solids in the plane touch, or would, and what they press each other with: asked for between steps."""

from typing import NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.loops import Time, to_float_time
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.mechanics import PLANE
from physjax.physics.rigid.planar.surfaces import Slot, list_slots
from physjax.physics.rigid.solids.contact import Solids
from physjax.physics.rigid.solids.world import SolidContact, build_world
from physjax.scene import Scene

STEADY_FACTOR = 2.0
"""Solids remember by how much a sub-step's impulses at its end exceed those in its mean: of a constant force, one half."""


class PlanarContacts(NamedTuple):
    """All contacts of solids in the plane, near or far: first those of pairs, then those of bodies with each surface.

    `first` and `second` are the numbers of the bodies, `(contacts,)`; of a contact with a surface `second` is -1 and
    `surface` its number among the surfaces of the `Solids`, which is -1 for pairs. All else has the worlds in front. Of
    `normal` the unit vector points from the first body to the second, `(*worlds, contacts, 2)`. Each contact has up to two
    points, of which `is_point` says which are there, `(*worlds, contacts, 2)`: `points` [m] lie halfway between the
    surfaces, `(*worlds, contacts, 2, 2)`, and `gaps` [m] are the signed distances there.

    `pressing` is the impulse [N s] on the second body along the normal at each point, `friction` that along the normal
    turned left, of both points together, `(*worlds, contacts)`: what steady forces took in the last sub-step, and nothing
    of impacts. Divided by the sub-step, `dt / substeps`, they are forces [N].

    Example:
        >>> disc, floor = inertia.planar_disc(2.0, 0.5), contacts.Plane((0.0, 0.0), (0.0, 1.0))
        >>> solids = rigid.Solids(rigid.PlanarShape.disc(0.5), surfaces=(floor,))
        >>> scene = Scene(rigid.planar_bodies(disc, [[0.0, 0.75], [2.0, 0.75]]), disc, contacts=(solids,))
        >>> found = rigid.find_planar_contacts(scene)
        >>> print(found.gaps[:, 0], found.points[0, 0])
        [1.   0.25 0.25] [1.   0.75]
    """

    first: np.ndarray
    second: np.ndarray
    surface: np.ndarray
    normal: Float[Array, "*worlds contacts 2"]
    points: Float[Array, "*worlds contacts 2 2"]
    gaps: Float[Array, "*worlds contacts 2"]
    is_point: Bool[Array, "*worlds contacts 2"]
    pressing: Float[Array, "*worlds contacts 2"]
    friction: Float[Array, "*worlds contacts"]

    @property
    def impulses(self) -> Float[Array, "*worlds contacts 2 2"]:
        """The impulse on the second body at each point as a vector [N s]; friction is shared as the pressing is."""
        total = jnp.sum(self.pressing, axis=-1, keepdims=True)
        share = self.pressing / jnp.where(total > 0, total, 1.0)
        along = (self.friction[..., None] * share)[..., None]
        normal = self.normal[..., None, :]
        left = jnp.stack([-normal[..., 1], normal[..., 0]], axis=-1)
        return self.pressing[..., None] * normal + along * left


def find_planar_contacts(scene: Scene, t: Time = 0.0) -> PlanarContacts:
    """The contacts of a scene with `rigid.Solids` as it is at a time t [s], and the impulses of its last sub-step.

    The impulses are zero in a scene that has not been stepped; `run.final_scene` has those of a run's last step. Works
    under `jit`, `vmap` and `grad`. Raises ValueError for a scene without solids.

    Example:
        >>> crate, floor = inertia.planar_plate(2.0, (1.0, 1.0)), contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0)
        >>> solids = rigid.Solids(rigid.PlanarShape.box((1.0, 1.0)), surfaces=(floor,))
        >>> pile = rigid.planar_bodies(crate, [[0.0, 0.5], [0.0, 1.5]])
        >>> run = simulate(Scene(pile, crate, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=60)
        >>> found = rigid.find_planar_contacts(run.final_scene, run.time[-1])
        >>> print(found.first, found.second)
        [0 0 1] [ 1 -1 -1]
        >>> print((found.pressing.sum(axis=-1) / (run.dt / solids.substeps)).round(1))  # m g, 2 m g, and none
        [19.6 39.2  0. ]
    """
    solids = [contact for contact in scene.contacts if isinstance(contact, Solids)]
    if len(solids) != 1 or not isinstance(scene.state, PlanarBodies):
        raise ValueError(
            f"find_planar_contacts: got a scene of {type(scene.state).__name__} with {len(solids)} rigid.Solids, expected "
            "PlanarBodies with one: Scene(..., contacts=(rigid.Solids(shapes),))."
        )
    ours, slots, bodies = solids[0], list_slots(solids[0].surfaces), scene.state.lanes[-1]
    a, b = _list_pairs(ours).T
    everyone, none = np.arange(bodies), np.full(bodies, -1)
    numbers = _number_surfaces(ours)
    return PlanarContacts(
        np.concatenate([a, *(everyone for _ in slots)]),
        np.concatenate([b, *(none for _ in slots)]),
        np.concatenate([np.full(len(a), -1), *(np.full(bodies, number) for number in numbers)]),
        *_find_contacts(scene, ours, slots, to_float_time(t)),
    )


@eqx.filter_jit
def _find_contacts(scene: Scene, solids: Solids, slots: list[Slot], t: ArrayLike) -> tuple[Array, ...]:
    """The arrays of the contacts, worlds in front."""
    if not solids.pairs and not slots:
        raise ValueError("find_planar_contacts: got solids without pairs or surfaces, expected some that can touch.")
    # at a moment, which is a sub-step of no length
    world = build_world(cast("SolidContact", solids), scene, jnp.zeros((), scene.state.dtype))
    worlds = scene.state.lanes[:-1]
    contacts, gaps, (x, y), _ = PLANE.find_contacts(world, PLANE.read_pose(scene.state, scene).place, t)
    # each contact's place in the groups; places that are left over come last
    count = len(solids.pairs or ()) + len(slots) * world.size
    places = jnp.asarray(np.argsort(world.groups.contact.ravel(), kind="stable")[:count])

    def arrange(parts: Array | tuple[Array, Array]) -> Array:
        """Two parts `(groups, size, worlds)` as `(*worlds, contacts, 2)`."""
        flat = jnp.stack([part.reshape(-1, part.shape[-1])[places] for part in parts])
        return jnp.transpose(flat, (2, 1, 0)).reshape(*worlds, count, len(parts))

    assert solids.impulses is not None
    held = STEADY_FACTOR * solids.impulses.reshape(*worlds, 3, -1)[..., places]
    return (
        arrange(contacts.normal),
        jnp.stack([arrange(x), arrange(y)], axis=-1),
        arrange((gaps[0], gaps[1])),
        arrange(contacts.is_point),
        jnp.swapaxes(held[..., 1:, :], -1, -2),
        held[..., 0, :],
    )


def _list_pairs(solids: Solids) -> np.ndarray:
    return np.array(solids.pairs, int).reshape(-1, 2)


def _number_surfaces(solids: Solids) -> list[int]:
    """The number of the surface of each slot."""
    return [number for number, surface in enumerate(solids.surfaces) for _ in list_slots((surface,))]


__all__ = ["PlanarContacts", "find_planar_contacts"]
