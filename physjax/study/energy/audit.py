"""Steps a run again and observes each stage: what gives and what takes energy, momentum and angular momentum.

The method's motion is compared with the exact motion from the same start, integrated by diffrax together with the work
and the impulse of every force; the difference is the method's own, numerical share. Every later stage of a step is run
as the scene runs it, and measured before and after.
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
from jaxtyping import Array, PyTree

from physjax.constraints.reactions import find_stops, split_rate
from physjax.loops import Moment, Time, moment_at
from physjax.particles import callable_name
from physjax.parts import Force
from physjax.physics.contacts.time_of_impact import Flight, fold_flights, impact
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.response import collide, fold_body_flights
from physjax.physics.rigid.solids.response import solve_contacts
from physjax.physics.rigid.spatial import RigidBodies
from physjax.scene import Scene
from physjax.stages import Stage
from physjax.stepping.reference import build_default_solver, cast_floats
from physjax.study import energy
from physjax.study.energy.solids import fold_solid_flights
from physjax.trajectory import Trajectory
from physjax.vectors import scale

NUMERICAL, PINS, PIVOTS, CLOSING = "numerical", "pins", "pivots", "closing joints"
RESPONSE_OBSERVERS = {impact: fold_flights, collide: fold_body_flights, solve_contacts: fold_solid_flights}
"""How the legs of a response's steps are observed: of particles, of bodies in space, and of bodies in the plane."""
Amounts = dict[str, Array]
"""Energy, momentum and, beyond one dimension, angular momentum, by name."""
EnergyBudget = dict[str, dict[str, Any]]
"""The amounts of each cause so far, by its name; in the end as NumPy arrays."""
Stepper = Callable[..., PyTree]
"""A method."""


@eqx.filter_jit
def audit_run(run: Trajectory, substeps: Array) -> tuple[EnergyBudget, EnergyBudget]:
    """What the scene stores at each frame, and what each cause brings between a frame and the next; in float64.

    `substeps` of order 8 follow the exact motion through every step. For use inside `jax.enable_x64(True)`.
    """
    audit = lambda run: _audit_single_run(run, substeps)  # noqa: E731
    for _ in range(run.first_step.ndim):  # runs that came out of vmap
        audit = jax.vmap(audit)
    return audit(run)


def _audit_single_run(run: Trajectory, substeps: Array) -> tuple[EnergyBudget, EnergyBudget]:
    scene, film = run.scene, run.film
    assert scene is not None
    assert run.dt is not None
    assert run.stepper is not None
    stepper = run.stepper
    dt = jnp.asarray(run.dt)
    changes = scene.changing()
    frames, still = eqx.filter(film, changes), eqx.filter(scene, changes, inverse=True)

    def between(number, frame):
        def step(i, carry):
            moving, budget = carry
            count = run.first_step + number * run.save_every + i
            t = moment_at(count, dt, scene.state.dtype)
            after, budget = _audit_step(eqx.combine(moving, still), stepper, t, dt, substeps, budget)
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
    """Names of the forces, of the contacts, and of the rest: springs that break or yield, constraints, and the method."""
    losing = [
        _name_loss(name, force)
        for name, force in zip(name_parts(scene.forces), scene.forces, strict=True)
        if _may_lose_energy(force)
    ]
    holding = [PINS] if scene.pinned is not None else []
    holding += [CLOSING] if scene.constraints and scene.contacts else []
    holding += [PIVOTS] if isinstance(scene.mass, Inertia) and scene.mass.arm is not None else []
    contacts = name_parts(scene.contacts)
    return name_parts(scene.forces), contacts, [*losing, *holding, NUMERICAL]


def name_parts(parts: tuple) -> list[str]:
    """Names of forces or contacts, numbered where several have the same."""
    names, seen = [callable_name(part) for part in parts], Counter()
    several = {name for name, count in Counter(names).items() if count > 1}
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = f"{name} {seen[name]}" if name in several else name
    return names


def _may_lose_energy(force: Force) -> bool:
    """Whether a force may lose energy between two steps: it has memory and a potential, as springs that break."""
    return force.remembers and force.has_potential


def _name_loss(name: str, force: Force) -> str:
    """What the energy that a force of this name loses between two steps is entered as."""
    if getattr(force, "yields_at", None) is None:
        return f"{name} parted"
    return f"{name} yielded" if getattr(force, "breaks_at", None) is None else f"{name} yielded or parted"


def cast_to_float64(tree: PyTree) -> PyTree:
    """The arrays in float64."""
    return cast_floats(tree, jnp.float64)


def build_empty_budget(scene: Scene) -> EnergyBudget:
    """A budget of zeros."""
    wide = cast_to_float64(scene)
    empty = jax.eval_shape(lambda scene: _measure_quantities(scene, jnp.zeros(()), scene.state), wide)
    zeros = lambda: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), empty)  # noqa: E731
    return {name: zeros() for names in list_causes(scene) for name in names}


def _measure_quantities(
    scene: Scene, t: ArrayLike, state: PyTree, measure: Callable[..., Array] = energy.total
) -> Amounts:
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


def _potential(force: Force, scene: Scene, t: ArrayLike, state: PyTree) -> Array:
    joules = force.potential(t, *state.view_for_force(force, scene.mass))
    assert joules is not None
    return energy.summed(scene, joules)


def _cast_to_number(t: Time) -> Array:
    """A moment as one number, which in float64 holds all of it."""
    if not isinstance(t, Moment):
        return jnp.asarray(t, jnp.float64)
    start, rest, elapsed = cast_to_float64((t.start, t.rest, 0.0 if t.elapsed is None else t.elapsed))
    return start + (rest + elapsed)


def _audit_step(
    scene: Scene, method: Stepper, t: Time, dt: Array, substeps: Array, budget: EnergyBudget
) -> tuple[Scene, EnergyBudget]:
    """One step of the run, stage by stage, with what each has changed entered in the budget."""
    end = _cast_to_number(t + dt)
    measure = lambda at: _measure_quantities(*cast_to_float64((at, end, at.state)))  # noqa: E731
    move, *later = scene.stages(method, t, dt)
    budget, moved = _observe_motion(scene, method, t, dt, substeps, budget)
    now = after_motion = move.run(scene)
    # the same motion, but compiled apart: they differ by rounding
    budget = _enter(budget, NUMERICAL, _subtract(measure(now), measure(scene.replace(state=moved))))
    contacts, forces = name_parts(scene.contacts), name_parts(scene.forces)
    for stage in later:
        before, now = now, stage.run(now)
        change = _subtract(measure(now), measure(before))
        if stage.name == "resolve contacts" and stage.part is not None:
            budget = _enter(budget, contacts[stage.part], change)
        elif stage.name == "close joints":
            budget = _enter(budget, CLOSING, change)
        elif stage.name == "advance memory" and stage.part is not None:
            name, force = forces[stage.part], scene.forces[stage.part]
            budget = _enter(budget, _name_loss(name, force) if _may_lose_energy(force) else NUMERICAL, change)
        else:
            error = _measure_path_error(scene, stage, after_motion, measure)
            budget = _enter(_enter(budget, NUMERICAL, error), PINS, _subtract(change, error))
    return now, budget


def _observe_motion(
    scene: Scene, method: Stepper, t: Time, dt: Array, substeps: Array, budget: EnergyBudget
) -> tuple[EnergyBudget, PyTree]:
    """The budget with the motion of a step entered, leg by leg where impacts are timed; and where the motion leads."""
    motion = scene.constrained_motion(method)
    record = partial(_record_flight, cast_to_float64(scene), substeps)
    timed = [contact.response for contact in scene.contacts if contact.response in RESPONSE_OBSERVERS]
    if timed:
        return RESPONSE_OBSERVERS[timed[0]](motion, scene, t, dt, record, budget)
    moved = motion(scene, t, dt).state
    return record(budget, Flight(scene.state, scene, t, dt, moved, moved, None)), moved


def _measure_path_error(
    scene: Scene, stage: Stage, after_motion: Scene, measure: Callable[[Scene], Amounts]
) -> Amounts:
    """By how much the method misses the path of kinematic nodes: what putting them on it changes without contacts.

    What the stage changes beyond that undoes what contacts did to these nodes. Nodes that are held follow no path.
    """
    start = measure(after_motion)
    if scene.prescribed_motion is None:
        return jax.tree.map(jnp.zeros_like, start)
    return _subtract(measure(stage.run(after_motion)), start)


def _enter(budget: EnergyBudget, cause: str, amounts: Amounts) -> EnergyBudget:
    """The budget with amounts added to what a cause has brought."""
    return {**budget, cause: _add(budget[cause], amounts)}


def _record_flight(whole: Scene, substeps: Array, budget: EnergyBudget, flight: Flight) -> EnergyBudget:
    """The budget after a flight: works and impulses along the exact motion, the method's error, and the impact at its end."""
    start, before, end, after = cast_to_float64((flight.scene, flight.before, flight.end, flight.after))
    t, duration = _cast_to_number(flight.leg_start), flight.duration.astype(jnp.float64)
    measure = lambda t, state: _measure_quantities(whole, t, state)  # noqa: E731
    exact, works, holding = _integrate_exactly(whole, start, t, duration, substeps)
    names, contacts, _ = list_causes(whole)
    entries = dict(zip(names, works, strict=True))
    entries[NUMERICAL] = _subtract(measure(t + duration, end), measure(t + duration, exact))
    timed = [contact.response in RESPONSE_OBSERVERS for contact in whole.contacts]
    if any(timed):
        entries |= _split_by_contact(
            contacts,
            _find_nearest_contact(whole, timed, t, before),
            _subtract(measure(t, start.state), measure(t, before)),
        )
        impact_change = _subtract(measure(t + duration, after), measure(t + duration, end))
        entries = _add_entries(
            entries, _split_by_contact(contacts, _find_nearest_contact(whole, timed, t + duration, end), impact_change)
        )
        leaning = _find_nearest_contact(whole, timed, t, start.state)
        if whole.held is not None:
            held = jnp.ones(whole.status_shape, bool) if whole.couples else whole.held
            entries[PINS] = _mask_amounts(held, holding)
            leaning = [share & ~held for share in leaning]
        entries = _add_entries(entries, _split_by_contact(contacts, leaning, holding))
    elif PINS in budget or PIVOTS in budget:
        entries[next(name for name in (PINS, PIVOTS) if name in budget)] = holding
    entries = _enter_stops(whole, start, end, entries)
    if flight.active is not None:
        entries = {name: _mask_amounts(flight.active, entry) for name, entry in entries.items()}
    return _add_entries(budget, entries)


def _enter_stops(whole: Scene, start: Scene, end: PyTree, entries: EnergyBudget) -> EnergyBudget:
    """The entries, with what the exact motion of a step does not have given to the joints that came to a limit in it."""
    lost = entries[NUMERICAL]
    named = zip(name_parts(whole.forces), whole.forces, strict=True)
    joints = [name for name, force in named if force.response is not None]
    for name, came in zip(joints, find_stops(whole, start.state, end) if joints else (), strict=True):
        if came is not None:
            entries = _add_entries(entries, {name: _mask_amounts(came, lost)})
            lost = _mask_amounts(~came, lost)
    return entries | {NUMERICAL: lost}


def _find_nearest_contact(scene: Scene, timed: list[bool], t: Array, state: PyTree) -> list[Array]:
    """For each contact, whether it is the nearest of those that time their impacts; of coupled lanes, to any of them."""

    def gap(contact):
        found = jnp.abs(contact.clearance(t[..., None] if scene.couples else t, state))
        return jnp.min(found, axis=-1) if scene.couples else found

    gaps = [gap(c) if is_timed else None for c, is_timed in zip(scene.contacts, timed, strict=True)]
    far = jnp.full(scene.status_shape, jnp.inf)
    nearest = jnp.argmin(jnp.stack([far if gap is None else gap for gap in gaps]), axis=0)
    return [nearest == i for i in range(len(gaps))]


def _split_by_contact(names: list[str], shares: list[Array], amounts: Amounts) -> EnergyBudget:
    return {name: _mask_amounts(share, amounts) for name, share in zip(names, shares, strict=True)}


def _mask_amounts(flag: Array, amounts: Amounts) -> Amounts:
    return jax.tree.map(lambda a: jnp.where(flag.reshape(flag.shape + (1,) * (a.ndim - flag.ndim)), a, 0.0), amounts)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _subtract(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.subtract, a, b)


def _add_entries(budget: EnergyBudget, entries: EnergyBudget) -> EnergyBudget:
    """The budget with the entries added to those of the same name."""
    return budget | {name: _add(budget[name], entry) if name in budget else entry for name, entry in entries.items()}


def _integrate_exactly(
    whole: Scene, start: Scene, t: Array, duration: Array, substeps: Array
) -> tuple[PyTree, list[Amounts], Amounts]:
    """The exact motion: its end, what every force brings along it, and what constraints (pins, pivots, contacts) bring."""
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
        # fixed steps of a known order: doubling them tells how exact the exact motion is
        dt0=1 / substeps.astype(jnp.float64),
        y0=(scene.state, *zeros),
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    return jax.tree.map(lambda leaf: leaf[0], solution.ys)


def _compute_rates(whole: Scene, scene: Scene, t: Array, state: PyTree) -> tuple[PyTree, list[Amounts], Amounts]:
    """Time derivative of the state, and what each force, and what the constraints bring in a second."""
    rate, joined = split_rate(scene, t, state)
    felt = state if scene.prescribed_motion is None else scene.prescribed_motion.prescribe(t, state)
    felt = felt.on_pivot(scene.mass) if isinstance(felt, RigidBodies) else felt
    alone = [_single_force_rate(scene, t, felt, force) for force in scene.forces]
    for part, joints in zip(whole.constraints, joined, strict=True):
        # two parts that are equal are two
        alone[[force is part for force in whole.forces].index(True)] = joints
    works = [_transfer_rates(whole, t, felt, rate) for rate in alone]
    holding = _transfer_rates(whole, t, felt, rate)
    for work in works:
        holding = _subtract(holding, work)
    for i, force in enumerate(whole.forces):
        if force.has_potential:  # what the force stores is accounted for by its potential
            stored = partial(_potential, force, whole)
            _, stores = jax.jvp(stored, (t, felt), (jnp.ones_like(t), rate))
            works[i] = works[i] | {"energy": works[i]["energy"] + stores}
    return rate, works, holding


def _single_force_rate(scene: Scene, t: Array, state: PyTree, force: Force) -> PyTree:
    """Time derivative of the state if this force acted alone."""
    load = state.sum_loads((state.evaluate_load(force, t, scene.mass),))
    return state.rate(load if state.rotates else scale(1 / scene.mass, load), scene.mass)


def _transfer_rates(scene: Scene, t: Array, state: PyTree, rate: PyTree) -> Amounts:
    """Power [W], force [N] and torque about the origin [N m] of what changes the velocities at this rate."""
    after = lambda h: _measure_quantities(scene, t, state.kick(rate, h), energy.kinetic)  # noqa: E731
    return jax.jvp(after, (jnp.zeros(()),), (jnp.ones(()),))[1]
