"""Writes README.md, its charts and the project's table of speed from the results files alone: `python -m benchmarks report`.

Nothing of JAX is imported, so that a test can hold the page to the files.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from speed_table import README, replace_speed_table

FOLDER = Path(__file__).resolve().parent
RESULTS, PAGE = FOLDER / "results", FOLDER / "README.md"
CLAIM = 3.0
"""How many times as fast physjax is meant to be as any peer."""
ORDER = ("projectile", "bounce", "bodies", "sheet", "spin", "slide", "tower")
"""Workloads with all five measures, in the order of the page."""

HEAD = """# Benchmarks

This page is written by `python -m benchmarks report` from the files in `results/`; a test fails where the two differ.

    pip install -e '.[bench]'
    python -m benchmarks --quick --peers     # all workloads at one size each
    python -m benchmarks --peers             # all sizes; what is finished on this machine is skipped, --again measures anew
    python -m benchmarks bounce --peers      # one workload
    python -m benchmarks counts [--update]   # operations, bytes, concatenates, scatters of typical programs
    python -m benchmarks --help              # everything that there is

Every workload is the same problem for physjax and its peers, each written as its documentation recommends. Five measures:
how far the answer is from a truth in float64 (*forward*); how far a derivative, along three directions, is from central
differences of that truth (*gradient*); up to how many steps both stay within 1 % (*holds*); what a forward run and one with its
gradient cost (*cost*); and whether a peer does the work at all (*runs*). Contenders take turns in one process; the first call,
which compiles, is a figure of its own. Times are the least of the turns, and their median in brackets. *times* is the peer's
least time divided by physjax's: above 1 physjax is faster.
"""


def read_results(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Every results file by its name."""
    return {file.stem: json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))}


def pick_workload(results: Mapping[str, dict], name: str) -> list[dict]:
    """The full results of a workload, one for each machine and version; the quick ones where there are no others."""
    found = [record for record in results.values() if record.get("workload") == name]
    return [record for record in found if not record["quick"]] or found


def build_page(results: Mapping[str, dict]) -> str:
    """The whole page."""
    parts = [HEAD]
    for name in ORDER:
        parts += [write_workload(record) for record in pick_workload(results, name)]
    parts += [write_lorenz(record) for record in pick_workload(results, "lorenz")]
    parts += [write_scenes(record) for record in pick_workload(results, "peer_scenes")]
    parts += [write_scaling(record) for record in pick_workload(results, "scaling")]
    return "\n".join([*parts, write_studies(results)])


def write_workload(record: Mapping[str, Any]) -> str:
    """A section with the errors, the costs, and what they come to in words."""
    rows = record["rows"]
    title = f"## {record['workload']}{', quick run' if record['quick'] else ''}\n"
    truth = f"{record['about']} The truth: {record['exact']}.\n"
    head = ["", "runs", f"forward [{record['unit']}]", "gradient, relative", "holds [steps]", "written as"]
    errors = write_table(head, [describe_errors(rows, peer) for peer in list_names(rows)])
    parts = [title, truth, write_machine(record), errors]
    for size in list_sizes(rows):
        parts.append(write_costs([row for row in rows if row["measure"] == "cost" and get_size(row) == size], size))
    return "\n".join(parts)


def describe_errors(rows: Sequence[Mapping], peer: str) -> list[str]:
    """What a peer's row of the table of errors says."""
    own = {row["measure"]: row for row in rows if row["peer"] == peer and row["measure"] != "cost"}
    runs, horizon = own["runs"], own.get("horizon")
    if not runs["ok"]:
        return [peer, "no" if runs["ok"] is False else "-", "", "", "", runs["why"]]
    slope = format_number(own["gradient"]["error"]) if "gradient" in own else "none"
    holds = "" if horizon is None else f"{horizon['held']} of {horizon['tried']}"
    why = f"; gradient: {runs['why']}" if runs.get("why") else ""
    return [peer, "yes", format_number(own["forward"]["error"]), slope, holds, runs["how"] + why]


def write_costs(rows: Sequence[Mapping], size: tuple[int, int], title: str = "") -> str:
    """A table of costs at one size, and its meaning in words."""
    lines, words = [], []
    names = list_names(rows)
    for name in names:
        cells = [name]
        for of in ("forward", "gradient"):
            cells += describe_cost(rows, name, of, names[0])
        lines.append(cells)
    for of in ("forward", "gradient"):
        words += [word for word in [judge_costs(rows, of, names[0])] if word]
    head = ["", "forward [ms]", "times", "first call [s]", "gradient [ms]", "times", "first call [s]"]
    caption = f"{title}{size[0]:,} lanes, {size[1]:,} steps:\n"
    return "\n".join([caption, write_table(head, lines), " ".join(words) + "\n"])


def find_cost(rows: Iterable[Mapping], name: str, of: str) -> Mapping | None:
    """The cost of a peer, where it was measured."""
    return next((row for row in rows if row["peer"] == name and row["of"] == of and "least_s" in row), None)


def describe_cost(rows: Sequence[Mapping], name: str, of: str, ours: str) -> list[str]:
    """Time, ratio and first call of a peer."""
    row, own = find_cost(rows, name, of), find_cost(rows, ours, of)
    if row is None:
        failed = any(r["peer"] == name and r["of"] == of and "failed" in r for r in rows)
        return ["failed" if failed else "", "", ""]
    times = "" if own is None or name == ours else format_number(row["least_s"] / own["least_s"])
    taken = f"{format_number(1e3 * row['least_s'])} ({format_number(1e3 * row['median_s'])})"
    return [taken, times, format_number(row["first_call_s"])]


def judge_costs(rows: Sequence[Mapping], of: str, ours: str) -> str:
    """How physjax compares with the fastest peer, by medians, in words."""
    own = find_cost(rows, ours, of)
    others = {row["peer"]: row["median_s"] for row in rows if row["of"] == of and "median_s" in row}
    others = {name: seconds for name, seconds in others.items() if not name.startswith("physjax")}
    if own is None or not others:
        return ""
    name, seconds = min(others.items(), key=lambda item: item[1])
    ratio = seconds / own["median_s"]
    kind = "Forward" if of == "forward" else "With its gradient"
    if ratio >= CLAIM:
        return f"{kind}, physjax is {format_number(ratio)} times as fast as the fastest peer, {name}."
    if ratio >= 1:
        return f"{kind}, **physjax is not ahead by {CLAIM:g}**: {format_number(ratio)} times as fast as {name}."
    return f"{kind}, **physjax is behind**: {name} is {format_number(1 / ratio)} times as fast."


def write_lorenz(record: Mapping[str, Any]) -> str:
    """The ensemble: errors, then times by lanes, for both of its parts."""
    parts = [f"## lorenz{', quick run' if record['quick'] else ''}\n", record["about"] + "\n", write_machine(record)]
    for part in ("fixed", "adaptive"):
        rows = [row for row in record["rows"] if row.get("part") == part]
        errors = [[r["peer"], format_number(r["error"])] for r in rows if r["measure"] == "forward"]
        title = "1000 equal steps" if part == "fixed" else "error control at 1e-8"
        parts += [f"### {title}\n", write_table(["", "largest error"], errors)]
        for size in list_sizes(rows):
            parts.append(write_costs([r for r in rows if r["measure"] == "cost" and get_size(r) == size], size))
    return "\n".join(parts)


def write_scenes(record: Mapping[str, Any]) -> str:
    """What physjax's figure is beside the tolerance that a peer allows itself."""
    lines = []
    for row in record["rows"]:
        if "failed" in row:
            lines.append([row["scene"], row["about"], "failed", "", row["failed"]])
            continue
        allowed = "none stated" if row["allowed"] is None else format_number(row["allowed"])
        lines.append([row["scene"], row["quantity"], format_number(row["error"]), allowed, row["source"]])
    head = ["scene", "quantity", "physjax", "the peer allows", "whose test"]
    return "\n".join(
        ["## Peers' own test scenes\n", record["about"] + "\n", write_machine(record), write_table(head, lines)]
    )


def write_scaling(record: Mapping[str, Any]) -> str:
    """Charts, and the numbers in them."""
    rows = record["rows"]
    pick = lambda measure: [row for row in rows if row["measure"] == measure]  # noqa: E731
    lanes = [[f"{r['lanes']:,}", r["peer"], format_number(r["rate"] / 1e6)] for r in pick("lanes")]
    steps = [
        [f"{r['steps']:,}", r["peer"], format_number(r["least_s"]), format_number(r["temporary_bytes"] / 2**20)]
        for r in pick("steps")
    ]
    scenes = [[r["scene"], format_number(r["first_call_s"]), format_number(r["compile_s"])] for r in pick("compile")]
    name = name_chart(record)
    return "\n".join(
        [
            f"## How cost grows{', quick run' if record['quick'] else ''}\n",
            f"![Throughput by lanes, time and memory of a gradient by steps, first run by scene](results/{name})\n",
            write_machine(record),
            write_table(["lanes", "", "million steps a second"], lanes),
            write_table(["steps of 64 lanes", "", "gradient [s]", "temporary memory [MiB]"], steps),
            write_table(["scene", "first run [s]", "of it XLA [s]"], scenes),
        ]
    )


def name_chart(record: Mapping[str, Any]) -> str:
    """The chart of a scaling record."""
    about = record["machine"]
    quick = "-quick" if record["quick"] else ""
    return f"scaling-{about['device'].lower().replace(' ', '-')}-jax{about['versions']['jax']}{quick}.png"


def write_studies(results: Mapping[str, dict]) -> str:
    """Every bar of every study, whether it is met or not."""
    lines = []
    for name, record in results.items():
        for bar in record.get("bars", []) if "workload" not in record else []:
            wanted = f"{bar['relation']} {bar['wanted']:g}"
            lines.append([name, bar["name"], format_number(bar["measured"]), wanted, "yes" if bar["met"] else "**no**"])
    head = ["results", "what", "measured", "wanted", "met"]
    about = (
        "Studies of one question each, `python -m benchmarks NAME`: what each wants of itself, and what was measured.\n"
    )
    return "\n".join(["## Studies\n", about, write_table(head, lines)])


def write_machine(record: Mapping[str, Any]) -> str:
    """Where and when, with which versions, and how busy the machine was with other work."""
    about = record["machine"]
    names = ("jax", "diffrax", "warp-lang", "taichi", "mujoco-mjx", "numba", "rebound", "numpy")
    versions = ", ".join(f"{name} {about['versions'][name]}" for name in names if name in about["versions"])
    load = [format_number(about[key][0]) for key in ("load_average", "load_average_after") if about.get(key)]
    busy = f"load average {' before and '.join(load)} after: shared with other work" if load else "load not known"
    where = f"{about['processor']}, {about['cores_used'] or about['cores']} cores"
    return f"*{where}, {busy}; Python {about['python']}, {versions}; {about['when']}.*\n"


def write_table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    rule = "|".join("---" for _ in head)
    body = [f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in [head, *lines]]
    return "\n".join([body[0], f"|{rule}|", *body[1:], ""])


def list_names(rows: Iterable[Mapping]) -> list[str]:
    """Peers, physjax first, in the order of their rows."""
    return sorted(dict.fromkeys(row["peer"] for row in rows), key=lambda name: name != "physjax")


def list_sizes(rows: Iterable[Mapping]) -> list[tuple[int, int]]:
    """Sizes that were timed."""
    return list(dict.fromkeys(get_size(row) for row in rows if row["measure"] == "cost"))


def get_size(row: Mapping) -> tuple[int, int]:
    """Lanes and steps of a row."""
    return row["lanes"], row["steps"]


def format_number(value: float | None) -> str:
    """Three figures."""
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    """Write the page, and the charts."""
    from charts import draw_scaling

    results = read_results()
    for record in pick_workload(results, "scaling"):
        draw_scaling(RESULTS / name_chart(record), record)
    PAGE.write_text(build_page(results))
    README.write_text(replace_speed_table(README.read_text(), results))
    print(f"written: {PAGE} and the table of speed in {README}")


if __name__ == "__main__":
    main()
