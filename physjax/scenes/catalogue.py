"""The gallery as a list and as a page: what each scene is, how large, what its results are tested against; its pictures.

What the list says of the scenes of this package stands in `data/gallery.csv`, so that nothing is built to be listed;
`write_table()` writes it from the scenes, and a test holds it to them. A scene that is not in it is built.
"""

import csv
import functools
import html
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

from physjax.physics.rigid.planar import PlanarBodies
from physjax.physics.rigid.spatial import RigidBodies
from physjax.physics.springs.rods import Rods, Ropes
from physjax.physics.springs.springs import Springs
from physjax.scenes.registry import SCENES, title
from physjax.study.problem import Problem

TABLE = "gallery.csv"
"""What the list says of each scene, among the data of this folder."""
LINE_WIDTH = 80
"""Columns of a terminal as narrow as they come."""


class Entry(NamedTuple):
    """A scene by name: its title, its size, the truths that it is tested against, and whether it is smooth.

    A smooth one is an ordinary differential equation: no contacts, no emitter, and no force that remembers.
    """

    name: str
    title: str
    size: str
    truth: str
    smooth: bool = True

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.size}", self.title, f"truth: {self.truth}"]
        return "\n".join(wrap_line(line, indent) for line, indent in zip(lines, (0, 4, 4), strict=True))


def wrap_line(line: str, indent: int) -> str:
    """A line for a narrow terminal; what does not fit goes on below, a little further in."""
    return fill(line, LINE_WIDTH, initial_indent=" " * indent, subsequent_indent=" " * (indent + 2))


def list_scene(name: str) -> Entry:
    """The entry of a scene: from the table, or, for one that is not of this package, from the scene itself."""
    known = _read_entries().get(name)
    ours = SCENES[name].__module__.startswith("physjax.scenes.")
    return known if known is not None and ours else describe_problem(name, build_scene(name))


def build_scene(name: str) -> Problem:
    """A scene of the gallery, in float64."""
    import jax

    with jax.enable_x64(True):
        return SCENES[name]()


def describe_problem(name: str, problem: Problem) -> Entry:
    """The entry of a scene, from what has been built."""
    truths = [truth.statement for truth in problem.truths]
    known = ["closed form"] if problem.exact is not None else []
    return Entry(name, title(name), _describe_size(problem), "; ".join(known + truths), problem.is_ode)


@functools.cache
def _read_entries() -> dict[str, Entry]:
    """The entries of the table by name; titles are the docstrings'."""
    lines = (resources.files("physjax.scenes") / "data" / TABLE).read_text(encoding="utf-8").splitlines()
    rows = [row for row in csv.DictReader(lines) if row["name"] in SCENES]
    return {
        row["name"]: Entry(row["name"], title(row["name"]), row["size"], row["truth"], row["smooth"] == "yes")
        for row in rows
    }


def write_table(path: Path = Path(__file__).parent / "data" / TABLE) -> None:
    """Write the table again from the scenes themselves, after one was added or changed; half a minute."""
    from physjax.files import write_atomically

    with write_atomically(path) as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["name", "size", "smooth", "truth"])
        for name in SCENES:
            entry = describe_problem(name, build_scene(name))
            rows.writerow([name, entry.size, "yes" if entry.smooth else "no", entry.truth])


def render(names: Iterable[str], folder: Path) -> Iterator[tuple[str, Exception | None]]:
    """Write `name.png` and `name.gif` of each scene, and last a page `index.html` with all of them.

    Yields each name when it is done, with the exception if it failed: the other scenes are drawn all the same.
    """
    from physjax.files import write_atomically
    from physjax.show.pages import read_web_file

    cards: list[str] = []
    for name in names:
        error = None
        try:
            cards.append(_render_card(_draw_scene(name, folder)))
        except Exception as reason:  # any failure is handed on, and the next scene is drawn
            error = reason
            cards.append(_render_card(Entry(name, title(name), "", f"could not be drawn: {reason}"), drawn=False))
        yield name, error
    with write_atomically(folder / "index.html") as file:
        file.write(_PAGE.replace("__COLORS__", read_web_file("colors.css")).replace("__CARDS__", "\n".join(cards)))


def _draw_scene(name: str, folder: Path) -> Entry:
    """Run a scene by its own reference method and write both pictures."""
    from matplotlib import pyplot as plt

    from physjax.files import write_atomically
    from physjax.show import auto_plot

    problem = build_scene(name)
    run = problem.filmed()
    figure = auto_plot.plot_run(run, problem.looks)
    with write_atomically(folder / f"{name}.png", "wb") as file:
        figure.savefig(file, dpi=125, bbox_inches="tight")
    plt.close(figure)
    auto_plot.animate_run(run, problem.looks).save(folder / f"{name}.gif", progress=False)
    return describe_problem(name, problem)


def _describe_size(problem: Problem) -> str:
    """The number of particles or bodies, of dimensions, of springs and of rods, and the duration."""
    from physjax.text import format_seconds

    state, forces = problem.scene.state, problem.scene.forces
    lanes = state.position[..., 0].size
    one, many = ("body", "bodies") if isinstance(state, RigidBodies | PlanarBodies) else ("particle", "particles")
    words, joined = f"{lanes} {one if lanes == 1 else many}", ""
    for kind, word in ((Springs, "spring"), (Rods, "rod"), (Ropes, "rope")):
        number = sum(len(force.pairs) for force in forces if isinstance(force, kind))
        joined += f", {number} {word}{'s' * (number > 1)}" if number else ""
    return f"{words} in {state.position.shape[-1]}-D{joined}, {format_seconds(problem.duration)}"


def _render_card(record: Entry, drawn: bool = True) -> str:
    name, line, size, truth = map(html.escape, record[:4])
    picture = (
        f'<button aria-label="play or stop {name}"><img src="{name}.png" data-other="{name}.gif" alt="{line}" '
        'loading="lazy"></button>'
    )
    return (
        f'<article id="{name}"><h2>{name}</h2>{picture if drawn else ""}<p>{line}</p>'
        f'<p class="small">{size}</p><p class="small">{truth}</p></article>'
    )


_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>physjax: the gallery</title>
<style>
__COLORS__body { color: var(--ink); background: var(--page); }
body { font: 16px/1.45 system-ui, sans-serif; max-width: 1280px; margin: 1.5em auto; padding: 0 1em; }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 360px), 1fr)); gap: 1.5em; align-items: start; }
article { border: 1px solid var(--line); border-radius: 8px; padding: 0 1em; overflow-wrap: break-word; }
h2 { font-size: 1.15em; margin: .7em 0; }
button { display: block; width: 100%; padding: 0; border: 0; background: none; cursor: pointer; }
img { display: block; width: 100%; height: 260px; object-fit: contain; border-radius: 4px; background: white; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
.small { font-size: .85em; color: var(--pale); }
</style>
<h1>physjax: the gallery</h1>
<p>Each scene, and the truths that it is tested against. Press a picture to play it.</p>
<main>
__CARDS__
</main>
<script>
for (const button of document.querySelectorAll("button")) button.onclick = () => {
  const image = button.firstChild, other = image.dataset.other;
  image.dataset.other = image.getAttribute("src"); image.src = other;
};
</script>
</html>
"""
