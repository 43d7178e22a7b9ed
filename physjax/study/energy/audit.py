"""Stepping a run again with the books open: who gives and who takes energy, momentum and angular momentum, step by step.

Each step of the method is set beside the exact motion from the same start, integrated by diffrax together with the work
and the impulse of every force. What the method has more than the exact motion is its own, numerical share.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Moment, Time, moment_at, to_float_time
from physjax.particles import callable_name
from physjax.physics.contacts.time_of_impact import Flight, fold_flights, impact
from physjax.physics.rigid.response import collide, fold_body_flights
from physjax.scene import Scene, free_motion, project
from physjax.stepping.reference import build_default_solver, cast_floats
from physjax.study import energy
from physjax.vectors import scale

NUMERICAL, PINS, PIVOTS = "numerical", "pins", "pivots"
RESPONSE_OBSERVERS = {impact: fold_flights, collide: fold_body_flights}
"""How a response tells the legs of its steps. Particles have the one, bodies the other."""
EnergyBudget = dict[str, Any]
"""What each cause has brought so far: energy, momentum and, beyond one dimension, angular momentum, by its name."""


@eqx.filter_jit
def audit_run(run: Any, substeps: Array) -> tuple[EnergyBudget, EnergyBudget]:
    """What the scene has in stock at each frame, and what each cause brings between a frame and the next; in float64.

    `substeps` of order 8 follow the exact motion through every step. For use inside `jax.enable_x64(True)`.
    """
    audit = lambda run: _audit_single_run(run, substeps)  # noqa: E731
    for _ in range(run.first_step.ndim):  # runs that came out of vmap
        audit = jax.vmap(audit)
    return audit(run)


def _audit_single_run(run: Any, substeps: Array) -> tuple[EnergyBudget, EnergyBudget]:
    scene, film = run.scene, run.film
    changes = jax.tree.map(lambda a, b: a.ndim < b.ndim, scene, film)
    frames, still = eqx.filter(film, changes), eqx.filter(scene, changes, inverse=True)

    def between(number, frame):
        def step(i, carry):
            moving, budget = carry
            count = run.first_step + number * run.save_every + i
            t = moment_at(count, run.dt, scene.state.dtype)
            after, budget = _audit_step(eqx.combine(moving, still), run.stepper, t, run.dt, substeps, budget)
            return eqx.filter(after, changes), budget

        return lax.fori_loop(0, run.save_every, step, (frame, build_empty_budget(scene)))[1]

    numbers = jnp.arange(len(run.time) - 1, dtype=jnp.int32)
    begins = jax.tree.map(lambda leaf: leaf[:-1], frames)
    brought = lax.map(lambda each: between(*each), (numbers, begins))
    stock = lax.map(
        lambda each: _measure_stock(each[0], cast_to_float64(eqx.combine(each[1], still))), (run.time, frames)
    )
    return stock, brought


def list_causes(scene: Scene) -> tuple[list[str], list[str], list[str]]:
    """Names of the forces, of the contacts, and of the rest: springs that part, what holds, and the method."""
    parting = [
        f"{name} parted"
        for name, force in zip(name_parts(scene.forces), scene.forces, strict=True)
        if _may_lose_energy(force)
    ]
    holding = [PINS] if scene.pinned is not None else []
    holding += [PIVOTS] if getattr(scene.mass, "arm", None) is not None else []
    contacts = name_parts(scene.contacts)
    return name_parts(scene.forces), contacts, [*parting, *holding, NUMERICAL]


def name_parts(parts: tuple) -> list[str]:
    """What forces or contacts are called, numbered where several are called the same."""
    names, seen = [callable_name(part) for part in parts], Counter()
    several = {name for name, count in Counter(names).items() if count > 1}
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = f"{name} {seen[name]}" if name in several else name
    return names


def _may_lose_energy(force: Any) -> bool:
    """Whether a force may lose energy between two steps: it remembers, and has a potential."""
    return force.remembers and force.has_potential


def cast_to_float64(tree: Any) -> Any:
    """The arrays in float64."""
    return cast_floats(tree, jnp.float64)


def build_empty_budget(scene: Scene) -> EnergyBudget:
    """Books without an entry."""
    wide = cast_to_float64(scene)
    empty = jax.eval_shape(lambda scene: _measure_quantities(scene, jnp.zeros(()), scene.state), wide)
    zeros = lambda: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), empty)  # noqa: E731
    return {name: zeros() for names in list_causes(scene) for name in names}


def _measure_quantities(scene: Scene, t: ArrayLike, state: Any, measure: Callable = energy.total) -> dict[str, Array]:
    """Energy [J], momentum [kg m/s] and angular momentum [kg m²/s] of a state."""
    found = {"energy": measure(scene, t, state), "momentum": energy.momentum(scene, t, state)}
    if state.position.shape[-1] > 1:
        found["angular momentum"] = energy.angular_momentum(scene, t, state)
    return found


def _measure_stock(t: Array, scene: Scene) -> EnergyBudget:
    """Kinetic energy, every force's potential energy, and both momenta with the sizes that they are measured by."""
    t, state = t.astype(jnp.float64), scene.state
    found = {"kinetic": energy.kinetic(scene, t, state)}
    for name, force in zip(name_parts(scene.forces), scene.forces, strict=True):
        if force.has_potential:
            found[f"potential of {name}"] = _potential(force, scene, t, state)
    amounts = _measure_quantities(scene, t, state)
    kinds = (energy.ENERGY, energy.MOMENTUM, energy.ANGULAR_MOMENTUM)
    sizes = {kind.name: kind.size(scene, t, state) for kind in kinds if kind.name in amounts}
    return {"stored": found, "amounts": amounts, "sizes": sizes}


def _potential(force: Any, scene: Scene, t: ArrayLike, state: Any) -> Array:
    return energy.summed(scene, force.potential(t, *state.view_for_force(force, scene.mass)))


def _cast_moment_to_float64(t: Moment) -> Array:
    """A moment as one number, which in float64 holds all of it."""
    start, rest, elapsed = cast_to_float64((t.start, t.rest, 0.0 if t.elapsed is None else t.elapsed))
    return start + (rest + elapsed)


def _audit_step(
    scene: Scene, method: Any, t: Time, dt: Array, substeps: Array, budget: EnergyBudget
) -> tuple[Scene, EnergyBudget]:
    """One step of the run, entered in the books: its motion, touches, what leads nodes, and what parts."""
    motion = partial(free_motion, method)
    enter = partial(_record_flight, cast_to_float64(scene), substeps)
    responses = {contact.response for contact in scene.contacts}
    if responses & RESPONSE_OBSERVERS.keys():
        budget, moved = RESPONSE_OBSERVERS[(responses & RESPONSE_OBSERVERS.keys()).pop()](
            motion, scene, t, dt, enter, budget
        )
    else:
        moved = motion(scene, t, dt).state
        budget = enter(budget, Flight(scene.state, scene, t, dt, moved, moved, None))
    after = scene.step(method, t, dt)
    end, wide = _cast_moment_to_float64(t + dt), cast_to_float64(scene)
    has = lambda state, at=wide: _measure_quantities(at, end, cast_to_float64(state))  # noqa: E731

    def change(budget, name, before, now):
        return {**budget, name: _add(budget[name], _subtract(now, before))}

    if scene.prescribed_motion is not None:
        led = scene.prescribed_motion.prescribe(to_float_time(t + dt), moved)
        budget, moved = change(budget, NUMERICAL, has(moved), has(led)), led
    for name, contact in zip(name_parts(scene.contacts), scene.contacts, strict=True):
        if (contact.response or project) is project:
            answered = contact.resolve(to_float_time(t + dt), moved, scene.mass)
            budget, moved = change(budget, name, has(moved), has(answered)), answered
    # held nodes that a contact moved are put back; without pins there is nothing left but rounding
    budget = change(budget, PINS if scene.pinned is not None else NUMERICAL, has(moved), has(after.state))
    for i, (name, force) in enumerate(zip(name_parts(scene.forces), scene.forces, strict=True)):
        if _may_lose_energy(force):
            forces = (*scene.forces[:i], after.forces[i], *scene.forces[i + 1 :])
            budget = change(
                budget,
                f"{name} parted",
                has(after.state),
                has(after.state, cast_to_float64(scene.replace(forces=forces))),
            )
    return after, budget


def _record_flight(whole: Scene, substeps: Array, budget: EnergyBudget, flight: Flight) -> EnergyBudget:
    """The books after a flight: works and impulses along the exact motion, and what the method and the touch made of it."""
    start, before, end, after = cast_to_float64((flight.scene, flight.before, flight.end, flight.after))
    t, duration = _cast_moment_to_float64(flight.leg_start), flight.duration.astype(jnp.float64)
    has = lambda t, state: _measure_quantities(whole, t, state)  # noqa: E731
    exact, works, holding = _integrate_exactly(whole, start, t, duration, substeps)
    names, contacts, _ = list_causes(whole)
    entries = dict(zip(names, works, strict=True))
    entries[NUMERICAL] = _subtract(has(t + duration, end), has(t + duration, exact))
    timed = [contact.response in RESPONSE_OBSERVERS for contact in whole.contacts]
    if any(timed):
        entries |= _split_by_contact(
            contacts, _find_nearest_contact(whole, timed, t, before), _subtract(has(t, start.state), has(t, before))
        )
        touch = _subtract(has(t + duration, after), has(t + duration, end))
        entries = _add_entries(
            entries, _split_by_contact(contacts, _find_nearest_contact(whole, timed, t + duration, end), touch)
        )
        lean = _find_nearest_contact(whole, timed, t, start.state)
        if whole.held is not None:
            held = jnp.ones(whole.status_shape, bool) if whole.couples else whole.held
            entries[PINS] = _mask_amounts(held, holding)
            lean = [share & ~held for share in lean]
        entries = _add_entries(entries, _split_by_contact(contacts, lean, holding))
    elif PINS in budget or PIVOTS in budget:
        entries[PINS if PINS in budget else PIVOTS] = holding
    if flight.active is not None:
        entries = {name: _mask_amounts(flight.active, entry) for name, entry in entries.items()}
    return _add_entries(budget, entries)


def _find_nearest_contact(scene: Scene, timed: list[bool], t: Array, state: Any) -> list[Array]:
    """For each contact, whether it is the nearest of those that time their impacts; of coupled lanes, to any of them."""

    def gap(contact):
        found = jnp.abs(contact.clearance(t[..., None] if scene.couples else t, state))
        return jnp.min(found, axis=-1) if scene.couples else found

    gaps = [gap(c) if is_timed else None for c, is_timed in zip(scene.contacts, timed, strict=True)]
    far = jnp.full(scene.status_shape, jnp.inf)
    nearest = jnp.argmin(jnp.stack([far if gap is None else gap for gap in gaps]), axis=0)
    return [nearest == i for i in range(len(gaps))]


def _split_by_contact(names: list[str], shares: list[Array], amounts: dict) -> EnergyBudget:
    return {name: _mask_amounts(share, amounts) for name, share in zip(names, shares, strict=True)}


def _mask_amounts(flag: Array, amounts: Any) -> Any:
    return jax.tree.map(lambda a: jnp.where(flag.reshape(flag.shape + (1,) * (a.ndim - flag.ndim)), a, 0.0), amounts)


def _add(a: Any, b: Any) -> Any:
    return jax.tree.map(jnp.add, a, b)


def _subtract(a: Any, b: Any) -> Any:
    return jax.tree.map(jnp.subtract, a, b)


def _add_entries(budget: EnergyBudget, entries: EnergyBudget) -> EnergyBudget:
    """The books with the entries added to those of the same name."""
    return budget | {name: _add(budget[name], entry) if name in budget else entry for name, entry in entries.items()}


def _integrate_exactly(whole: Scene, start: Scene, t: Array, duration: Array, substeps: Array) -> tuple[Any, list, Any]:
    """The exact motion: its end, what every force brings along it, and what is brought by what holds the scene."""
    import diffrax

    scene = start.averaged_over_step(t, duration)

    def slope(share, y, _):
        now, (state, _, _) = t + share * duration, y
        rate, works, holding = _compute_rates(whole, scene, now, state)
        return jax.tree.map(partial(scale, duration), (rate, works, holding))

    empty = jax.eval_shape(lambda: _compute_rates(whole, scene, t, scene.state)[1:])
    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), empty)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        build_default_solver(),
        t0=jnp.zeros(()),
        t1=jnp.ones(()),
        dt0=1 / substeps.astype(jnp.float64),
        y0=(scene.state, *zeros),
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    return jax.tree.map(lambda leaf: leaf[0], solution.ys)


def _compute_rates(whole: Scene, scene: Scene, t: Array, state: Any) -> tuple[Any, list, Any]:
    """Time derivative of the state, and what each force, and what holds the scene, brings in a second."""
    rate = scene.rate(t, state)
    seen = state if scene.prescribed_motion is None else scene.prescribed_motion.prescribe(t, state)
    seen = seen.on_pivot(scene.mass) if seen.rotates else seen
    works = [_transfer_rates(whole, t, seen, _single_force_rate(scene, t, seen, force)) for force in scene.forces]
    holding = _transfer_rates(whole, t, seen, rate)
    for work in works:
        holding = _subtract(holding, work)
    for i, force in enumerate(whole.forces):
        if force.has_potential:  # what is stored has not been brought
            stored = partial(_potential, force, whole)
            _, stores = jax.jvp(stored, (t, seen), (jnp.ones_like(t), rate))
            works[i] = works[i] | {"energy": works[i]["energy"] + stores}
    return rate, works, holding


def _single_force_rate(scene: Scene, t: Array, state: Any, force: Any) -> Any:
    """Time derivative of the state if this force were the only one."""
    load = state.sum_loads((state.evaluate_load(force, t, scene.mass),))
    return state.rate(load if state.rotates else scale(1 / scene.mass, load), scene.mass)


def _transfer_rates(scene: Scene, t: Array, state: Any, rate: Any) -> dict[str, Array]:
    """Power [W], force [N] and torque about the origin [N m] of what changes the velocities so fast."""
    after = lambda h: _measure_quantities(scene, t, state.kick(rate, h), energy.kinetic)  # noqa: E731
    return jax.jvp(after, (jnp.zeros(()),), (jnp.ones(()),))[1]
