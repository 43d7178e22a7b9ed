"""The README names files and names that exist, and its code is Python; running all of it takes minutes."""

import ast
import re
from pathlib import Path

import pytest

import physjax

ROOT = Path(physjax.__file__).parent
README = ROOT.parent / "README.md"
TEXT = README.read_text(encoding="utf-8") if README.exists() else ""
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
QUOTED = set(re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", TEXT, flags=re.DOTALL)))
pytestmark = pytest.mark.skipif(not TEXT, reason="an installed package has no README")


def test_every_file_it_names_exists():
    files = {name for name in QUOTED if re.fullmatch(r"[\w./-]+(\.py|/)", name)}
    assert len(files) > 40
    folders = (
        ROOT,
        ROOT.parent,
        ROOT / "stepping",
        ROOT / "study" / "inverse",
        *(ROOT / "physics").iterdir(),
        ROOT / "show",
    )
    assert [name for name in files if not any((folder / name).exists() for folder in folders)] == []


def test_every_name_of_the_package_it_mentions_exists():
    heads = {name for name in physjax.__all__ if name.islower()} | {
        "Scene",
        "Particles",
        "Force",
        "Contact",
        "Trajectory",
    }
    names = {name.partition("(")[0] for name in QUOTED}
    dotted = {name for name in names if re.fullmatch(r"\w+\.\w+", name) and name.partition(".")[0] in heads}
    assert len(dotted) > 40
    missing = []
    for name in dotted:
        head, _, attribute = name.partition(".")
        thing = getattr(physjax, head)
        if (
            attribute != "py"
            and not hasattr(thing, attribute)
            and attribute not in getattr(thing, "__annotations__", {})
        ):
            missing.append(name)
    assert missing == []


def test_every_example_is_python():
    assert len(BLOCKS) >= 13
    for block in BLOCKS:
        ast.parse(block)
