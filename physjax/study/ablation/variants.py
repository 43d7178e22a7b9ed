"""What can be left out of a scene: each variant is the scene without it, and how its states look in the whole one."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from physjax.checks import as_positive_integer
from physjax.particles import Particles, callable_name
from physjax.parts import Contact, Force, find_plain_functions
from physjax.physics import contacts, forces
from physjax.physics.springs.springs import Springs
from physjax.quantities import collect_numbers
from physjax.scene import Scene
from physjax.select import cut_lanes
from physjax.study.ablation.planar import AGREEMENT_SHARE, forget_contacts, measure_part, reduce_to_plane
from physjax.study.energy.audit import name_parts
from physjax.trajectory import Trajectory

NEWTON_DRAG_COEFFICIENT = 0.44
"""Drag coefficient of a fast sphere [1]: of Reynolds numbers from some 750 to the drag crisis at 3e5."""
MAX_SPRING_KINDS = 6
"""Springs with at most this many different stiffnesses are left out one stiffness at a time: beyond it, they are a material."""
PER_ENTRY = ("spring", "joint", "point")
"""Numbers of which there is one for something that refers to lanes by their index."""

Part = Force | Contact


class Variant(NamedTuple):
    """A scene with something left out. `restore_states(state)` makes its frames look like those of the scene that has it."""

    name: str
    scene: Scene
    restore_states: Callable[[PyTree], PyTree] = lambda state: state


class _Slot(NamedTuple):
    """Where a part stands in a scene: its name, whether it is a contact, and its place among those."""

    name: str
    is_contact: bool
    place: int


def list_variants(scene: Scene, run: Trajectory, lanes: Mapping[str, int]) -> tuple[list[Variant], list[str]]:
    """Every force, option, simpler law, contact, lane named, and dimension in turn; and why what cannot go must stay."""
    found = []
    for slot in _list_slots(scene):
        part = (scene.contacts if slot.is_contact else scene.forces)[slot.place]
        found.append(Variant(slot.name, _replace_part(scene, slot)))
        found += [
            Variant(label, _replace_part(scene, slot, other))
            for label, other in _list_simpler_parts(slot, part, scene, run)
        ]
    found += [remove_lane(scene, name, lane) for name, lane in lanes.items()]
    notes = []
    if scene.state.position.shape[-1] == 3:
        flat = reduce_to_plane(scene, run)
        if isinstance(flat, str):
            notes.append(f"third dimension kept: {flat}")
        else:
            found.append(Variant("third dimension", *flat))
    return found, notes


def list_pair_variants(scene: Scene) -> list[Variant]:
    """Every two forces or contacts at once."""
    # the later one goes first: that does not move what comes before it
    return [
        Variant(f"{one.name} and {two.name}", _replace_part(_replace_part(scene, two), one))
        for one, two in combinations(_list_slots(scene), 2)
    ]


def _list_slots(scene: Scene) -> list[_Slot]:
    """The forces of a scene and then its contacts, each with its name."""
    acting = [_Slot(name, False, i) for i, name in enumerate(name_parts(scene.forces))]
    return acting + [_Slot(name, True, i) for i, name in enumerate(name_parts(scene.contacts))]


def _replace_part(scene: Scene, slot: _Slot, *instead: Part) -> Scene:
    """The scene with something instead of one of its forces or contacts, or nothing."""
    acting, touching = list(scene.forces), list(scene.contacts)
    (touching if slot.is_contact else acting)[slot.place : slot.place + 1] = instead
    return Scene(scene.state, scene.mass, acting, touching, scene.pinned, scene.emitter)


def _list_simpler_parts(slot: _Slot, part: Part, scene: Scene, run: Trajectory) -> list[tuple[str, Part]]:
    """A force or contact by a simpler law, without one of its options, or with impacts that are not timed."""
    simpler: list[tuple[str, Part]] = []
    if isinstance(part, forces.QuadraticDrag):
        stokes = forces.StokesDrag.of_sphere(jnp.sqrt(part.area / math.pi), wind=part.wind)
        simpler.append(("Stokes' law instead", stokes))
    if isinstance(part, forces.SphereDrag):
        quadratic = forces.QuadraticDrag(
            math.pi * part.radius**2, jnp.asarray(NEWTON_DRAG_COEFFICIENT), part.density, part.wind
        )
        simpler.append(("quadratic law instead", quadratic))
        stokes = forces.StokesDrag.of_sphere(part.radius, part.viscosity, part.wind)
        simpler.append(("Stokes' law instead", stokes))
    simpler += _list_simpler_springs(part) if isinstance(part, Springs) else _list_options(part, scene, run)
    if isinstance(part, Contact) and part.response is contacts.impact:
        simpler.append(("timing of impacts", replace(forget_contacts(part), response=contacts.project)))
    return [(f"{slot.name}: {label}", other) for label, other in simpler]


def _list_options(part: Part, scene: Scene, run: Trajectory) -> list[tuple[str, Part]]:
    """The options that a part has, by name, with the part without each.

    An option is a declared number, or a record of such, that may be left at None and is then as if it were zero: wind,
    friction, softening. Where None means something else (the masses instead of `gm`, the scene's g) it is no option.
    """
    found = []
    for field in fields(part):
        value = vars(part).get(field.name)
        if field.default is not None or value is None or field.metadata.get("static", False):
            continue
        is_record = isinstance(value, eqx.Module)
        declared = [n.quantity for n in collect_numbers(value)[0]] if is_record else [field.metadata.get("quantity")]
        if not declared or any(quantity is None or quantity.per == "memory" for quantity in declared):
            continue
        fresh = forget_contacts(part)
        try:
            without = replace(fresh, **{field.name: None})
            zero = replace(fresh, **{field.name: jax.tree.map(jnp.zeros_like, value)})
        except (TypeError, ValueError):  # a part that cannot do without it
            continue
        if _act_alike(without, zero, scene, run):
            found.append((field.name, without))
    return found


def _act_alike(part: Part, other: Part, scene: Scene, run: Trajectory) -> bool:
    """Whether two parts do the same, but for rounding, at the start and at the end of a run."""
    for i in (0, -1):
        t, state = run.time[i], jax.tree.map(lambda leaf, i=i: leaf[i], run.state)
        both = [jax.tree.leaves(measure_part(each, t, state, scene)) for each in (part, other)]
        for one, two in zip(*both, strict=True):
            largest = np.nanmax(np.maximum(np.abs(one), np.abs(two)), initial=0.0)
            if np.any(np.abs(one - two) > AGREEMENT_SHARE * largest):
                return False
    return True


def _list_simpler_springs(springs: Springs) -> list[tuple[str, Part]]:
    """Springs without damping, and without those of each stiffness (a lattice's structural, shear and bend springs)."""
    count = len(springs.pairs)
    numbers = (springs.stiffness, springs.rest_length, springs.damping, springs.breaks_at, springs.yields_at)
    if any(number is not None and number.ndim > 1 for number in numbers):
        return []  # swept over scenes
    spread = [None if number is None else np.broadcast_to(np.asarray(number), (count,)) for number in numbers]
    stiffness, rest_length, damping, breaks_at, yields_at = spread
    assert stiffness is not None
    assert rest_length is not None

    def select_springs(kept, damping=damping):
        options = [None if a is None else a[kept] for a in (damping, breaks_at)]
        return Springs(
            np.asarray(springs.pairs)[kept],
            stiffness[kept],
            rest_length[kept],
            *options,
            nodes=springs.nodes,
            tension_only=springs.tension_only,
            yields_at=None if yields_at is None else yields_at[kept],
        )

    simpler: list[tuple[str, Part]] = []
    if damping is not None:
        simpler.append(("damping", select_springs(np.full(count, True), damping=None)))
    kinds = np.unique(stiffness)
    if 1 < len(kinds) <= MAX_SPRING_KINDS:
        simpler += [(f"those of {kind:.4g} N/m", select_springs(stiffness != kind)) for kind in kinds]
    return simpler


def remove_lane(scene: Scene, name: str, lane: int) -> Variant:
    """The scene without one lane, or one body of a system; its frames come back with NaN where that was."""
    lanes, axis = scene.state.lanes, len(scene.state.lanes) - 1
    lane = as_positive_integer(f"lanes[{name!r}]", lane, at_least=0)
    if axis < 0 or lane >= lanes[-1] or lanes[-1] < 2:
        raise ValueError(
            f"lanes: got {name!r} = {lane}, but the scene's lanes are {lanes}. Give an index into the last axis."
        )
    fixed = [callable_name(part) for part in (*scene.forces, *scene.contacts) if _refers_to_lanes(part)]
    if not isinstance(scene.state, Particles) or scene.prescribed_motion is not None or fixed:
        raise ValueError(
            f"lanes: {name!r} cannot be left out of bodies, of prescribed motion, or where {', '.join(fixed) or 'something'} "
            "refers to lanes by their index. Build the scene without it and give it in others=."
        )
    rest = cut_lanes(scene, lanes, lambda leaf: jnp.delete(leaf, lane, axis))
    insert = lambda leaf: jnp.insert(leaf, lane, jnp.nan, axis + 1)  # noqa: E731
    return Variant(name, rest, lambda states: Particles(*(insert(leaf) for leaf in states)))


def _refers_to_lanes(part: Part) -> bool:
    """Whether a part that couples lanes refers to them by index, or may do so where no declaration shows it."""
    if not part.couples:
        return False
    static = [field for field in fields(part) if field.metadata.get("static", False) and field.name != "couples"]
    quantities = [number.quantity for number in collect_numbers(part)[0]]
    hidden = bool(find_plain_functions(part)) or bool(static)
    return hidden or any(quantity is None or quantity.per in PER_ENTRY for quantity in quantities)
