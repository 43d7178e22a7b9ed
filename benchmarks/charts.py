"""The charts of the page, drawn from results files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

COLOURS = {"physjax": "#0072B2", "diffrax": "#E69F00"}


def draw_scaling(path: Path, record: Mapping[str, Any]) -> None:
    """Throughput by lanes, time and memory of a gradient by steps, and first runs by scene."""
    figure = Figure(figsize=(14.0, 4.2), layout="constrained")
    lanes, seconds, memory, scenes = figure.subplots(1, 4)
    rows = record["rows"]
    pick = lambda measure: [row for row in rows if row["measure"] == measure]  # noqa: E731
    _draw_lines(lanes, pick("lanes"), "lanes", lambda r: r["rate"] / 1e6)
    lanes.set(xlabel="lanes", ylabel="million steps per second", title="projectiles with drag")
    _draw_lines(seconds, pick("steps"), "steps", lambda r: r["least_s"])
    seconds.set(xlabel="steps", ylabel="time [s]", title="gradient of 64 projectiles")
    _draw_lines(memory, pick("steps"), "steps", lambda r: r["temporary_bytes"] / 2**20)
    memory.set(xlabel="steps", ylabel="temporary memory [MiB]", title="its memory")
    _draw_scenes(scenes, pick("compile"))
    about = record["machine"]
    foot = f"{about['processor']}, jax {about['versions']['jax']}, {about['when']}, load average {about['load_average'][0]:.1f}"
    figure.supxlabel(foot, fontsize=8, x=0.01, ha="left")
    figure.savefig(path, dpi=130)


def _draw_lines(axis: Any, rows: Sequence[Mapping], by: str, value: Any) -> None:
    for name in dict.fromkeys(row["peer"] for row in rows):
        own = [row for row in rows if row["peer"] == name]
        axis.loglog([r[by] for r in own], [value(r) for r in own], "o-", color=COLOURS[name], label=name)
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)


def _draw_scenes(axis: Any, rows: Sequence[Mapping]) -> None:
    names, first = [row["scene"] for row in rows], [row["first_call_s"] for row in rows]
    axis.barh(names, first, color=COLOURS["physjax"], alpha=0.4, label="first run")
    axis.barh(names, [row["compile_s"] for row in rows], color=COLOURS["physjax"], height=0.4, label="of it XLA")
    axis.invert_yaxis()
    axis.set(xlabel="time [s]", title="a new scene")
    axis.legend(frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
