"""Runs workloads and studies one after the other, each in a process of its own, and skips those that are finished.

A workload is finished where its results file was made on this processor with these versions and flags, and had the peers
that are asked for. `python -m benchmarks --again` measures all the same.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import harness
import measures
from harness import print_progress
from measures import Workload

WORKLOADS = ("projectile", "bounce", "bodies", "sheet", "spin", "slide", "tower", "lorenz", "peer_scenes", "scaling")
"""In the order in which they run."""
SAME = ("backend", "device", "processor", "cores_used", "system", "python", "versions", "XLA_FLAGS")
"""What of a machine makes a result comparable."""
QUICK_REPEATS, REPEATS = 3, 5
LARGE_REPEATS = 3
"""Turns at all sizes but the first, where a call may take ten seconds."""


def run_names(names: list[str], given: argparse.Namespace) -> int:
    """Run each name in a process of its own; the number of those that failed."""
    failed = []
    for count, name in enumerate(names, 1):
        path = harness.result_path(given.out, name, given.quick, "json")
        done = None if given.again else find_finished(path, given.peers)
        if done:
            print_progress(f"[{count}/{len(names)}] {name}: finished on {done}, {path.name}; --again measures anew")
            continue
        print_progress(f"[{count}/{len(names)}] {name}")
        started = time.perf_counter()
        code = subprocess.run(build_command(name, given), cwd=harness.ROOT, check=False).returncode
        took = time.perf_counter() - started
        print_progress(f"[{count}/{len(names)}] {name}: {'failed' if code else 'done'} after {took:.0f} s")
        failed += [name] * bool(code)
    if failed:
        print_progress(f"failed: {', '.join(failed)}")
    return len(failed)


def build_command(name: str, given: argparse.Namespace) -> list[str]:
    """How a workload or a study is started."""
    folder = Path(__file__).parent
    options = ["--out", str(given.out), *(["--quick"] if given.quick else [])]
    if name in WORKLOADS:
        peers = [f"--{name}" for name in ("peers", "slow") if getattr(given, name)]
        return [sys.executable, str(folder / "suite.py"), name, *options, *peers]
    return [sys.executable, str(folder / f"{name}.py"), *options]


def find_finished(path: Path, peers: bool) -> str | None:
    """When the results at a path were made, if they are this machine's and had what is asked for; None otherwise."""
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    here, there = harness.describe_machine(), record.get("machine", {})
    same = all(here.get(key) == there.get(key) for key in SAME)
    asked = "workload" not in record or record["peers"] or not peers
    return there["when"] if same and asked else None


def measure_workload(work: Workload, given: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows of a workload."""
    quick = given.quick
    able, rows = measures.find_peers(work, given.peers, given.slow)
    horizons = work.horizons[: 2 if quick else None]
    print_progress("  errors")
    rows += measures.measure_errors(work, able, horizons)
    runs = {row["peer"] for row in rows if row["measure"] == "runs" and row["ok"]}
    able = [peer for peer in able if peer.name in runs]
    rows += measures.measure_costs(work, able, work.costs[:1], QUICK_REPEATS if quick else REPEATS)
    return rows if quick else rows + measures.measure_costs(work, able, work.costs[1:], LARGE_REPEATS)


def write_record(
    name: str, about: str, rows: list[dict], given: argparse.Namespace, machine: dict, **more: Any
) -> None:
    """The results file of a workload."""
    machine = machine | {"load_average_after": os.getloadavg() if hasattr(os, "getloadavg") else None}
    record = {"schema": measures.SCHEMA, "workload": name, "about": about, "quick": given.quick, "peers": given.peers}
    path = harness.result_path(given.out, name, given.quick, "json")
    harness.write_json(path, record | more | {"machine": machine, "rows": rows})
    print_progress(f"  written: {path}")


def main() -> None:
    """Measure one workload in this process."""
    parser = harness.build_parser(__doc__)
    parser.add_argument("name", choices=WORKLOADS)
    parser.add_argument("--peers", action="store_true", help="with other codes next to physjax")
    parser.add_argument("--slow", action="store_true", help="with peers that take minutes to compile")
    given = harness.parse_arguments(parser)
    machine = harness.describe_machine()
    module = importlib.import_module(f"workloads.{given.name}")
    if hasattr(module, "WORK"):
        work: Workload = module.WORK
        rows = measure_workload(work, given)
        more = {"exact": work.exact, "unit": work.unit, "scale": work.scale}
        write_record(work.name, work.about, rows, given, machine, **more)
    else:
        rows = module.measure(given.quick, given.peers)
        write_record(given.name, " ".join(module.__doc__.split()), rows, given, machine)


if __name__ == "__main__":
    main()
