"""What every benchmark shares: the machine, timing side by side, counting compilations, tables, charts, whole files.

Contenders take turns of half a second in one process, by the policy of `physjax.timing`; the very first call, which
compiles, is timed by itself. Times are those of finished work.
"""

import argparse
import ctypes
import importlib
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # what is measured is this checkout, installed or not

import jax
from jax.stages import Wrapped
from jaxtyping import PyTree

import physjax
from physjax.files import ensure_writable_folder, write_atomically
from physjax.text import format_table
from physjax.timing import Timing, time_in_turn

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = (
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "optimistix",
    "numpy",
    "numba",
    "warp-lang",
    "taichi",
    "mujoco-mjx",
    "rebound",
    "pymunk",
    "scipy",
)
TURN_SECONDS = 0.5
"""Seconds of a turn."""
COLOURS = {"physjax": "#0072B2", "other JAX code": "#E69F00", "without JAX": "#999999"}
"""By family of contenders, from the palette of Okabe and Ito, which colour-blind readers tell apart, also in grey."""

jax.config.update("jax_enable_compilation_cache", False)  # a cache on disk would hide what compiling costs
_compile_seconds: list[float] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: _compile_seconds.append(seconds) if event.endswith("backend_compile_duration") else None
)


class Bar(NamedTuple):
    """A measured number and what it must be."""

    name: str
    measured: float
    relation: str
    wanted: float

    @property
    def met(self) -> bool:
        """Whether it is met."""
        return self.measured >= self.wanted if self.relation == ">=" else self.measured <= self.wanted


@contextmanager
def record_compilations() -> Iterator[list[float]]:
    """Seconds of every compilation by XLA inside the block, in a list that is filled when the block ends."""
    start, seen = len(_compile_seconds), []
    yield seen
    seen.extend(_compile_seconds[start:])


class Missing(Exception):
    """Something that this machine lacks."""


def import_optional(module: str, package: str | None = None) -> ModuleType:
    """An installed module, or `Missing` with what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise Missing(f"not installed (pip install {package or module})") from error


def compile_c(source: str) -> ctypes.CDLL:
    """C code compiled for this processor, as fast as the compiler can; `Missing` without a compiler."""
    flags = ["-O3", "-march=native", "-ffast-math", *(["-mprefer-vector-width=512"] if has_avx512() else [])]
    with tempfile.TemporaryDirectory() as folder:
        code, binary = Path(folder) / "code.c", Path(folder) / "code.so"
        code.write_text(source)
        command = ["cc", *flags, "-shared", "-fPIC", "-o", str(binary), str(code), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except FileNotFoundError as error:
            raise Missing("there is no C compiler called cc") from error
        except subprocess.CalledProcessError as error:
            raise Missing(f"{' '.join(command[:-5])} failed: {error.stderr.strip()[-300:]}") from error
        return ctypes.CDLL(str(binary))


def time_side_by_side(
    contenders: Mapping[str, Callable[[], object]],
    repeats: int,
    check: Callable[[str, Any], None] = lambda name, found: None,
) -> tuple[dict[str, Timing], dict[str, str]]:
    """Let all contenders take a turn in each of `repeats` rounds, after a first call whose result is `check`ed.

    Nothing is timed before all are checked. Returns the times, and why the others failed in their first call.
    """
    firsts, failed = {}, {}
    for name, run in contenders.items():
        start = time.perf_counter()
        with record_compilations() as compiling:
            try:
                found = jax.block_until_ready(run())
            except Exception as error:
                failed[name] = f"{type(error).__name__}: {str(error)[-300:]}"
                continue
        firsts[name] = time.perf_counter() - start, sum(compiling)
        check(name, found)
        print_progress(f"  {name}: first call {firsts[name][0]:.2f} s")
    turns = time_in_turn(
        [contenders[name] for name in firsts],
        slice_seconds=TURN_SECONDS,
        seconds=0.0,
        rounds=(repeats, repeats),
    )
    timings = zip(firsts, turns, strict=True)
    return {name: timing._replace(first=firsts[name][0], compiling=firsts[name][1]) for name, timing in timings}, failed


def time_imports(modules: Sequence[str], repeats: int) -> dict[str, float]:
    """What importing each module costs in a fresh process, the least of the repeats, taken in turn [s]."""
    seconds = {module: [] for module in modules}
    for _ in range(repeats):
        for module in modules:
            code = f"import time; t = time.perf_counter(); import {module}; print(time.perf_counter() - t)"
            done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True)
            seconds[module].append(float(done.stdout))
    return {module: min(taken) for module, taken in seconds.items()}


def measure_temporary_bytes(function: Wrapped, *arguments: PyTree) -> int:
    """Memory that a compiled function needs besides its arguments and results [bytes]."""
    return function.lower(*arguments).compile().memory_analysis().temp_size_in_bytes


def describe_machine() -> dict[str, Any]:
    """The machine: device, processor, cores this process may use, load, versions, flags."""
    device = jax.devices()[0]
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    return {
        "when": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "backend": jax.default_backend(),
        "device": device.device_kind,
        "processor": _read_cpuinfo("model name") or platform.processor() or platform.machine(),
        "avx512": has_avx512(),
        "cores": os.cpu_count(),
        "cores_used": len(cores) if cores else None,
        "affinity": cores,
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {"physjax": physjax.__version__}
        | {name: found for name in PACKAGES if (found := _find_version(name))},
        "compiler": _find_compiler(),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


def format_caption(about: Mapping[str, Any]) -> str:
    """The machine in a line."""
    what = about["processor"] if about["backend"] == "cpu" else f"{about['device']}, host {about['processor']}"
    used = f"{about['cores_used']} of {about['cores']} cores" if about["cores_used"] else f"{about['cores']} cores"
    return f"{what}, {used}; jax {jax.__version__}, Python {about['python']}, {about['when']}"


def has_avx512() -> bool:
    """Whether the processor has 512-bit vectors."""
    return "avx512f" in (_read_cpuinfo("flags") or "").split()


def parse_options(about: str | None) -> tuple[bool, Path]:
    """The command line: whether to be quick, and the folder of the results, tried before the work."""
    given = parse_arguments(build_parser(about))
    return given.quick, given.out


def build_parser(about: str | None) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes: shows that everything runs, and little else")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="DIR", help="where results go (%(default)s)")
    return parser


def parse_arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The parsed arguments; the folder of the results has been tried."""
    given = parser.parse_args()
    try:
        given.out = ensure_writable_folder(given.out)
    except OSError as error:
        parser.error(str(error))
    return given


def result_path(folder: Path, name: str, quick: bool, ending: str) -> Path:
    """`<name>-<device>-jax<version>.<ending>`; a quick run, which measures nothing, is marked as such."""
    device = re.sub(r"[^a-z0-9]+", "-", jax.devices()[0].device_kind.lower()).strip("-")
    return folder / f"{name}-{device}-jax{jax.__version__}{'-quick' if quick else ''}.{ending}"


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """The record as a file that is whole or absent."""
    with write_atomically(path) as file:
        json.dump(record, file, indent=1, ensure_ascii=False)
        file.write("\n")


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
    """A table whose first column is text and whose others are numbers."""
    cells = [[cell if isinstance(cell, str) else f"{cell:.4g}" for cell in row] for row in rows]
    print(f"\n{title}\n{textwrap.indent(format_table(head, cells), '  ')}")


def make_row(name: str, family: str, work: float, timing: Timing) -> dict[str, Any]:
    """A contender's result: its rate in units of `work` a second, the best and the median, and all its times [s]."""
    return {
        "name": name,
        "family": family,
        "rate": work / timing.least,
        "median_rate": work / timing.median,
        "first_call_s": timing.first,
        "compile_s": timing.compiling,
        "cores": timing.cores,
        "seconds": timing.seconds,
        "busy_seconds": timing.busy,
    }


def print_rates(title: str, unit: str, rows: Sequence[Mapping[str, Any]], ours: str) -> None:
    """Contenders by rate, how many times faster `ours` is than each, cores in use, and what the first call cost.

    One core should read 1; less means that something else had the machine, and short calls then gain on long ones.
    """
    own = next(row["rate"] for row in rows if row["name"] == ours)
    lines = [
        [
            row["name"],
            row["rate"],
            row["median_rate"],
            own / row["rate"],
            row["cores"],
            row["first_call_s"],
            row["compile_s"],
        ]
        for row in sorted(rows, key=lambda row: -row["rate"])
    ]
    head = ["", "best", "median", f"{ours} / it", "cores", "first call [s]", "XLA compile [s]"]
    print_table(f"{title} [{unit}]", head, lines)


def print_bars(bars: Sequence[Bar], quick: bool) -> None:
    """Each bar, what was measured, and whether it is met."""
    verdicts = ["-" if quick else "met" if bar.met else "MISSED" for bar in bars]
    lines = [
        [bar.name, bar.measured, f"{bar.relation} {bar.wanted:g}", verdict]
        for bar, verdict in zip(bars, verdicts, strict=True)
    ]
    print_table("Bars" + (", not judged in a quick run" if quick else ""), ["", "measured", "wanted", ""], lines)


def draw_bar_chart(
    path: Path,
    panels: Sequence[tuple[str, str, Sequence[Mapping[str, Any]]]],
    foot: str,
    labels: Mapping[str, str] | None = None,
) -> None:
    """Horizontal bars on a logarithmic axis: a panel is (title, axis label, rows as made by `make_row`).

    Bars are the best of the turns, ticks their median. `labels` say what the families mean where it is not
    their own name. The file is whole or absent.
    """
    from matplotlib.figure import Figure  # no pyplot: no display and no global state
    from matplotlib.patches import Patch
    from matplotlib.ticker import FuncFormatter, NullFormatter

    counts = [len(rows) for _, _, rows in panels]
    figure = Figure(figsize=(10.5, 1.9 + 0.36 * sum(counts) + 0.6 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, height_ratios=counts, squeeze=False)[:, 0]
    for axis, (title, label, rows) in zip(axes, panels, strict=True):
        rows = sorted(rows, key=lambda row: row["rate"])
        names, best = [row["name"] for row in rows], [row["rate"] for row in rows]
        axis.barh(names, best, color=[COLOURS[row["family"]] for row in rows], height=0.72)
        axis.scatter([row["median_rate"] for row in rows], names, marker="|", s=90, color="black", zorder=3)
        axis.set_xscale("log")
        axis.set_xlim(10 ** math.floor(math.log10(min(best) / 1.2)), max(best) * 2.2)
        axis.bar_label(axis.containers[0], labels=[_format_rate(value) for value in best], fontsize=9, padding=3)
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_title(title, loc="left", fontsize=11)
        axis.set_xlabel(label)
        axis.tick_params(axis="y", length=0)
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="x", which="major", alpha=0.3)
        axis.set_axisbelow(True)
    keys = [Patch(color=colour, label=(labels or {}).get(family, family)) for family, colour in COLOURS.items()]
    figure.legend(handles=keys, loc="outside upper right", ncols=len(keys), frameon=False)
    figure.supxlabel(f"{foot}\nbar: best of the turns, tick: their median", fontsize=8, x=0.01, ha="left")
    with write_atomically(path, "wb") as file:
        figure.savefig(file, format="png", dpi=150)


def print_progress(what: str) -> None:
    """Progress, on standard error, so that it stays apart from the results."""
    print(what, file=sys.stderr, flush=True)


def _format_rate(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _read_cpuinfo(field: str) -> str | None:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return None
    found = re.search(rf"^{field}\s*:\s*(.*)$", text, re.MULTILINE)
    return found[1].strip() if found else None


def _find_version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _find_compiler() -> str | None:
    try:
        return subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]
    except (OSError, subprocess.CalledProcessError, IndexError):
        return None
