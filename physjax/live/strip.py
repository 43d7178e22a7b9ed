"""The line of figures under a live view: error, energy, stable step, cost, and what failed and why."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from physjax.live.runs import Run, measure_energies
from physjax.live.sources import Built, Source
from physjax.stepping.adaptive import Adaptive
from physjax.study.accuracy.error_measures import path
from physjax.study.energy.quantities import ENERGY
from physjax.study.stability.limits import Limit, limit
from physjax.text import format_seconds

ROUGH_ERROR, LARGE_ERROR = 1e-3, 3e-2
"""Shares of the path beyond which an error may be seen, and is seen."""
CLOSE_TO_LIMIT = 0.8
"""A step longer than this share of the longest stable one is marked."""
SHORT_PATH_SHARE = 0.01
"""A path shorter than this share of the room that the scene takes is no measure of its error: a stack rests."""
ROUNDING_DRIFT = 1e-12
"""A change of energy below this share of the kinetic energy is rounding."""


class Figure(NamedTuple):
    """A figure of the strip: its name, its value, a few words on it, and whether it is "good", "fair" or "bad"."""

    name: str
    value: str
    note: str
    grade: str = "good"


def describe_error(run: Run, truth: object, against: str) -> Figure:
    """How far the run is from the true states at its moments, or from what is taken for them."""
    scene = run.flight.scene
    assert scene is not None
    times, floor = np.asarray(run.flight.time), _find_floor(run)
    size = path.size(scene, times, truth)
    units = path.units(scene, times, run.flight.state, truth, np.maximum(size, floor))
    share = float(units.max()) if np.isfinite(units).all() else np.inf
    if not np.isfinite(share):
        return Figure("error", "not finite", against, "bad")
    grade = "good" if share < ROUGH_ERROR else "fair" if share < LARGE_ERROR else "bad"
    reach = np.broadcast_to(size, run.flight.position.shape[1:-1]).ravel()  # nodes of a coupled scene share theirs
    short = reach[int(units.max(axis=0).argmax())] < floor
    whole = f"{floor:.2g} m, since little moves" if short else "the path"
    return Figure("error", format_share(share), f"of {whole}, {against}", grade)


def _find_floor(run: Run) -> float:
    """The shortest path that errors are relative to [m]."""
    place = np.asarray(run.flight.position, float)
    with np.errstate(invalid="ignore"):
        room = np.ptp(place.reshape(-1, place.shape[-1]), axis=0).max()
    return SHORT_PATH_SHARE * float(room) if np.isfinite(room) else 0.0


def describe_energy(run: Run, built: Built, source: Source) -> Figure:
    """By how much the energy changed, relative to the largest kinetic energy; a drift where physics keeps it."""
    name = "energy drift" if _keeps_energy(built) else "energy change"
    scene = built.scene
    if scene.emitter is not None:
        return Figure(name, "-", "particles are born and die")
    energy, motion = measure_energies(source, run)
    size, change = np.max(motion, axis=0), energy - energy[:1]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        shares = np.where(size > 0, change / size, 0.0)
    if not (np.isfinite(shares).all() and np.isfinite(size).all()):
        return Figure(name, "not finite", "of the kinetic energy", "bad")
    worst = float(shares.flat[np.argmax(np.abs(shares))])
    text = "none" if abs(worst) < ROUNDING_DRIFT else ("+" if worst > 0 else "−") + format_share(abs(worst))
    if name == "energy change" and abs(worst) > 1:  # a stack that rests has none to speak of
        most = float(change.flat[np.argmax(np.abs(change))])
        return Figure(name, f"{most:+.2g} J".replace("-", "−"), "more than all kinetic energy; contacts do work here")
    if name == "energy change":
        return Figure(name, text, "of the kinetic energy; forces and contacts do work here")
    grade = "good" if abs(worst) < ROUGH_ERROR else "fair" if abs(worst) < LARGE_ERROR else "bad"
    return Figure(name, text, "of the kinetic energy", grade)


def _keeps_energy(built: Built) -> bool:
    if built.problem is not None and built.problem.conserved:
        return any(quantity is ENERGY for quantity in built.problem.conserved)
    scene = built.scene
    potentials = all(force.has_potential for force in scene.forces)
    return potentials and not scene.contacts and scene.prescribed_motion is None and scene.emitter is None


def describe_cost(run: Run) -> Figure:
    """Processor time of a step, and the number of steps."""
    whole = run.step_seconds * run.steps
    return Figure(
        "cost of a step", format_seconds(run.step_seconds), f"{run.steps} steps, {format_seconds(whole)} in all"
    )


def find_limit(built: Built, source: Source, method: Callable, run: Run) -> Limit | None:
    """The longest stable step, at the start and where the kinetic energy is largest; None where it is not known."""
    if isinstance(method, Adaptive):
        return None
    _, motion = measure_energies(source, run)
    energy = motion.reshape(len(motion), -1).sum(axis=1)
    fastest = int(np.argmax(np.where(np.isfinite(energy), energy, -1.0)))
    try:
        return min(
            (limit(built.scene, method, at) for at in _pick_states(run, {0, fastest})), key=lambda found: found.dt
        )
    except (TypeError, ValueError):  # what turns in space, or has parts of its own, is not linearised
        return None


def _pick_states(run: Run, frames: set[int]) -> list[Any]:
    state = run.flight.state
    whole = [i for i in sorted(frames) if all(np.isfinite(np.asarray(leaf)[i]).all() for leaf in state)]
    return [type(state)(*(np.asarray(leaf)[i] for leaf in state)) for i in whole]


def describe_limit(found: Limit | None, dt: float, method: Callable) -> Figure:
    """The longest stable step, and how far dt is from it."""
    name = "stable step"
    if isinstance(method, Adaptive):
        return Figure(name, "-", "the method chooses its own steps")
    if found is None:
        return Figure(name, "-", "not known for this kind of scene")
    if np.isinf(found.dt):
        return Figure(name, "any", "nothing here limits it")
    if not found.dt:
        return Figure(name, "none", f"{found.method} grows at any step: {_name_cause(found)}", "fair")
    ratio = dt / found.dt
    grade = "good" if ratio < CLOSE_TO_LIMIT else "fair" if ratio <= 1 else "bad"
    return Figure(name, format_seconds(found.dt), f"dt is {ratio:.2g} of it; {_name_cause(found)}", grade)


def _name_cause(found: Limit) -> str:
    where = "" if found.spring is None else f", nodes {found.spring[0]} and {found.spring[1]}"
    return f"{found.cause} of {found.force}{where}"


def describe_status(run: Run, found: Limit | None) -> Figure:
    """Whether lanes failed, since when, and why."""
    failed = run.failed
    if not failed.any():
        lanes = "all finite" if failed.ndim == 0 else f"all {failed.size} lanes finite"
        return Figure("status", "ok", lanes)
    scene = run.flight.scene
    assert scene is not None
    since = _find_last_good_time(run)
    who = "the run" if failed.ndim == 0 else f"{int(failed.sum())} of {failed.size} lanes"
    why = "try a smaller dt"
    if found is not None and run.dt > found.dt:
        longest = f"longer than {format_seconds(found.dt)}" if found.dt else "never stable"
        why = f"the step is {longest}: {_name_cause(found)}"
    elif scene.contacts:
        why = "a contact overran what waited for it, or the step is too long: try a smaller dt"
    return Figure("status", "failed", f"{who} blew up after t = {format_seconds(since)}: {why}", "bad")


def _find_last_good_time(run: Run) -> float:
    """The last moment at which everything was finite [s]."""
    leaves = [np.isfinite(np.asarray(leaf)).reshape(len(run.flight.time), -1).all(axis=1) for leaf in run.flight.state]
    good = np.all(leaves, axis=0)
    return float(run.flight.time[max(0, int(np.argmin(good)) - 1)])


def format_share(share: float) -> str:
    """A share as a percentage where that is readable, e.g. "0.3 %" or "2e-7"."""
    if 1e-5 <= share < 100:
        return f"{float(f'{100 * share:.2g}'):g} %"
    return f"{share:.1e}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")


__all__ = [
    "Figure",
    "describe_cost",
    "describe_energy",
    "describe_error",
    "describe_limit",
    "describe_status",
    "find_limit",
    "format_share",
]
