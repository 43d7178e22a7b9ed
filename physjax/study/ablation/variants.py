"""What can be left out of a scene: each removal is the scene without it, and how its states look in the whole one."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from physjax.checks import as_positive_integer
from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.physics.springs.springs import Springs
from physjax.scene import Scene
from physjax.select import cut_lanes
from physjax.study.ablation.planar import reduce_to_plane
from physjax.study.energy.audit import name_parts

OPTIONAL_FIELDS = ("wind", "damping", "softening", "tangential", "omega_rate", "friction", "coulomb")
"""Options of forces and contacts that may be left at None, which is to say out."""
NEWTON_DRAG_COEFFICIENT = 0.44
"""Drag coefficient of a fast sphere."""
MAX_SPRING_KINDS = 6
"""Springs of at most so many stiffnesses count as kinds that may be left out one by one."""


class Variant(NamedTuple):
    """A scene with something left out. `restore_states(state)` makes its frames look like those of the scene that has it."""

    name: str
    scene: Scene
    restore_states: Callable[[Any], Any] = lambda state: state


def list_variants(scene: Scene, flight: Any, lanes: Mapping[str, int]) -> tuple[list[Variant], list[str]]:
    """Every force, option, simpler law, contact, lane named, and dimension in turn; and why what cannot go must stay."""
    found = []
    for kind in ("forces", "contacts"):
        parts = getattr(scene, kind)
        for i, (name, part) in enumerate(zip(name_parts(parts), parts, strict=True)):
            found.append(Variant(name, _replace_part(scene, kind, i)))
            for label, simpler in _list_simpler_parts(name, part):
                found.append(Variant(label, _replace_part(scene, kind, i, simpler)))
    found += [remove_lane(scene, name, lane) for name, lane in lanes.items()]
    notes = []
    if scene.state.position.shape[-1] == 3:
        flat = reduce_to_plane(scene, flight)
        if isinstance(flat, str):
            notes.append(f"third dimension kept: {flat}")
        else:
            found.append(Variant("third dimension", *flat))
    return found, notes


def list_pair_variants(scene: Scene) -> list[Variant]:
    """Every two forces or contacts at once."""
    places = [(kind, i) for kind in ("forces", "contacts") for i in range(len(getattr(scene, kind)))]
    names = dict(zip(places, name_parts(scene.forces) + name_parts(scene.contacts), strict=True))
    found = []
    for n, first in enumerate(places):
        for second in places[n + 1 :]:
            # the later one first: what goes does not move what comes before it
            without = _replace_part(_replace_part(scene, *second), *first)
            found.append(Variant(f"{names[first]} and {names[second]}", without))
    return found


def _replace_part(scene: Scene, kind: str, i: int, *instead: Any) -> Scene:
    """The scene with something instead of one of its forces or contacts, or nothing."""
    parts = getattr(scene, kind)
    parts = {"forces": scene.forces, "contacts": scene.contacts} | {kind: (*parts[:i], *instead, *parts[i + 1 :])}
    return Scene(scene.state, scene.mass, parts["forces"], parts["contacts"], scene.pinned, scene.emitter)


def _list_simpler_parts(name: str, part: Any) -> list[tuple[str, Any]]:
    """A force or contact with an option left out, or the laws that are simpler."""
    simpler = []
    if isinstance(part, forces.QuadraticDrag):
        stokes = forces.StokesDrag.of_sphere(jnp.sqrt(part.area / math.pi), wind=part.wind)
        simpler.append((f"{name}: Stokes' law instead", stokes))
    if isinstance(part, forces.SphereDrag):
        quadratic = forces.QuadraticDrag(math.pi * part.radius**2, NEWTON_DRAG_COEFFICIENT, part.density, part.wind)
        simpler.append((f"{name}: quadratic law instead", quadratic))
        stokes = forces.StokesDrag.of_sphere(part.radius, part.viscosity, part.wind)
        simpler.append((f"{name}: Stokes' law instead", stokes))
    if isinstance(part, Springs):
        return simpler + _list_simpler_springs(name, part)
    names = {field.name for field in fields(part)} if is_dataclass(part) else set()
    for option in OPTIONAL_FIELDS:
        if option in names and getattr(part, option) is not None:
            simpler.append((f"{name}: {option}", _clear_memory(replace(part, **{option: None}))))
    if getattr(part, "response", None) is contacts.impact:
        simpler.append((f"{name}: timing of impacts", _clear_memory(replace(part, response=contacts.project))))
    return simpler


def _clear_memory(part: Any) -> Any:
    """A contact without its memory, which belongs to a scene."""
    return replace(part, touching_since=None) if hasattr(part, "touching_since") else part


def _list_simpler_springs(name: str, springs: Springs) -> list[tuple[str, Springs]]:
    """Springs without damping, and without those of each stiffness (a lattice's structural, shear and bend springs)."""
    count = len(springs.pairs)
    numbers = (springs.stiffness, springs.rest_length, springs.damping, springs.breaks_at)
    if any(number is not None and number.ndim > 1 for number in numbers):
        return []  # swept over scenes
    spread = [None if number is None else np.broadcast_to(np.asarray(number), (count,)) for number in numbers]
    stiffness, rest_length, damping, breaks_at = spread

    def of(kept, damping=damping):
        part = [None if a is None else a[kept] for a in (stiffness, rest_length, damping, breaks_at)]
        return Springs(np.asarray(springs.pairs)[kept], *part, nodes=springs.nodes)

    simpler = [] if damping is None else [(f"{name}: damping", of(np.full(count, True), damping=None))]
    kinds = np.unique(stiffness)
    if 1 < len(kinds) <= MAX_SPRING_KINDS:
        simpler += [(f"{name}: those of {kind:.4g} N/m", of(stiffness != kind)) for kind in kinds]
    return simpler


def remove_lane(scene: Scene, name: str, lane: int) -> Variant:
    """The scene without a lane, a body less; its frames come back with NaN where that was."""
    lanes, axis = scene.state.lanes, len(scene.state.lanes) - 1
    lane = as_positive_integer(f"lanes[{name!r}]", lane, at_least=0)
    if axis < 0 or lane >= lanes[-1] or lanes[-1] < 2:
        raise ValueError(
            f"lanes: got {name!r} = {lane}, but the scene's lanes are {lanes}. Give an index into the last axis."
        )
    fixed = [n for n, f in zip(name_parts(scene.forces), scene.forces, strict=True) if _refers_to_lanes(f)]
    if not isinstance(scene.state, Particles) or scene.prescribed_motion is not None or fixed:
        raise ValueError(
            f"lanes: {name!r} cannot be left out of bodies, of lanes that are led, or where {', '.join(fixed) or 'something'} "
            "names lanes by their number. Build the scene without it and give it in others=."
        )
    rest = cut_lanes(scene, lanes, lambda leaf: jnp.delete(leaf, lane, axis))
    insert = lambda leaf: jnp.insert(leaf, lane, jnp.nan, axis + 1)  # noqa: E731
    return Variant(name, rest, lambda states: Particles(*(insert(leaf) for leaf in states)))


def _refers_to_lanes(force: Any) -> bool:
    """Whether a force names lanes by their number, or may do so unseen."""
    return force.couples and not isinstance(force, forces.Gravitation)
