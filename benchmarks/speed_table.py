"""The table of speed in the README of the project, from the newest results file of each study."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

README = Path(__file__).resolve().parents[1] / "README.md"
BEGIN, END = "<!-- speed: written by `python -m benchmarks report` -->\n", "<!-- end of speed -->\n"
"""What the table stands between."""


def find_newest(results: Mapping[str, Mapping], study: str) -> Mapping[str, Any]:
    """The newest full results of a study."""
    found = [record for record in results.values() if record.get("benchmark") == study and not record.get("quick")]
    return max(found, key=lambda record: record["machine"]["when"])


def write_speed_table(results: Mapping[str, Mapping]) -> str:
    """A row for each kind of scene: how fast physjax is, and others that were measured beside it."""
    throughput, contact, rigid, aim, gpu, stacks = (
        find_newest(results, name) for name in ("throughput", "contact", "rigid", "aim", "gpu", "stacks")
    )
    flights = {row["name"]: row["rate"] for row in throughput["projectiles"]}
    bounces = _pick(contact["studies"], method="rk4", case="restitution 0.8")["runs"]
    boxes = {row["name"]: row["rate"] for row in _pick(rigid["studies"], law="RK4")["runs"]}
    arcs = {bar["name"]: bar["measured"] for bar in aim["bars"]}
    others = "C with AVX-512 {}, numba {}, diffrax {} to {}, Warp {}".format(
        *(_format(flights[_match(flights, name)]) for name in ("C, AVX-512", "numba")),
        *(_format(pick(rate for name, rate in flights.items() if name.startswith("diffrax"))) for pick in (min, max)),
        _format(flights[_match(flights, "Warp")]),
    )
    lanes = lambda record: _group(record["settings"]["lanes"])  # noqa: E731
    event = _format(arcs["aim_at: times faster than the event"])
    worlds, speed = stacks["worlds"], _format(stacks["speeds"]["4"]["median"] / 1e6)
    return _join(
        (
            f"{lanes(throughput)} projectiles with drag, rk4",
            f"{_format(flights['physjax rk4'])} million steps/s",
            others,
        ),
        ("ten million of them on an H200", f"{_read_gpu(gpu, '10,000,000 projectiles')} billion steps/s", ""),
        (
            f"{lanes(contact)} balls over a floor, impacts timed",
            f"{_format(_pick(bounces, name='impact')['rate'])} million steps/s",
            f"without a floor {_format(_pick(bounces, name='no contact')['rate'])}",
        ),
        (
            f"{lanes(rigid)} tumbling boxes, rk4",
            f"{_format(boxes['physjax'])} million steps/s",
            f"MuJoCo MJX {boxes['MJX']:.2f}",
        ),
        (f"boxes in {worlds} stacks of ten, with friction, four sub-steps", f"{speed} million steps/s", ""),
        (
            f"both arcs to {_group(aim['settings']['targets'])} targets, float64",
            f"{arcs['aim_at: seconds for all targets, both arcs']:.2f} s",
            f"diffrax with optimistix {event} times as long",
        ),
        ("a cloth of 512² nodes on an H200", f"{_read_gpu(gpu, 'a cloth of 512²')} billion node steps/s", ""),
    )


def replace_speed_table(page: str, results: Mapping[str, Mapping]) -> str:
    """The README with the table of these results in it."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + write_speed_table(results) + END + after


def _join(*rows: tuple[str, str, str]) -> str:
    lines = [("", "physjax", "others"), ("---", "---", "---"), *rows]
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


def _pick(rows: Iterable[Mapping], **wanted: str) -> Mapping[str, Any]:
    return next(row for row in rows if all(row[key] == value for key, value in wanted.items()))


def _match(rates: Mapping[str, float], begin: str) -> str:
    return next(name for name in rates if name.startswith(begin))


def _read_gpu(gpu: Mapping[str, Any], begin: str) -> str:
    study = next(study for study in gpu["studies"] if study["title"].startswith(begin))
    return _format(study["rows"][0]["rate"])


def _group(count: int) -> str:
    return f"{count:,}".replace(",", " ") if count >= 10_000 else str(count)


def _format(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
