"""Solids, in the plane and in space: bodies that may not pass each other, nor surfaces, with restitution and friction."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, as_positive_integer, quantity, unchecked_quantity
from physjax.parts import Contact, as_tuple
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.mechanics import PLANE
from physjax.physics.rigid.planar.shapes import PlanarShape
from physjax.physics.rigid.solids.mechanics import Mechanics
from physjax.physics.rigid.solids.pairs import group_contacts, list_pairs
from physjax.physics.rigid.solids.response import solve_contacts
from physjax.physics.rigid.space.mechanics import SPACE
from physjax.physics.rigid.space.shapes import Shape
from physjax.physics.rigid.spatial import RigidBodies
from physjax.quantities import collect_numbers
from physjax.scene import Scene

SUBSTEPS = 4
"""Sub-steps of a step where none are given: of 1/60 s, a stack of ten boxes of 1 m sinks by some mm."""


class Solids(Contact):
    """Bodies that may not pass each other or the surfaces, in the plane or in space, with restitution K_r and Coulomb's friction.

    `shapes` is one for all bodies, or a sequence with one for each in the last lane axis: `rigid.PlanarShape` in the plane,
    `rigid.Shape` in space. `surfaces` are those of `contacts`, with a restitution and friction of their own; they may turn
    within themselves (turntables, drums) and be driven by functions of time (shaken tables, lifts, tumblers). Between bodies
    it is the mean of the two where `restitution` is given for each. `pairs`, `(pairs, 2)`, lists those that can touch:
    without, all pairs, of up to 64 bodies.

    Each step is taken in `substeps`. In each, what would reach another body bounces first, all hits that arrive together
    at once and until none approaches; then impulses keep every gap open and every contact from approaching, with those of
    the sub-step before as a start. Exact under uniform gravity where the method is. Overlap is cured softly: under a load F
    a contact that moves a mass m sinks by F h²/(2π² m), h the sub-step. First order in h where bodies collide; what
    approaches slower than twice what forces change in a sub-step does not bounce.

    What that comes to with 4 and with 8 sub-steps of 1/60 s (`benchmarks/stacks.py`): after a bounce or two, balls are off by
    5 and 3 mm; a stack of ten boxes of 1 m sinks by 1.1 and 0.3 mm, and sways by 2 and 0.5 mm before it is still. In 20 000
    drops of two to six bodies the energy was never above that at the start; what is fast and meets corner to corner may
    overlap by a part of its way in a sub-step, in one of a hundred worlds of six bodies by 2 % of the smallest.

    In space a contact has four points, and friction acts at the middle of their pressure and against spin, within an ellipsoid
    of both: exact for what only slides or only spins. With K_r = 1 and friction an oblique hit may gain a few per cent of
    energy. A box or hull touches curved surfaces with the corners of a face and the point next to them. What is not convex
    is several bodies held together by `rigid.Welds`.

    Bodies in exact joints move as these let them where a contact pushes one of them: light wheels carry a heavy car, and what is
    welded together bounces as one body. Limits that are met and drives at their aim hold in the same way. Where a contact
    pulls a joint off its limit or overpowers its drive, the joint gives way one sub-step later.

    It remembers the `impulses` of contacts, `(*worlds, numbers, groups, size)`, with which the next step begins, and where
    bodies are joined the `loads` of contacts on each of them in the mean of the last step, `(*worlds, bodies, 3 or 6)`, force [N]
    and torque about the center of mass [N m]: what joints carry of these is in `constraint_forces`, and may break them.

    Example:
        >>> crate, floor = inertia.planar_plate(2.0, (1.0, 1.0)), contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0)
        >>> solids = rigid.Solids(rigid.PlanarShape.box((1.0, 1.0)), surfaces=(floor,))
        >>> pile = rigid.planar_bodies(crate, [[0.0, 0.5], [0.0, 1.5]])
        >>> scene = Scene(pile, crate, (forces.Gravity(),), contacts=(solids,))
        >>> end = simulate(scene, methods.verlet, dt=1 / 60, steps=60).state
        >>> print(end.position[-1, :, 1].round(2))
        [0.5 1.5]
    """

    couples: ClassVar[bool] = True
    memory: ClassVar[tuple[str, ...]] = ("impulses", "loads")
    shapes: tuple[PlanarShape | Shape, ...]
    surfaces: tuple[Surface, ...]
    coulomb: Coulomb | None
    pairs: tuple[tuple[int, int], ...] | None = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    restitution: Numbers = quantity("restitution K_r", "1", per=None, at_least=0, at_most=1, default=0.0)
    impulses: Array | None = unchecked_quantity("impulses", "N s", per="memory", default=None)
    loads: Array | None = unchecked_quantity("loads", "N or N m", per="memory", default=None)
    pushes: Array | None = unchecked_quantity("pushes", "N or N m", per=None, default=None)

    def __init__(
        self,
        shapes: PlanarShape | Shape | Sequence[PlanarShape | Shape],
        surfaces: Sequence[Surface] = (),
        restitution: ArrayLike = 0.0,
        coulomb: Coulomb | None = None,
        *,
        pairs: NestedArrayLike | None = None,
        substeps: int = SUBSTEPS,
    ):
        self.shapes = tuple(shapes) if isinstance(shapes, Iterable) else (shapes,)
        self.surfaces = as_tuple("surface", surfaces)
        self.restitution = restitution
        self.coulomb = coulomb
        self.pairs = None if pairs is None else _as_tuples(np.asarray(pairs))
        self.substeps = as_positive_integer("substeps", substeps)
        self.impulses = self.loads = self.pushes = None

    def __check_init__(self):
        in_space = bool(self.shapes) and isinstance(self.shapes[0], Shape)
        for shape in self.shapes:
            if not isinstance(shape, Shape if in_space else PlanarShape):
                example = (
                    "Shape such as rigid.Shape.box((1, 1, 1))"
                    if in_space
                    else "PlanarShape such as rigid.PlanarShape.box((1, 1))"
                )
                raise TypeError(f"Solids: got a {type(shape).__name__}, expected a {example}.")
        if self.coulomb is not None and not isinstance(self.coulomb, Coulomb):
            raise TypeError(
                f"coulomb: got {self.coulomb!r}, expected contacts.Coulomb(static=0.5, kinetic=0.4) for what bodies do to each "
                "other; a surface has its own."
            )
        for surface in self.surfaces:
            if not isinstance(surface, Surface):
                raise TypeError(
                    f"Solids: got a {type(surface).__name__}, expected a Surface such as contacts.Plane((0, 0), (0, 1))."
                )
        for surface in self.surfaces:
            if surface.friction is not None or surface.response is not None:
                raise ValueError(
                    "Solids: got a surface with friction= or response=, expected coulomb=Coulomb(static, kinetic) or "
                    "nothing: the others are for particles."
                )

    @property
    def response(self) -> Callable[..., Scene]:  # pyright: ignore[reportIncompatibleVariableOverride]  # as in `Surface`
        """How its contacts are resolved."""
        return solve_contacts

    @property
    def many_small_kernels(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  # as in `Surface`
        """In space: with the older emitters 1024 stacks of ten boxes are 1.4 times as fast, in the plane 0.85 times."""
        return self.mechanics is SPACE

    @property
    def mechanics(self) -> Mechanics:
        """That of the plane or of space, by the shapes."""
        return SPACE if isinstance(self.shapes[0], Shape) else PLANE

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Infinite: how far shapes are apart depends on their angles as well."""
        return jnp.full(position.shape[:-1], jnp.inf)

    def respond(self, t: ArrayLike, state: Any) -> Any:
        """The bodies as they are: contacts are resolved within the step."""
        return state

    def demand_fit(self, state: object, mass: object) -> None:
        """Raise a TypeError unless the state is of bodies like the shapes, a ValueError unless there is a shape for each."""
        flat = self.mechanics is PLANE
        if not isinstance(state, PlanarBodies if flat else RigidBodies):
            example = "PlanarBodies: rigid.planar_bodies(...)" if flat else "RigidBodies: rigid.bodies(...)"
            raise TypeError(
                f"Solids: got a state of type {type(state).__name__} with shapes of type {type(self.shapes[0]).__name__}, "
                f"expected {example}."
            )
        if not flat and getattr(mass, "arm", None) is not None:
            raise ValueError("Solids: got bodies on a pivot, expected free ones: hold them with rigid.Joints instead.")
        if not state.lanes:
            raise ValueError("Solids: got a single body without a lane axis, expected bodies in the last one.")
        if len(self.shapes) not in (1, state.lanes[-1]):
            raise ValueError(
                f"Solids: got {len(self.shapes)} shapes for {state.lanes[-1]} bodies, expected one for all or one for each."
            )
        for number in collect_numbers((self.surfaces, self.coulomb))[0]:
            if number.has_lanes(state.lanes, state.position.shape[-1]):
                raise ValueError(
                    f"Solids: got {number.field} of {type(number.owner).__name__} for each of the lanes {state.lanes}, expected "
                    "one for all: a surface and Coulomb's friction are the same for all bodies and worlds."
                )
        if self.restitution.shape not in ((), state.lanes[-1:]):
            raise ValueError(
                f"Solids: got restitution of shape {self.restitution.shape}, expected () or {state.lanes[-1:]}."
            )

    def find_loads(self) -> Array | None:
        """What contacts exerted on the bodies in the mean of the last step, zero where none are joined."""
        return self.loads

    def find_pushes(self) -> Array | None:
        """What contacts are expected to exert within a step that is being taken."""
        return self.pushes

    def prepare(self, state: Any, couples: bool) -> "Solids":
        """The contact with its pairs listed and no impulses yet."""
        for surface in self.surfaces:
            if surface.motion is not None:
                surface.motion.demand_fit(type(surface).__name__, state.position.shape[-1])
        bodies = state.lanes[-1]
        pairs = list_pairs(self.pairs, bodies)
        groups = group_contacts(pairs, len(self.mechanics.list_slots(self.surfaces, self.shapes)), bodies)
        none = jnp.zeros((*state.lanes[:-1], self.mechanics.remembered, *groups.contact.shape), state.dtype)
        parts = self.shapes, self.surfaces, self.restitution, self.coulomb
        listed = Solids(*parts, pairs=pairs, substeps=self.substeps)
        loads = jnp.zeros((*state.lanes, self.mechanics.freedoms), state.dtype)
        where = lambda solids: (solids.impulses, solids.loads)  # noqa: E731
        return eqx.tree_at(where, listed, (none, loads), is_leaf=lambda leaf: leaf is None)


def _as_tuples(pairs: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Pairs as something that decides what is compiled."""
    return tuple((int(a), int(b)) for a, b in np.asarray(pairs).reshape(-1, 2))


__all__ = ["SUBSTEPS", "Solids"]
