"""Whether a change of the code changed a single bit of what the gallery computes.

    python benchmarks/bits.py record before.npz              # every scene; or only those that are named
    python benchmarks/bits.py compare before.npz after.npz   # a table; exit status 1 if anything differs

Every scene of the gallery runs under two methods in float64, in steps of a 64th of its frames: ten steps, which leave
a difference as small as it arose, and on until something is touched, breaks or is blown, so that contacts count too.
The states then are kept as they are, in the order of their leaves and not by the names of fields or modules, which may
change. `before.json` beside the file says how long each scene took to be built and to run for the first time.

Bits are those of a processor, a version of jax and XLA's flags: record both sides on one machine. Only `physjax.scenes`,
`physjax.simulate` and `physjax.methods` are used, so that one script serves the code before a change and after it.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # what is recorded is this checkout, installed or not

import jax
import numpy as np

import physjax
from physjax import methods, simulate
from physjax.scenes import SCENES

METHODS = ("rk4", "semi_implicit_euler", "verlet", "midpoint", "euler")
"""In the order in which they are tried; the first `COUNT` that a scene does not refuse are recorded."""
COUNT = 2
FEW = 10
"""Steps to the first state that is kept, and between those of which the last is kept."""
MANY = 60
"""Steps to the last state, where nothing else is said."""
UNTIL = {
    "bouncing_ball": 480,
    "tennis_ball": 1040,
    "cloth_over_sphere": 130,
    "car": 240,
    "fountain": 610,
    "sparks": 340,
    "snow": 450,
    "tumbling_box": 290,
    "basketball": 3640,
    "free_kick": 1600,
    "jelly_cube": 220,
    "breaking_bridge": 6900,
    "blown_bridge": 200,
}
"""Steps to the last state, some 50 after the first touch, break or blast, where that comes late."""
FINE = 64
"""Steps to a frame of the scene."""
REFUSED = "refused"

jax.config.update("jax_enable_compilation_cache", False)  # a first run is one that compiles


class Difference(NamedTuple):
    """By how much two arrays differ: in units in the last place of the largest number, and relative to that number."""

    ulps: float
    relative: float


def record(path: Path, names: Sequence[str]) -> None:
    """Run the scenes one by one; write their last states, and beside them the seconds that it took."""
    arrays, seconds, begun = {}, {}, time.perf_counter()
    with jax.enable_x64(True):
        for name in names:
            seconds[name] = {}
            jax.clear_caches()  # scenes of one structure share a program, and the second would seem to cost nothing
            for key, array in recorded(name, seconds[name]):
                arrays[f"{name}/{key}"] = array
            told = ", ".join(f"{what} {spent:.2f} s" for what, spent in seconds[name].items())
            print(f"{name}: {told}", file=sys.stderr, flush=True)
    about = machine() | {"total_s": time.perf_counter() - begun, "seconds": seconds}
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)
    with replacing(path.with_suffix(".json")) as part:
        part.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def recorded(name: str, seconds: dict[str, float]) -> Iterator[tuple[str, np.ndarray]]:
    """The states of a scene as `method/steps/leaf`, or why a method is refused; fills in the seconds of first runs."""
    start = time.perf_counter()
    problem = SCENES[name]()
    seconds["build"] = time.perf_counter() - start
    steps, left = UNTIL.get(name, MANY), COUNT
    for method in METHODS:
        if not left:
            return
        start = time.perf_counter()
        try:
            dt = problem.duration / (FINE * problem.frames)
            run = simulate(problem.scene, getattr(methods, method), dt=dt, steps=steps, save_every=FEW)
        except (TypeError, ValueError, NotImplementedError) as error:
            yield f"{method}/{REFUSED}", np.array(f"{type(error).__name__}: {error}")
            continue
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(run.state)]
        seconds[method] = time.perf_counter() - start
        left -= 1
        for frame in (1, steps // FEW):
            for place, leaf in enumerate(leaves):
                yield f"{method}/{frame * FEW}/{place}", leaf[frame]


def compare(before: Path, after: Path, names: Sequence[str], ulps: float) -> int:
    """Print how far two recordings lie apart, run by run; 1 if a run differs by more than so many ulps, else 0."""
    sides = [runs(path, names) for path in (before, after)]
    rows, failed = [], 0
    for run in dict.fromkeys([*sides[0], *sides[1]]):
        verdict, good = judged(sides[0].get(run), sides[1].get(run), ulps)
        rows.append((*run, verdict))
        failed += not good
    head = ("scene", "method", "steps", "")
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print(f"\n{len(rows)} states: {len(rows) - failed} agree, {failed} do not.")
    return 1 if failed or not rows else 0


def runs(path: Path, names: Sequence[str]) -> dict[tuple[str, str, str], list[np.ndarray]]:
    """The leaves of a recording by scene, method and steps; of all scenes where none is named."""
    found: dict[tuple[str, str, str], list[np.ndarray]] = {}
    with np.load(path) as arrays:
        for key in arrays.files:
            scene, method, steps, *_ = key.split("/")
            if not names or scene in names:
                found.setdefault((scene, method, steps), []).append(arrays[key])
    return found


def judged(before: list[np.ndarray] | None, after: list[np.ndarray] | None, ulps: float) -> tuple[str, bool]:
    """What is to be said of the leaves of one run, and whether they agree."""
    if before is None or after is None:
        return f"only {'after' if before is None else 'before'}", False
    if before[0].dtype.kind == "U" == after[0].dtype.kind:
        same = "same words" if before[0] == after[0] else "other words"
        return f"refused before and after, in the {same}", True
    kinds, others = ([f"{leaf.dtype}{list(leaf.shape)}" for leaf in leaves] for leaves in (before, after))
    if kinds != others:
        return f"other leaves: {' '.join(kinds)} before, {' '.join(others)} after", False
    if all(one.tobytes() == other.tobytes() for one, other in zip(before, after, strict=True)):
        return "identical bits", True
    worst = max((difference(*pair) for pair in zip(before, after, strict=True)), key=lambda found: found.ulps)
    words = f"{worst.ulps:.3g} ulps, relative {worst.relative:.2g}" if worst.ulps else "zeros of another sign"
    return words, ulps > 0 and worst.ulps <= ulps


def difference(before: np.ndarray, after: np.ndarray) -> Difference:
    """How far one array lies from another of its shape: infinitely where they differ and are no finite real numbers."""
    if before.tobytes() == after.tobytes():
        return Difference(0.0, 0.0)
    if before.dtype.kind != "f" or not (np.isfinite(before).all() and np.isfinite(after).all()):
        return Difference(np.inf, np.inf)
    apart, largest = np.abs(after - before).max(), np.abs(before).max()
    return Difference(float(apart / np.spacing(largest)), float(apart / largest) if largest else np.inf)


def machine() -> dict[str, Any]:
    """What decides about bits, and which code was recorded."""
    return {
        "physjax": str(Path(physjax.__file__).parent),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
        "processor": processor(),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


def processor() -> str:
    """The processor by the name that it gives itself."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to, which takes the place of `path` when the block ends well: the file is whole or absent."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Record or compare, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record", help="run the scenes and keep their states")
    recording.add_argument("file", type=Path, metavar="FILE.npz")
    comparing = commands.add_parser("compare", help="report how far two recordings lie apart")
    comparing.add_argument("before", type=Path, metavar="BEFORE.npz")
    comparing.add_argument("after", type=Path, metavar="AFTER.npz")
    comparing.add_argument("--ulps", type=float, default=0.0, help="differences up to so many pass (%(default)s)")
    for command in (recording, comparing):
        command.add_argument("scenes", nargs="*", metavar="SCENE", help="these scenes; all by default")
    given = parser.parse_args(arguments)
    unknown = [name for name in given.scenes if name not in SCENES]
    if unknown:
        parser.error(f"there is no scene {', '.join(unknown)}; expected some of {', '.join(SCENES)}")
    if given.command == "compare":
        return compare(given.before, given.after, given.scenes, given.ulps)
    record(given.file, given.scenes or list(SCENES))
    return 0


if __name__ == "__main__":
    sys.exit(main())
