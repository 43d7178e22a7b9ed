"""What to do about a step that is too long, in words, with what it costs."""

from collections.abc import Callable

from physjax.scene import Scene
from physjax.stepping.implicit import ImplicitMethod
from physjax.stepping.methods import METHODS
from physjax.stepping.registry import read_promises
from physjax.study.stability.limits import Limit, limit
from physjax.study.stability.planar import State
from physjax.text import format_seconds

EVALUATIONS_PER_SOLVE = 20
"""Force evaluations that a linear solve is worth when methods are compared: conjugate gradients take some dozens of products."""
MIN_LIMIT_PER_EVALUATION = 0.5
"""Stability limit of ω·dt for each force evaluation: methods with less are made for accuracy, not for stiffness."""
SAFE_LIMIT_SHARE = 0.9
"""The share of a limit that a cure recommends: limits move with the state."""
RESOLVED_RATE_STEP = 0.1
"""|λ| dt with which a motion is followed to about a percent."""


def list_resolution_cures(dt: float, fastest: Limit, substeps: int) -> tuple[str, ...]:
    """Shorter steps everywhere, or where the motion is fast; each step is so many of the method's."""
    finer = substeps * RESOLVED_RATE_STEP / abs(fastest.rate)
    return (
        f"dt = {format_seconds(finer)}, {dt / finer:.3g} times the cost",
        "methods.adaptive, short steps where it is fast",
    )


def list_cures(scene: Scene, method: Callable, dt: float, worst: Limit, state: State) -> tuple[str, ...]:
    """A shorter step of the same method, and the method that needs the fewest evaluations."""
    cures = []
    promised = read_promises(method)
    if worst.dt > 0:
        safe = SAFE_LIMIT_SHARE * worst.dt
        cures.append(f"dt = {format_seconds(safe)}, {dt / safe:.3g} times the cost")
    others = []
    for name, other in METHODS.items():
        if other.promises.stability_limit < MIN_LIMIT_PER_EVALUATION * other.promises.evaluations:
            continue
        longest = min(SAFE_LIMIT_SHARE * limit(scene, other, at=state).dt, dt) if other is not method else 0.0
        if longest > 0:
            solves = isinstance(other, ImplicitMethod)
            evaluations = EVALUATIONS_PER_SOLVE if solves else other.promises.evaluations
            others.append((evaluations / longest, longest, name, solves))
    for cost, longest, name, solves in sorted(others)[: 2 - len(cures)]:
        times = f", {cost * dt / promised.evaluations:.3g} times the cost" if promised else ""
        cures.append(f"{name} with dt = {format_seconds(longest)}{', a linear solve a step' if solves else times}")
    return tuple(cures)
