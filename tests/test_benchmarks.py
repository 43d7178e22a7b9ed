"""What the benchmarks claim is in their results files, and their measures see what is wrong."""

import importlib
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def load():
    """Modules of the benchmarks, which are scripts beside each other."""
    path, cached = list(sys.path), jax.config.jax_enable_compilation_cache
    sys.path.insert(0, str(ROOT / "benchmarks"))
    yield importlib.import_module
    sys.path[:] = path
    jax.config.update("jax_enable_compilation_cache", cached)  # which `harness` has switched off


def test_the_page_is_what_its_results_files_say(load):
    report = load("report")
    assert report.PAGE.read_text() == report.build_page(report.read_results())


def test_the_table_of_speed_is_what_the_newest_results_say(load):
    table, results = load("speed_table"), load("report").read_results()
    page = table.README.read_text()
    assert page == table.replace_speed_table(page, results)
    shown = page.partition("## Speed")[2].partition("## ")[0]
    assert shown.count(table.write_speed_table(results)) == 1
    assert len(re.findall(r"\d", shown.partition(table.BEGIN)[0])) <= 2  # float32: no figure beside the table
    newest = table.find_newest(results, "aim")["machine"]["when"]
    assert newest == max(r["machine"]["when"] for r in results.values() if r.get("benchmark") == "aim")
    faster = {name: dict(r, bars=[dict(bar, measured=7.0) for bar in r.get("bars", [])]) for name, r in results.items()}
    assert page != table.replace_speed_table(page, faster)


def test_every_results_file_that_a_page_names_is_there():
    for page in (ROOT / "README.md", ROOT / "benchmarks" / "README.md"):
        names = re.findall(r"(?:benchmarks/)?results/[\w./-]+\.(?:json|png)", page.read_text())
        missing = [name for name in names if not (ROOT / "benchmarks" / name.removeprefix("benchmarks/")).exists()]
        assert not missing, f"{page} names {missing}"


def test_the_page_says_in_words_where_physjax_is_not_ahead(load):
    report = load("report")

    def judge(seconds):
        rows = [{"peer": name, "of": "forward", "least_s": s, "median_s": s} for name, s in seconds.items()]
        return report.judge_costs(rows, "forward", "physjax")

    assert "physjax is behind**: other is 2 times as fast" in judge({"physjax": 2.0, "other": 1.0, "third": 9.0})
    assert "not ahead by 3**: 1.5 times" in judge({"physjax": 2.0, "other": 3.0})
    assert judge({"physjax": 1.0, "other": 4.0}) == "Forward, physjax is 4 times as fast as the fastest peer, other."


@pytest.fixture(scope="module")
def work(load):
    """A fall whose truth is a parabola, for one who is right, one whose gradient is wrong, and one who fails in the end."""
    measures = load("measures")
    start = lambda size: np.arange(3.0 * size.lanes).reshape(size.lanes, 3)  # noqa: E731

    def follow(size, velocity):
        t = 0.01 * size.steps
        return t * velocity - np.array([0.0, 4.9, 0.0]) * t**2

    def build(slope, worst, size):
        off = worst * (size.steps > 100)
        gradient = lambda: np.broadcast_to(slope * 0.01 * size.steps * np.array([1.0, 2.0, 3.0]), (size.lanes, 3))  # noqa: E731
        return measures.Run(lambda: follow(size, start(size)) + off, gradient)

    def list_peers():
        for name, slope, worst in (("physjax", 1.0, 0.0), ("tilted", 1.1, 0.0), ("late", 1.0, 0.5)):
            yield measures.Peer(name, "physjax", "", lambda size, s=slope, w=worst: build(s, w, size))

    size = measures.Size(2, 50)
    return measures.Workload(
        "fall", "", "", "m", 1.0, start, follow, list_peers, checked=size, horizons=(50, 100, 200), costs=(size,)
    )


def test_measures_see_a_wrong_gradient_and_where_an_answer_ends(load, work):
    measures = load("measures")
    able, _ = measures.find_peers(work, peers=True, slow=False)
    rows = {(r["peer"], r["measure"]): r for r in measures.measure_errors(work, able, work.horizons)}
    assert rows["physjax", "forward"]["error"] == 0.0
    assert rows["physjax", "gradient"]["error"] < 1e-9
    assert rows["tilted", "gradient"]["error"] == pytest.approx(0.1, rel=1e-6)
    assert [rows[name, "horizon"]["held"] for name in ("physjax", "tilted", "late")] == [200, 0, 100]


def test_a_finished_workload_is_this_machines_and_has_the_peers_that_are_asked_for(load, tmp_path):
    suite, harness = load("suite"), load("harness")
    path = tmp_path / "fall.json"
    assert suite.find_finished(path, peers=False) is None
    machine = harness.describe_machine()
    harness.write_json(path, {"workload": "fall", "peers": False, "machine": machine})
    assert suite.find_finished(path, peers=False) == machine["when"]
    assert suite.find_finished(path, peers=True) is None
    harness.write_json(path, {"workload": "fall", "peers": True, "machine": machine | {"processor": "another"}})
    assert suite.find_finished(path, peers=True) is None


def test_no_workload_has_the_name_of_a_study_whose_results_it_would_overwrite(load):
    studies = {file.stem for file in (ROOT / "benchmarks").glob("*.py")}
    assert not studies & {*load("suite").WORKLOADS}


def test_the_adapter_has_the_derivatives_of_differences(load):
    adapter = load("adapter")
    velocity, area = np.array([[30.0, 20.0], [10.0, 5.0]]), np.array(4.3e-3)
    inputs, cotangent = {"velocity": velocity, "area": area}, {"position": np.array([[1.0, -2.0], [0.5, 3.0]])}
    found = adapter.vector_jacobian_product(inputs, ["velocity", "area"], ["position"], cotangent)
    value = lambda given: (adapter.apply(given)["position"] * cotangent["position"]).sum()  # noqa: E731
    by_area = (value(inputs | {"area": area + 1e-6}) - value(inputs | {"area": area - 1e-6})) / 2e-6
    step = np.array([[1e-3, 0.0], [0.0, 0.0]])
    by_speed = (value(inputs | {"velocity": velocity + step}) - value(inputs | {"velocity": velocity - step})) / 2e-3
    np.testing.assert_allclose([found["area"], found["velocity"][0, 0]], [by_area, by_speed], rtol=1e-6)
    with pytest.raises(ValueError, match="got 'mass', expected one of"):
        adapter.vector_jacobian_product(inputs, ["mass"], ["position"], cotangent)
    with pytest.raises(ValueError, match=r"got inputs \['velocity'\]"):
        adapter.apply({"velocity": velocity})
