"""Results as text: aligned tables, times with a readable unit, progress, and the machine that numbers were measured on."""

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from physjax.backend import describe_device

BYTE_UNITS = ("B", "kB", "MB", "GB", "TB", "PB")
"""Each a thousand of the one before."""


def format_table(headers: Sequence[str], rows: Sequence[Sequence[str]], *, align: str | None = None) -> str:
    """Columns aligned by `align`, a `<` or `>` for each; the first to the left and the others to the right by default."""
    align = align or "<" + ">" * (len(headers) - 1)
    widths = [max(len(str(row[i])) for row in (headers, *rows)) for i in range(len(headers))]

    def line(cells):
        return "  ".join(
            f"{cell!s:{side}{width}}" for cell, side, width in zip(cells, align, widths, strict=True)
        ).rstrip()

    return "\n".join([line(headers), "  ".join("-" * width for width in widths), *map(line, rows)])


def progress_bar(items: Any = None, *, progress: bool = True, **options: Any) -> Any:
    """A bar of tqdm around what is done one after the other, on standard error; not in notebooks, which show that in red."""
    from tqdm import tqdm

    stream = sys.stdout if "ipykernel" in sys.modules else sys.stderr
    return tqdm(items, file=stream, disable=not progress, **options)


def format_seconds(seconds: int | float) -> str:
    """A time with a unit that keeps it readable, from µs to days."""
    for unit, size in (("d", 86400.0), ("s", 1.0), ("ms", 1e-3)):
        if float(f"{seconds / size:.3g}") >= 1:  # as it is printed
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def format_bytes(count: int) -> str:
    """An amount of memory with three digits, e.g. "4.8 TB"."""
    power = min(max(0, (len(str(count)) - 1) // 3), len(BYTE_UNITS) - 1)
    return f"{count / 1000**power:.3g} {BYTE_UNITS[power]}"


def describe_machine() -> str:
    """One line about where numbers were measured: device, processor, versions."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "diffrax", "numpy"))
    return f"{describe_device()}, Python {sys.version.split()[0]}, {versions}"
