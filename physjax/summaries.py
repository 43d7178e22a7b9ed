"""What a result says of itself: a title and a few rows, as text for a terminal and as a small table for a notebook."""

import dataclasses
import html
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from physjax.checks import concrete_or_none

FIGURES = 4
"""Figures of a number in a summary."""
ENTRIES_SHOWN = 4
"""Arrays of at most this many numbers are written out, longer ones as a range."""

Row = tuple[str, str]
"""What is said, and what of it."""


def write_summary(title: str, rows: Sequence[Row]) -> str:
    """`<title` and a line for each row, aligned, `>`."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([f"<{title}", *(f"  {name:<{width}}  {text}".rstrip() for name, text in rows)]) + ">"


def write_table(title: str, rows: Sequence[Row]) -> str:
    """The same as a table of HTML."""
    cells = "".join(
        f'<tr><th style="text-align:left;font-weight:normal;opacity:.7">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(text)}</td></tr>'
        for name, text in rows
    )
    caption = f'<caption style="text-align:left;font-weight:bold">{html.escape(title)}</caption>'
    return f"<table>{caption}{cells}</table>"


def write_grid(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of HTML with headers."""
    line = lambda cells, tag: "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)  # noqa: E731
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    caption = f'<caption style="text-align:left;font-weight:bold">{html.escape(title)}</caption>'
    return f"<table>{caption}<tr>{line(headers, 'th')}</tr>{body}</table>"


def format_number(value: Any) -> str:
    """A number with four figures, and a true power of ten where it is very large or small."""
    return f"{float(value):.{FIGURES}g}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")


def format_array(value: Any, unit: str = "") -> str:
    """A number with its unit; a few of them; or the range of many. Of what is traced, its type and shape."""
    behind = f" {unit}" if unit else ""
    array = concrete_or_none(value)
    if array is None or array.dtype == object:
        return f"traced {getattr(value, 'dtype', '')}[{','.join(map(str, np.shape(value)))}]{behind}"
    if array.dtype.kind not in "fiub":
        return str(array)
    if array.size == 1:
        return format_number(array.item()) + behind if array.dtype != bool else str(array.item())
    if array.size <= ENTRIES_SHOWN:
        return _format_nested(array.tolist()) + behind
    if array.dtype == bool:
        return f"{int(array.sum())} of {array.size}"
    return f"{_format_range(array)}{behind}, {'×'.join(map(str, array.shape))}"


def _format_nested(numbers: Any) -> str:
    if isinstance(numbers, list):
        return f"({', '.join(map(_format_nested, numbers))})"
    return format_number(numbers)


def _format_range(array: np.ndarray) -> str:
    finite = array[np.isfinite(array)]
    if not finite.size:
        return "not finite"
    low, high = format_number(finite.min()), format_number(finite.max())
    lost = array.size - finite.size
    return (low if low == high else f"{low} to {high}") + (f" ({lost} not finite)" if lost else "")


def format_tree(value: object, unit: str = "") -> str:
    """An array, or the arrays of a pytree by where they are in it."""
    leaves = jax.tree_util.tree_leaves_with_path(value)
    if len(leaves) == 1 and not leaves[0][0]:
        return format_array(leaves[0][1], unit)
    named = (f"{jax.tree_util.keystr(path).lstrip('.')} {format_array(leaf, unit)}" for path, leaf in leaves)
    return ", ".join(named)


def format_part(part: object) -> str:
    """A force, a contact or another part of a scene, with its numbers and their units: `Gravity(g=9.8 m/s²)`."""
    inner = getattr(part, "function", None)
    if inner is not None and callable(inner):
        return f"{getattr(inner, '__name__', type(inner).__name__)}(t, state, mass)"
    if not dataclasses.is_dataclass(part):
        return repr(part)
    shown = [_format_field(field, getattr(part, field.name, None)) for field in dataclasses.fields(part) if field.repr]
    return f"{type(part).__name__}({', '.join(text for text in shown if text)})"


def represent_part(self: object) -> str:
    """`format_part` as the `__repr__` of a class."""
    return format_part(self)


def _format_field(field: dataclasses.Field, value: object) -> str:
    """A field as `name=value unit`; empty for what is absent, recorded during a run, or a record of its own."""
    kept_out = field.name.startswith("_") or field.name.endswith("_rest") or field.metadata.get("record")
    if value is None or value is False or kept_out:
        return ""
    kept = field.metadata.get("quantity")
    if kept is not None and kept.per == "memory":
        return ""
    unit = field.metadata.get("unit", "")
    if isinstance(value, bool | int | float | np.number | np.ndarray | jax.Array):
        return f"{field.name}={format_array(value, unit if unit != '1' else '')}"
    if isinstance(value, tuple):
        return f"{field.name}={_format_several(value)}"
    if isinstance(value, str):
        return f"{field.name}={value!r}"
    if callable(value) and hasattr(value, "__name__"):
        return f"{field.name}={value.__name__}"
    if dataclasses.is_dataclass(value):
        return f"{field.name}={format_part(value)}"
    return f"{field.name}={value!r}"


def _format_several(parts: tuple) -> str:
    """A few parts, or the first and the last of many and how many there are."""
    shown = parts if len(parts) <= ENTRIES_SHOWN else (parts[0], parts[-1])
    texts = [format_array(part) if isinstance(part, np.ndarray | jax.Array) else format_part(part) for part in shown]
    if len(parts) > ENTRIES_SHOWN:
        return f"({texts[0]}, …, {texts[1]}; {len(parts)} of them)"
    return f"({', '.join(texts)}{',' if len(texts) == 1 else ''})"


def describe_scene(scene: Any) -> tuple[str, list[Row]]:
    """What moves, how heavy it is, and every part of a scene with its numbers."""
    state = scene.state
    *lanes, dim = state.position.shape
    number = int(np.prod(lanes))
    moves = hasattr(state, "velocity") or state.rotates
    kind = "rigid body" if state.rotates else "particle" if moves else "system"
    moving = count(number, kind, "rigid bodies" if state.rotates else None)
    if scene.couples and number > 1:
        batch = int(np.prod(lanes[:-1]))
        moving = (f"{batch} scenes of " if len(lanes) > 1 else "") + f"{lanes[-1]} coupled {kind}s".replace(
            "bodys", "bodies"
        )
    title = f"Scene: {moving} in {dim}-D, {state.dtype}"
    if not moves:
        law = [("rate" if i == 0 else "", repr(force)) for i, force in enumerate(scene.forces)]
        return f"Scene: {moving}, first order in {count(dim, 'variable')}, {state.dtype}", [
            ("y", format_array(state.position)),
            *law,
        ]
    rows = [("position", format_array(state.position, "m"))]
    if not state.rotates:
        rows.append(("velocity", format_array(state.velocity, "m/s")))
    mass = scene.mass
    rows.append(("mass", format_array(mass, "kg") if hasattr(mass, "shape") else format_part(mass)))
    rows += [("force" if i == 0 else "", format_part(force)) for i, force in enumerate(scene.forces)]
    rows += [("contact" if i == 0 else "", format_part(contact)) for i, contact in enumerate(scene.contacts)]
    if scene.held is not None:
        led = " along a path" if scene.prescribed_motion is not None else ""
        rows.append(("held", format_array(scene.held) + led))
    if scene.emitter is not None:
        rows.append(("emitter", format_part(scene.emitter)))
    return title, rows


def represent_scene(self: Any) -> str:
    """`describe_scene` as the `__repr__` of the class."""
    return write_summary(*describe_scene(self))


def tabulate_scene(self: Any) -> str:
    """`describe_scene` as what a notebook shows."""
    return write_table(*describe_scene(self))


def count(number: int, one: str, many: str | None = None) -> str:
    """A number with its noun."""
    return f"{number} {one if number == 1 else many or one + 's'}"


__all__ = [
    "count",
    "describe_scene",
    "format_array",
    "format_number",
    "format_part",
    "format_tree",
    "represent_part",
    "represent_scene",
    "tabulate_scene",
    "write_grid",
    "write_summary",
    "write_table",
]
