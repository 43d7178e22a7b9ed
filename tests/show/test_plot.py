"""Pictures have axes with units, the data that was given, and the same style for the same method."""

import math
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest

from physjax import methods, simulate
from physjax.scenes import SCENES
from physjax.show import plot, style
from physjax.stepping.methods import METHODS
from physjax.study import report_page
from physjax.study.accuracy import Budget, work_precision
from physjax.text import format_seconds, format_table


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.mark.parametrize(("name", "labels"), [("oscillator", "time [s] position [m]"), ("kepler", "x [m] y [m]")])
def test_paths_are_drawn_with_units(name, labels):
    problem = SCENES[name]()
    flight = simulate(problem.scene, methods.verlet, dt=problem.duration / 512, steps=512, save_every=8)
    ax = plot.paths(flight, every=2)
    assert f"{ax.get_xlabel()} {ax.get_ylabel()}" == labels
    np.testing.assert_allclose(ax.lines[0].get_ydata()[-1], flight.position[-1, 0, -1])


def test_paths_in_space_and_into_given_axes():
    problem = SCENES["solar_system"]()
    flight = simulate(problem.scene, methods.leapfrog, dt=86400.0, steps=64)
    ax = plot.paths(flight, color=np.arange(10.0))
    assert ax.get_zlabel() == "z [m]"
    assert plot.paths(flight, ax=ax) is ax


def test_a_study_is_drawn_with_its_failures():
    springs = SCENES["oscillator"](stiffness=(1.0, 1000.0))
    limited = [method for method in METHODS.values() if math.isfinite(method.promises.stability_limit)]
    study = work_precision(
        springs,
        [*limited, methods.implicit_euler],
        dts=2.0 ** -np.arange(2, 15),
        rivals=(),
        budget=Budget(0.02, 1, 2.0),
        name="oscillator",
    )
    figure = study.plot()
    _, speed, order, kept = figure.axes
    assert speed.get_xlabel() == "run time [s]"
    assert "dt [s]" in order.get_xlabel()
    assert "energy" in kept.get_ylabel()
    assert speed.get_xscale() == speed.get_yscale() == "log"
    crosses = [line for line in order.lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert len(crosses) == len(limited)  # every explicit method fails at a sixth of a second on the stiff spring
    legend = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert "rk4: order" in legend
    assert "failed" in legend
    for ax in figure.axes:
        assert ax.get_xlabel()
        assert ax.get_ylabel()
        assert ax.get_title()


def test_methods_keep_apart_in_colour_and_marker():
    styles = [plot.style(name) for name in METHODS]
    assert len({style["color"] for style in styles}) == len(METHODS)
    assert len({style["marker"] for style in styles}) == len(METHODS)


def test_both_treatments_of_a_bounce_are_told_apart_and_belong_together():
    for name in METHODS:
        timed, projected = plot.style(name), plot.style(name, treatment=style.PROJECTED)
        assert (projected["color"], projected["marker"]) == (timed["color"], timed["marker"])
        assert (timed["linestyle"], projected["linestyle"]) == ("-", "--")
        assert projected["markerfacecolor"] == "white"
        assert projected == plot.style(f"{name}, projected")


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("adaptive rk4", {"adaptive": True}),
        ("rk4, float32", {"dtype": "float32"}),
        ("adaptive rk4, projected, float32", {"adaptive": True, "treatment": "projected", "dtype": "float32"}),
    ],
)
def test_a_display_name_has_the_style_of_its_parts(name, keywords):
    assert plot.style(name) == plot.style("rk4", **keywords) != plot.style("rk4")
    assert plot.style(f"{name} of mine")["color"] == "0.4"


def test_the_legend_has_room_below_the_panels():
    study = work_precision(
        SCENES["tennis_ball"](), [methods.verlet], [0.01], budget=Budget(0.02, 1, 2.0), name="tennis"
    )
    runs = tuple(
        run._replace(method=style.Variant(name, treatment).display_name, scheme=name, treatment=treatment)
        for run in study.runs
        for name in METHODS
        for treatment in (style.AS_GIVEN, style.PROJECTED)
    )
    figure = study._replace(runs=runs, promised={run.method: 1.0 for run in runs}).plot()
    figure.canvas.draw()
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 >= 0
    assert legend.x1 <= figure.bbox.width
    assert legend.y1 <= min(ax.xaxis.get_tightbbox().y0 for ax in figure.axes)
    assert "projected at the end of the step" in figure.legends[0].get_title().get_text()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert sum("promised" in label for label in labels) == len(runs) / len(study.runs)
    unpromised = study._replace(promised={"verlet": float("nan")}).plot()
    assert not any("promised" in text.get_text() for text in unpromised.legends[0].get_texts())
    adaptive = tuple(run._replace(method="adaptive rk4", dt=None, tolerance=1e-3) for run in study.runs)
    toleranced = study._replace(runs=adaptive, promised={"adaptive rk4": 4.0}).plot()
    assert toleranced.legends[0].get_texts()[0].get_text() == "adaptive rk4", "without steps no order can be seen"


def test_table_is_aligned():
    aligned = format_table(["method", "ms"], [["euler", "1"], ["semi_implicit_euler", "20"]])
    lines = aligned.splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[2].startswith("euler ")
    assert lines[3].endswith(" 20")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.99999994, "1 s"), (3e-6, "3 µs"), (0.0123, "12.3 ms"), (2.5, "2.5 s"), (86400 * 10, "10 d")],
)
def test_times_are_readable(seconds, text):
    assert format_seconds(seconds) == text


def test_page_is_self_contained():
    page = report_page.build_page(
        "title",
        "a < b",
        [
            report_page.Section(
                "kepler", "two bodies", report_page.Picture(b"png", "an orbit"), report_page.Table("a table")
            )
        ],
        guide=["how to <read> it"],
    )
    assert "how to &lt;read&gt; it" in page
    assert "a &lt; b" in page
    assert "data:image/png;base64," in page
    assert "src=" in page
    assert 'alt="an orbit"' in page
    assert "http" not in page.replace("http-equiv", "")
    assert "jax " in page


def test_aligned_text_is_a_table_on_a_page_and_what_is_around_it_stays_text():
    rows = [["semi_implicit_euler", "1", "-"], ["rk4", "4", "3 <s>"]]
    text = "above\n\n" + format_table(["method", "order", "to 1e-2"], rows) + "\n\nbelow"
    page = report_page.build_page("t", "", [report_page.Section("s", report_page.Table(text))])
    assert re.findall(r"<th[^>]*>(.*?)</th>", page) == ["method", "order", "to 1e-2"]
    assert re.findall(r"<td[^>]*>(.*?)</td>", page) == [
        "semi_<wbr>implicit_<wbr>euler",
        "1",
        "-",
        "rk4",
        "4",
        "3 &lt;s&gt;",
    ]
    assert re.findall(r'<td class="number" data-header="(.*?)">', page) == ["order", "to 1e-2"] * 2
    assert re.findall(r"<pre>(.*?)</pre>", page) == ["above", "below"]
    assert '<table class="grid">' in page
    wide = report_page.Table(format_table(["scene", "error"], [["kepler", "blanes_moan4, dt 24.5 ms: 157 µs"]]))
    assert '<table class="list">' in report_page.build_page("t", "", [report_page.Section("s", wide)])
