"""Pages and pictures can be read in the dark: colours keep their contrast with the page, by the formula of WCAG 2."""

import base64
import io
import json
import re
import shutil
import subprocess

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from physjax import Particles, Scene, animate, methods, simulate
from physjax.show import films
from physjax.show.dark import DARK_INK, DARK_PAGE, turn_dark
from physjax.show.pages import read_web_file
from physjax.show.style import PALETTE
from physjax.study import report_page

LEGIBLE_TEXT, VISIBLE_LINE = 4.5, 3.0


def luminance(colour):
    share = np.array(to_rgb(colour))
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]


def contrast(first, second):
    low, high = sorted([luminance(first), luminance(second)])
    return (high + 0.05) / (low + 0.05)


def themes():
    """The colours of each theme of the style sheet, by name."""
    blocks = re.findall(r"\{ (--page[^}]*)\}", read_web_file("colors.css"))
    return [dict(re.findall(r"(--\w+): (#[0-9a-fA-F]{3,6});", block)) for block in blocks]


def test_both_themes_of_the_style_sheet_can_be_read():
    light, dark, chosen = themes()
    assert dark == chosen
    assert luminance(light["--page"]) > 0.9 > 0.05 > luminance(dark["--page"])
    for theme in (light, dark):
        for ground in (theme["--page"], theme["--bar"]):
            assert min(contrast(theme[name], ground) for name in ("--ink", "--pale", "--accent")) >= LEGIBLE_TEXT
        assert contrast(theme["--edge"], theme["--page"]) >= VISIBLE_LINE
    np.testing.assert_allclose(to_rgb(dark["--page"]), DARK_PAGE)
    np.testing.assert_allclose(to_rgb(dark["--ink"]), DARK_INK)


def draw():
    figure, ax = plt.subplots(figsize=(4, 3))
    for colour in (*PALETTE, "0.2", "navy", "black"):
        ax.plot([0, 1], [0, 1], "o-", color=colour, label=colour)
    ax.plot([0, 1], [1, 0], "s", color="0.1", markerfacecolor="white")
    ax.annotate("words", (0.1, 0.1), bbox={"facecolor": "white"})
    ax.scatter([0.0, 1.0], [0.0, 1.0], color=["black", "red"])
    ax.pcolormesh(np.eye(2), cmap="viridis")
    ax.legend()
    return figure, ax


def test_a_figure_in_the_dark_keeps_its_contrast_and_its_colour_maps():
    figure, ax = draw()
    figure.draw_without_rendering()  # or the map has not coloured it
    before = ax.collections[1].get_facecolor().copy()
    turn_dark(figure)
    page = figure.get_facecolor()
    np.testing.assert_allclose(page[:3], DARK_PAGE)
    np.testing.assert_allclose(ax.get_facecolor()[:3], DARK_PAGE)
    for line in ax.lines[:-1]:
        assert contrast(line.get_color()[:3], page[:3]) >= VISIBLE_LINE
        np.testing.assert_allclose(line.get_markerfacecolor(), line.get_color())  # and not mirrored twice
    np.testing.assert_allclose(ax.lines[-1].get_markerfacecolor()[:3], DARK_PAGE)  # hollow
    words = [*ax.texts, *ax.get_xticklabels(), *ax.get_legend().get_texts()]
    assert all(contrast(text.get_color()[:3], page[:3]) >= LEGIBLE_TEXT for text in words)
    np.testing.assert_allclose(ax.texts[0].get_bbox_patch().get_facecolor()[:3], DARK_PAGE)
    assert all(contrast(colour[:3], page[:3]) >= VISIBLE_LINE for colour in ax.collections[0].get_facecolor())
    np.testing.assert_array_equal(ax.collections[1].get_facecolor(), before)
    plt.close(figure)


def test_a_box_in_space_is_dark_too():
    figure = Figure(figsize=(2, 2))
    ax = figure.add_subplot(projection="3d")
    ax.plot([0, 1], [0, 1], [0, 1], color="black")
    turn_dark(figure)
    pixels = io.BytesIO()
    figure.savefig(pixels)
    assert plt.imread(io.BytesIO(pixels.getvalue()))[..., :3].mean() < 0.25


def test_a_page_has_each_picture_in_both_themes():
    figure, ax = draw()
    assert not report_page.encode_figure(figure, "a map, whose words are for its light colours").dark
    figure, ax = draw()
    ax.collections[1].remove()
    picture = report_page.encode_figure(figure, "a <chart>")
    page = report_page.build_page("t", "", [report_page.Section("s", picture)])
    sources = re.findall(r'(srcset|src)="data:image/png;base64,([^"]+)"', page)
    dark, light = (plt.imread(io.BytesIO(base64.b64decode(data)))[..., :3].mean() for _, data in sources)
    assert [name for name, _ in sources] == ["srcset", "src"]
    assert dark < 0.35 < 0.6 < light
    assert '<source media="(prefers-color-scheme: dark)"' in page
    assert "prefers-color-scheme: dark) {" in page
    style = re.search(r"<style>(.*?)</style>", page, re.S)[1]
    own = style.replace(read_web_file("colors.css"), "")
    assert not re.search(r"#[0-9a-fA-F]{3}\b|#[0-9a-fA-F]{6}\b", own), "every colour is one of the themes"


def test_a_film_mirrors_lines_and_leaves_shaded_surfaces_as_they_are(monkeypatch):
    ball = Particles(jnp.zeros(2), jnp.array([3.0, 4.0]))
    film = animate.paths(simulate(Scene(ball), methods.euler, dt=0.05, steps=2))
    for kind, limit in (("lines", 10**6), ("shaded", 0)):
        monkeypatch.setattr(films, "LOSSLESS_LIMIT_BYTES", limit)
        page, _ = film._build_player(progress=False)
        assert f'id="picture" class="{kind}"' in page
        assert ".lines { filter: var(--mirror); }" in page
        assert "background: var(--page)" in page
        assert "prefers-color-scheme: dark" in page
    light, *dark = re.findall(r"--mirror: (.*?);", read_web_file("colors.css"))
    (share,) = {float(re.match(r"invert\((.*)\) hue-rotate\(180deg\)$", mirror)[1]) for mirror in dark}
    assert light == "none"
    np.testing.assert_allclose([1 - share] * 3, DARK_PAGE, atol=0.02)  # what white becomes, and black
    np.testing.assert_allclose([share] * 3, DARK_INK, atol=0.02)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_a_page_in_a_notebook_has_the_theme_of_the_notebook():
    program = re.search(r"function findNotebookTheme.*?^}$", read_web_file("tools.html"), re.S | re.M)[0]
    lab = '{ document: { body: { dataset: { jpThemeLight: "%s" } } } }'
    code = '{ document: { body: { dataset: {}, classList: { contains: name => name === "%s" } } } }'
    marimo = '{ document: { body: { dataset: { theme: "dark" }, classList: { contains: name => false } } } }'
    parents = [marimo, lab % "true", lab % "false", code % "vscode-dark", code % "vscode-light", code % "", "{}"]
    each = f"[{', '.join(parents)}].map(page => {{ parent = page; return findNotebookTheme(); }})"
    asked = f"let parent; {program} console.log(JSON.stringify({each}))"
    output = subprocess.run(["node", "-e", asked], capture_output=True, text=True, check=True)
    assert json.loads(output.stdout) == ["dark", "light", "dark", "dark", "light", None, None]


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_dots_and_paths_in_space_stand_out_from_a_dark_page():
    program = re.search(r"const LEAST_LIGHT.*?^}$", read_web_file("view.html"), re.S | re.M)[0]
    purple, yellow, blue, black = [0.06, 0.0, 0.09], [0.98, 0.79, 0.02], [0.0, 0.0, 0.2], [0.0, 0.0, 0.0]
    tints = json.dumps([*purple, *yellow, *blue, *black])
    found = {}
    for dark in ("true", "false"):
        code = f"const isDark = () => {dark}; {program} console.log(JSON.stringify(legible({tints})))"
        output = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
        found[dark] = np.reshape(json.loads(output.stdout), (-1, 3))
    np.testing.assert_allclose(found["false"].ravel(), json.loads(tints))
    assert (found["true"] <= 1).all()
    page = luminance(DARK_PAGE)
    assert ((found["true"] @ [0.2126, 0.7152, 0.0722] + 0.05) / (page + 0.05) >= LEGIBLE_TEXT).all()
    np.testing.assert_allclose(found["true"][1], yellow)
    assert found["true"][0, 1] < 0.5 * found["true"][0, 2], "purple stays purple"
