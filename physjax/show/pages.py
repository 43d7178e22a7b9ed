"""HTML pages made from the templates that the package ships in web/: they fetch nothing, and play in any browser."""

import os
from collections.abc import Iterable
from functools import cache
from importlib import resources
from pathlib import Path

from physjax.files import write_atomically


@cache
def read_web_file(name: str) -> str:
    """A text file of the folder web/."""
    return (resources.files("physjax.show") / "web" / name).read_text(encoding="utf-8")


def fill_page(name: str, **parts: object) -> str:
    """A template of web/ with the buttons of tools.html, the program of data.js and the colours of colors.css.

    Each `__PART__` is replaced by its content.
    """
    page = read_web_file(name).replace("__TOOLS__", read_web_file("tools.html"))
    page = page.replace("__DATA__", read_web_file("data.js")).replace("__COLORS__", read_web_file("colors.css"))
    for part, content in parts.items():
        page = page.replace(f"__{part}__", str(content))
    return page


def check_output_path(path: str | os.PathLike, endings: Iterable[str]) -> Path:
    """The path, if its name has one of the endings and its folder is there; ValueError or FileNotFoundError otherwise."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise ValueError(f"save: got {path.name}, expected a name that ends in {' or '.join(endings)}.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist. Create it first.")
    return path


def write_page(path: Path, page: str) -> Path:
    """Write a page whole or not at all; returns its path."""
    with write_atomically(path) as file:
        file.write(page)
    return path
