"""The README is short, its names and files exist, every block of it runs by itself, and its table says what methods promise."""

import os
import re
import subprocess
from pathlib import Path

import jax
import pytest
from matplotlib import pyplot as plt

import physjax
from physjax import methods

ROOT = Path(physjax.__file__).parent.parent
README = ROOT / "README.md"
TEXT = README.read_text(encoding="utf-8") if README.exists() else ""
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = re.findall(r"```\n *(\S.*)\n *```", TEXT)
QUOTED = set(re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", TEXT, flags=re.DOTALL)))
pytestmark = pytest.mark.skipif(not TEXT, reason="an installed package has no README")


def test_it_is_read_in_ten_minutes():
    assert 1000 < len(TEXT.split()) <= 1800


def test_what_it_links_to_and_shows_is_here():
    links = set(re.findall(r"\]\(([^)#]+)\)", TEXT)) - {"benchmarks/README.md"}  # written by the benchmarks
    assert len(links) > 10
    assert [link for link in links if not (ROOT / link).exists()] == []
    assert (ROOT / "benchmarks/results/pictures/physjax.gif").stat().st_size < 1.5e6


def test_every_name_of_the_package_it_mentions_exists():
    heads = {name for name in physjax.__all__ if name.islower()}
    names = {name.partition("(")[0] for name in QUOTED}
    dotted = {name for name in names if re.fullmatch(r"\w+\.\w+", name) and name.partition(".")[0] in heads}
    assert len(dotted) >= 3
    assert [name for name in dotted if not hasattr(getattr(physjax, name.split(".")[0]), name.split(".")[1])] == []


def test_its_commands_make_an_environment_of_their_own_and_the_one_under_test_comes_first():
    assert len(COMMANDS) == 3
    assert all(command.startswith("python3 -m venv .venv && .venv/bin/pip install -q ") for command in COMMANDS)
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (find,) = re.findall(r"command=\$\((.*)\)", script)
    found = subprocess.run(["bash", "-c", find], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip().endswith(".venv/bin/pytest")


def test_its_table_of_methods_is_the_registry():
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (\d+)[^|]* \| (\S+) \|", TEXT, re.MULTILINE)
    limit = lambda promised: "∞" if promised == float("inf") else f"{promised:.3g}"  # noqa: E731
    promised = {name: method.promises for name, method in methods.list_all_methods().items()}
    assert {name: tuple(row) for name, *row in rows} == {
        name: (str(p.order), str(p.evaluations), limit(p.stability_limit)) for name, p in promised.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_every_block_runs_by_itself(number, tmp_path, monkeypatch):
    """As users have it: with 64-bit types off, and promotion allowed."""
    monkeypatch.chdir(tmp_path)
    plain = jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow")
    with plain[0], plain[1], plain[2]:
        exec(compile(BLOCKS[number], f"block {number} of the README", "exec"), {})
    assert plt.get_fignums() or os.listdir(tmp_path) or "explore(" in BLOCKS[number]
    plt.close("all")
