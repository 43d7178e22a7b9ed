"""What is measured of a workload, one schema for all: rows of one shape, each with its error beside it.

A workload is the same problem for physjax and its peers: from numbers θ, an array, to places at the end of a run. Five
measures of each: `forward`, how far the places are from a truth in float64; `gradient`, how far a derivative along some
directions of θ is from differences of that truth; `horizon`, the last number of steps at which both are within a hundredth;
`cost`, the time of a forward run and of one with its gradient, taken in turn by all that can do it; and `runs`, whether a peer
does the work at all, with its reason.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import harness
import jax
import numpy as np
from harness import Missing, print_progress

SCHEMA = "physjax-benchmark/1"
LIMIT = 0.01
"""Relative errors beyond which an answer is of no use."""
DIRECTIONS, DIFFERENCE = 3, 1e-5
"""Directions along which derivatives are compared, and the share of θ's scale that differences step by."""


class Size(NamedTuple):
    """How large a run is: lanes (bodies, nodes, worlds) and steps."""

    lanes: int
    steps: int


class Run(NamedTuple):
    """What a peer does with a size: `forward()` gives the places at the end, `gradient()` that of the loss by θ."""

    forward: Callable[[], Any]
    gradient: Callable[[], Any] | None = None


class Peer(NamedTuple):
    """Who runs: a name, its family, how it is written, and how a run of a size is made.

    `largest` bounds lanes times steps of what is timed; `slow` says why it is left out unless it is asked for by `--slow`.
    """

    name: str
    family: str
    how: str
    build: Callable[[Size], Run]
    largest: int = 10**9
    slow: str = ""


class Workload(NamedTuple):
    """A problem: `truth(size, θ)` gives its places in float64, `start(size)` its θ, `weights` those of the loss.

    `checked` is the size at which errors are measured, `horizons` numbers of steps, `costs` the sizes that are timed. `scale`
    is what errors of places are relative to. `exact` says what the truth is.
    """

    name: str
    about: str
    exact: str
    unit: str
    scale: float
    start: Callable[[Size], np.ndarray]
    truth: Callable[[Size, np.ndarray], np.ndarray]
    peers: Callable[[], Iterable[Peer]]
    checked: Size
    horizons: tuple[int, ...]
    costs: tuple[Size, ...]


def make_row(measure: str, peer: Peer, size: Size | None = None, **found: Any) -> dict[str, Any]:
    """A row of a results file: what was measured, of whom, at which size, and what came out."""
    row = {"measure": measure, "peer": peer.name, "family": peer.family}
    return row | ({} if size is None else {"lanes": size.lanes, "steps": size.steps}) | found


def weigh(places: Any) -> Any:
    """The loss: places of each lane, weighted 1, 2, 3 by component, so that no component hides."""
    return sum((i + 1.0) * places[..., i].sum() for i in range(places.shape[-1]))


def as_numbers(found: Any) -> np.ndarray:
    """What a peer returned as float64 in NumPy."""
    return np.asarray(found.numpy() if hasattr(found, "numpy") else found, float)


def pick_directions(theta: np.ndarray) -> list[np.ndarray]:
    """Directions in θ, of length 1."""
    drawn = np.random.default_rng(1).normal(size=(DIRECTIONS, *theta.shape))
    return [direction / np.linalg.norm(direction) for direction in drawn]


def differentiate_truth(work: Workload, size: Size) -> np.ndarray:
    """The derivatives of the loss along the directions, by central differences of the truth."""
    theta = work.start(size).astype(float)
    step = DIFFERENCE * max(np.abs(theta).max(), 1.0) * np.sqrt(theta.size)
    ends = [[weigh(work.truth(size, theta + s * step * d)) for s in (1, -1)] for d in pick_directions(theta)]
    return np.array([(high - low) / (2 * step) for high, low in ends])


def compare_gradient(work: Workload, size: Size, gradient: np.ndarray, differences: np.ndarray) -> float:
    """The largest error of a derivative along a direction, relative to the largest derivative."""
    found = np.array([(gradient * d).sum() for d in pick_directions(work.start(size))])
    return float(np.abs(found - differences).max() / np.abs(differences).max())


def compare_places(places: np.ndarray, truth: np.ndarray) -> float:
    """The largest distance from the truth, in the unit of the places."""
    return float(np.abs(places - truth).max())


def find_peers(work: Workload, peers: bool, slow: bool) -> tuple[list[Peer], list[dict[str, Any]]]:
    """Those that are installed, physjax first, and a row for each that is not or is left out."""
    found, missing = [], []
    for peer in work.peers():
        if not peers and peer.name != "physjax":
            continue
        if peer.slow and not slow:
            missing.append(make_row("runs", peer, ok=None, why=f"left out: {peer.slow}; --slow runs it", how=peer.how))
            continue
        try:
            peer.build(Size(*work.checked))
            found.append(peer)
        except Missing as reason:
            missing.append(make_row("runs", peer, ok=False, why=str(reason)))
    return found, missing


def measure_errors(work: Workload, peers: Iterable[Peer], horizons: Iterable[int]) -> list[dict[str, Any]]:
    """`runs`, `forward`, `gradient` and `horizon` of each peer."""
    truths = {steps: Size(work.checked.lanes, steps) for steps in {work.checked.steps, *horizons}}
    exact = {n: work.truth(size, work.start(size).astype(float)) for n, size in sorted(truths.items())}
    slopes = {n: differentiate_truth(work, size) for n, size in sorted(truths.items())}
    rows = []
    for peer in peers:
        rows += _measure_peer(work, peer, sorted(horizons), exact, slopes)
    return rows


def _measure_peer(work: Workload, peer: Peer, horizons: list[int], exact: Mapping, slopes: Mapping) -> list[dict]:
    checked, rows, errors = work.checked, [], {}
    for steps in dict.fromkeys((checked.steps, *horizons)):
        size = Size(checked.lanes, steps)
        try:
            errors[steps] = _measure_once(work, peer, size, exact[steps], slopes[steps])
        except Exception as error:
            if steps == checked.steps:
                why = f"{type(error).__name__}: {str(error)[:200]}"
                return [make_row("runs", peer, size, ok=False, why=why, how=peer.how)]
            errors[steps] = np.inf, None  # it does not hold so far
    places, gradient = errors[checked.steps]
    differentiates = isinstance(gradient, float)
    why = gradient if isinstance(gradient, str) else None
    rows.append(make_row("runs", peer, checked, ok=True, differentiates=differentiates, why=why, how=peer.how))
    rows.append(make_row("forward", peer, checked, error=places, relative=places / work.scale, unit=work.unit))
    if differentiates:
        rows.append(make_row("gradient", peer, checked, error=gradient, unit="relative"))
    held = 0
    for steps in horizons:
        place, slope = errors.get(steps, (np.inf, None))
        if not (place / work.scale <= LIMIT and (not differentiates or slope <= LIMIT)):
            break
        held = steps
    tried = horizons[-1] if horizons else 0
    rows.append(make_row("horizon", peer, checked, held=held, tried=tried, limit=LIMIT, errors=errors))
    print_progress(
        f"  {peer.name}: forward {places:.2g} {work.unit}, gradient {gradient}, holds {held} of {tried} steps"
    )
    return rows


def _measure_once(work: Workload, peer: Peer, size: Size, exact: np.ndarray, slopes: np.ndarray) -> tuple:
    run = peer.build(size)
    places = as_numbers(jax.block_until_ready(run.forward()))
    gradient = None
    if run.gradient is not None:
        try:
            gradient = compare_gradient(work, size, as_numbers(jax.block_until_ready(run.gradient())), slopes)
        except Exception as error:  # what cannot be differentiated still runs, and its row says why
            gradient = f"{type(error).__name__}: {str(error)[:200]}"
    return compare_places(places, exact), gradient


def measure_costs(work: Workload, peers: Iterable[Peer], sizes: Iterable[Size], repeats: int) -> list[dict[str, Any]]:
    """`cost` of forward runs and of gradients, by size, all peers in turn; the least and the median of the turns."""
    rows = []
    for size in sizes:
        able = {peer.name: (peer, peer.build(size)) for peer in peers if size.lanes * size.steps <= peer.largest}
        for of in ("forward", "gradient"):
            calls = {name: getattr(run, of) for name, (_, run) in able.items() if getattr(run, of) is not None}
            print_progress(f"  {of}, {size.lanes:,} lanes, {size.steps:,} steps")
            timings, failed = harness.time_side_by_side(calls, repeats)
            for name, timing in timings.items():
                rows.append(make_row("cost", able[name][0], size, of=of, **describe_timing(timing)))
            rows += [make_row("cost", able[name][0], size, of=of, failed=why) for name, why in failed.items()]
    return rows


def describe_timing(timing: Any) -> dict[str, Any]:
    """Times as a row has them [s]."""
    return {
        "least_s": timing.least,
        "median_s": timing.median,
        "repeats": len(timing.seconds),
        "first_call_s": timing.first,
        "compile_s": timing.compiling,
        "cores": timing.cores,
    }
