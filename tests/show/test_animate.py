"""Films play in real time, stay still where nothing moves, end where a run ends, and are whole files."""

import base64
import html
import io
import re
import subprocess
import sys
from itertools import pairwise

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from physjax import Particles, Scene, animate, contacts, forces, methods, simulate
from physjax.show.films import schedule
from physjax.show.frames import Frames


def clock(times):
    return Frames(np.asarray(times, float), np.zeros((len(times), 1, 2)), len(times), ())


def played(path):
    """Pictures of a GIF, and how long each stands [ms]."""
    with Image.open(path) as film:
        pictures, durations = [], []
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB")))
            durations.append(film.info["duration"])
    return pictures, durations


# which frames


def test_pictures_are_picked_by_the_films_own_time():
    assert schedule("", clock(np.arange(121) / 120), 30.0, 1.0) == (list(range(0, 121, 4)), 30.0)
    frames, fps = schedule("", clock(np.arange(121) / 120), 30.0, 0.5)
    assert (frames[:3], frames[-1], fps) == ([0, 2, 4], 120, 30.0)
    uneven, _ = schedule("", clock([0.0, 0.09, 0.11, 0.4, 0.52, 1.0]), 4.0, 1.0)
    assert uneven == [0, 3, 4, 4, 5] or uneven == [0, 2, 4, 4, 5]


def test_fewer_frames_than_pictures_are_shown_once_each():
    frames, fps = schedule("", clock([0.0, 0.1, 0.2, 0.3]), 30.0, 1.0)
    assert frames == [0, 1, 2, 3]
    assert fps == pytest.approx(10.0)


def test_the_last_good_frame_is_always_shown():
    frames, _ = schedule("", clock(np.arange(101) / 100)._replace(good_frames=48), 30.0, 1.0)
    assert frames[-1] == 47


@pytest.mark.parametrize(
    ("times", "fps", "speed", "words"),
    [
        (
            [0.0, 1e6],
            30.0,
            1.0,
            "plays for 1e.06 s; expected two pictures to 600 s. With speed=1e.05 it takes ten seconds",
        ),
        ([0.0, 1e-4, 2e-4], 30.0, 1.0, "With speed=2e-05"),
        ([0.0, 1.0], 0.0, 1.0, r"fps \[1/s\]: got 0.0"),
        ([0.0, 1.0], 30.0, -1.0, r"speed \[1\]: got -1.0"),
        ([0.0], 30.0, 1.0, "one good frame, expected at least two"),
    ],
)
def test_films_that_no_one_can_watch_are_refused(times, fps, speed, words):
    with pytest.raises(ValueError, match=words):
        schedule("film", clock(times), fps, speed)


# files


def test_a_gif_plays_in_real_time_and_only_what_moves_moves(drape, tmp_path):
    film = animate.cloth(*drape)
    assert film.save(tmp_path / "film.gif", progress=False) == tmp_path / "film.gif"
    pictures, durations = played(tmp_path / "film.gif")
    assert len(pictures) == len(film.frames) == 16
    assert sum(durations) == pytest.approx(16 / 30 * 1000, abs=10)
    height, width, _ = pictures[0].shape
    assert (width, height) == tuple((film.still(0).get_size_inches() * 100).astype(int))
    assert (pictures[0][0, 0] == 255).all()
    assert all((a != b).any() for a, b in pairwise(pictures))
    edges = [picture[:, :40] for picture in pictures]  # where the numbers stand
    assert all((edge == edges[0]).all() for edge in edges)
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]


def test_a_page_holds_all_its_pictures_and_fetches_nothing(ruin, tmp_path, capsys):
    film = animate.springs(*ruin)
    film.save(tmp_path / "film.html")
    page = (tmp_path / "film.html").read_text(encoding="utf-8")
    assert page.count("data:image/webp;base64,") == len(film.frames) == 21
    assert "://" not in page
    assert "<link" not in page
    assert page.startswith("<!doctype html>")
    assert "/21 [" in capsys.readouterr().err


def test_a_notebook_shows_it_once(swarm):
    film = animate.paths(swarm, fps=4)
    shown = film._repr_html_()
    assert shown.count("data:image/webp;base64,") == len(film.frames) == 5
    assert "film of 5 pictures" in repr(film).lower()
    assert not plt.get_fignums()


@pytest.mark.parametrize("show", [animate.paths, animate.view])
def test_a_notebook_without_scripts_shows_a_still_of_it(swarm, show):
    shown = show(swarm, fps=4)._repr_mimebundle_()
    seen = re.sub("<iframe.*</iframe>", "", shown["text/html"])  # what is left where a notebook is not trusted
    (source,) = re.findall(r'<img src="data:image/png;base64,([^"]*)"', seen)
    assert source == shown["image/png"]
    still = Image.open(io.BytesIO(base64.b64decode(source))).convert("RGB")
    assert still.width > 300
    assert len(still.getcolors(10_000)) > 10
    assert len(source) < 60_000
    assert "<noscript><style>" in html.unescape(shown["text/html"])  # the page on top is then not seen
    assert not plt.get_fignums()


def test_bad_names_are_refused_before_anything_is_drawn(swarm, tmp_path):
    film = animate.paths(swarm)
    film._build_renderer = None
    with pytest.raises(ValueError, match=r"got film.mp4, expected a name that ends in .gif or .html"):
        film.save(tmp_path / "film.mp4")
    with pytest.raises(FileNotFoundError, match=r"the folder .*nowhere does not exist. Create it first"):
        film.save(tmp_path / "nowhere" / "film.gif")
    with pytest.raises(IndexError, match="got picture 31, expected -31 to 30"):
        film.still(31)


def test_a_film_that_fails_leaves_no_file(swarm, tmp_path):
    film = animate.paths(swarm)
    film._draw = lambda ax, scenery, frame: [][frame]
    with pytest.raises(IndexError):
        film.save(tmp_path / "film.gif", progress=False)
    assert not list(tmp_path.iterdir())


# what is seen


def test_limits_stay_and_the_time_runs(ruin):
    film = animate.springs(*ruin)
    first, last = (film.still(i).axes[0] for i in (0, -1))
    assert (first.get_xlim(), first.get_ylim()) == (last.get_xlim(), last.get_ylim())
    np.testing.assert_array_equal(first.get_position(), last.get_position())
    assert [first.get_title(), last.get_title()] == ["t = 0.00 s", "t = 1.00 s"]
    bottom, top = first.get_ylim()
    y = np.asarray(ruin[0].position[..., 1])
    assert bottom < y.min() < y.max() < top


def test_a_run_that_blew_up_ends_at_its_last_good_frame_and_says_so(burst):
    run, sheet = burst
    film = animate.cloth(run, sheet)
    good_frames = np.isfinite(run.position).all(axis=(1, 2)).sum()
    assert film.frames[-1] == good_frames - 1
    ax = film.still(-1).axes[0]
    assert ax.get_title().endswith(f"blew up after t = {run.time[good_frames - 1]:.3g} s")
    assert np.ptp(ax.get_xlim()) < 1e3


def test_dots_in_the_plane_stand_where_the_balls_are_with_a_trail_behind(swarm):
    film = animate.paths(swarm, every=2, color=np.arange(12.0), trail=0.11)
    *_walls, trail, dots = film.still(15).axes[0].collections
    np.testing.assert_allclose(dots.get_offsets(), swarm.position[15, ::2])
    assert len(trail.get_segments()) == 6 * 3  # a tenth of a second is three frames
    np.testing.assert_allclose(trail.get_segments()[-1], swarm.position[14:16, 10])
    assert trail.get_colors()[0, 3] < trail.get_colors()[-1, 3]
    assert len(np.unique(dots.get_facecolors(), axis=0)) == 6


def test_a_wall_that_moves_is_drawn_where_it_is():
    piston = contacts.Plane((0.0, 0.0), (1.0, 0.0), velocity=(1.0, 0.0), response=contacts.project)
    state = Particles(np.array([[0.05, 0.0], [2.0, 1.0]]), np.zeros((2, 2)))
    film = animate.paths(simulate(Scene(state, contacts=(piston,)), methods.verlet, dt=0.1, steps=10))
    figure, show = film._build_renderer()
    for frame in (0, 10, 4):
        show(frame)
        _wrong_side, edge, _trail, _dots = figure.axes[0].collections
        np.testing.assert_allclose(edge.get_paths()[0].vertices[:, 0], 0.1 * frame, atol=1e-12)


def test_particles_on_a_line_stand_side_by_side():
    scene = Scene(Particles(np.array([[1.0], [2.0]]), np.zeros((2, 1))), 1.0, (forces.Gravity(up=0),))
    ax = animate.paths(simulate(scene, methods.verlet, dt=0.01, steps=50)).still(-1).axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("lane", "position [m]")
    np.testing.assert_allclose(ax.collections[-1].get_offsets()[:, 0], [0, 1])


def test_lanes_in_space_that_blew_up_vanish_and_the_others_fly_on():
    wild = forces.independent(lambda t, state, mass: 1e306 * jnp.maximum(state.position - 0.5, 0.0))
    state = Particles(np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.zeros((2, 3)))
    run = simulate(Scene(state, 1.0, (wild, forces.Gravity())), methods.semi_implicit_euler, dt=0.01, steps=20)
    assert run.ok.tolist() == [True, False]
    film = animate.paths(run, trail=0.025)
    assert film.frames[-1] == 20
    trail, dots = film.still(-1).axes[0].collections
    assert len(dots.get_facecolors()) == 1
    assert len(trail.get_colors()) == 2


def test_bad_swarms_are_refused(swarm, unannotated):
    with pytest.raises(ValueError, match="expected a finite number for each of the 12 lanes"):
        animate.paths(swarm, color=np.arange(6))
    with pytest.raises(ValueError, match="every: got 0"):
        animate.paths(swarm, every=0)
    each = simulate(Scene(swarm.scene.state), methods.verlet, dt=np.full(12, 0.01), steps=2)
    with pytest.raises(ValueError, match="a step for each lane, expected one time for all"):
        animate.paths(each)


def test_matplotlib_is_loaded_when_a_film_is_drawn_and_not_before():
    program = (
        "import sys, physjax; physjax.animate, physjax.plot; print('matplotlib' in sys.modules, 'tqdm' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "False"]
