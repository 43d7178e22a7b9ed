"""While a program compiles, one line says so where somebody watches; and compiled programs are kept where it is asked for."""

import io
import os
import re
import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
import tqdm
from jupyter_client.manager import start_new_kernel

from physjax import Particles, Scene, cache, compiling, forces, methods, simulate
from physjax.compiling import announce_compiling
from physjax.scenes import SCENES


class Screen(io.StringIO):
    """What is written, and what is then to be seen of it on a terminal."""

    def isatty(self):
        return True

    @property
    def seen(self):
        line = ""
        for text in self.getvalue().split("\r"):
            line = text + line[len(text) :]
        return line.strip()


@pytest.fixture
def session(monkeypatch):
    """A session at a terminal, and delays that a test can wait for."""
    for name, seconds in (("QUIET_SECONDS", 0.05), ("SECONDS_PER_LOOK", 0.01), ("PAUSE_SECONDS", 0.02)):
        monkeypatch.setattr(compiling, name, seconds)
    session = SimpleNamespace(modules={}, stdout=Screen(), stderr=Screen(), _current_frames=sys._current_frames)
    monkeypatch.setattr(compiling, "sys", session)  # pytest puts its own streams into the real one
    return session


@pytest.fixture
def screen(session):
    return session.stderr


def wait_until(true):
    """Wait for another thread, on a machine that may be busy."""
    started = time.monotonic()
    while not true() and time.monotonic() - started < 20.0:
        time.sleep(0.01)


def compile_until(true):
    """Compile a new program whose tracing lasts until something is true, and run it."""

    def program(x):
        wait_until(true)
        return x + 1

    return jax.jit(program)(1.0)


def compile_for(seconds):
    """Compile a new program whose tracing takes this long, and run it."""
    end = time.monotonic() + seconds
    return compile_until(lambda: time.monotonic() > end)


def test_a_compilation_is_announced_and_the_line_is_removed(screen):
    with announce_compiling("car"):
        compile_until(screen.getvalue)
    assert "\rcompiling car: 0 s so far" in screen.getvalue()
    assert screen.seen == ""


def test_the_line_tells_the_seconds(screen, monkeypatch):
    clock = time.monotonic
    monkeypatch.setattr(compiling, "time", SimpleNamespace(sleep=time.sleep, monotonic=lambda: 100 * clock()))
    with announce_compiling("car"):
        compile_until(lambda: "compiling car: 12 s so far" in screen.getvalue() or len(screen.getvalue()) > 400)
    assert re.search("compiling car: [1-9][0-9] s so far", screen.getvalue())


def test_what_runs_long_is_not_announced(screen):
    with announce_compiling("car"):
        time.sleep(0.2)
    assert screen.getvalue() == ""


def test_what_compiles_quickly_is_not_announced(screen, monkeypatch):
    monkeypatch.setattr(compiling, "QUIET_SECONDS", 20.0)
    with announce_compiling("car"):
        compile_for(0.1)
    assert screen.getvalue() == ""


def test_the_line_goes_when_the_program_runs(screen):
    with announce_compiling("car"):
        compile_until(lambda: screen.seen)
        wait_until(lambda: not screen.seen)
        assert screen.seen == ""


@pytest.mark.parametrize("stream", [io.StringIO(), None])
def test_nothing_is_written_into_a_pipe_or_a_file(session, stream):
    session.stderr = stream
    with announce_compiling("car"):
        compile_for(0.2)
    assert stream is None or stream.getvalue() == ""
    assert session.stdout.getvalue() == ""


def test_nothing_is_written_inside_jit(screen):
    @jax.jit
    def outside(x):
        with announce_compiling("car"):
            compile_for(0.2)
        return x

    outside(1.0)
    assert screen.getvalue() == ""


def test_a_derivative_is_announced(screen):
    @announce_compiling("car")
    def square(x):
        return compile_until(screen.getvalue) * x**2

    assert jax.grad(square)(3.0) == 12.0
    assert "compiling car" in screen.getvalue()
    assert screen.seen == ""


def test_errors_come_through_and_the_line_is_removed(screen):
    def fail():
        with announce_compiling("car"):
            compile_until(screen.getvalue)
            raise ZeroDivisionError("of the user")

    with pytest.raises(ZeroDivisionError, match="of the user"):
        fail()
    assert "compiling car" in screen.getvalue()
    assert screen.seen == ""


def test_of_calls_inside_each_other_the_outermost_is_named(screen):
    with announce_compiling("car"), announce_compiling("wheel"):
        compile_until(screen.getvalue)
    assert "compiling car" in screen.getvalue()
    assert "wheel" not in screen.getvalue()


def test_a_progress_bar_is_left_alone(screen, session):
    session.modules["tqdm"] = tqdm
    with tqdm.tqdm(total=1, file=io.StringIO()), announce_compiling("car"):
        compile_for(0.2)
    assert screen.getvalue() == ""


@pytest.mark.parametrize("answers", [True, False])
def test_a_notebook_shows_it_with_what_is_printed_unless_it_is_run_as_a_file(session, answers):
    kernel = SimpleNamespace(get_parent=lambda: {"content": {"allow_stdin": answers}})
    session.modules["IPython"] = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=kernel))
    with announce_compiling("car"):
        compile_until(session.stdout.getvalue) if answers else compile_for(0.2)
    assert ("compiling car" in session.stdout.getvalue()) == answers
    assert session.stderr.getvalue() == ""


@pytest.mark.slow
def test_a_kernel_is_asked_in_its_own_words():
    code = """
import jax, time
from physjax import compiling
with compiling.announce_compiling("car"):
    jax.jit(lambda x: time.sleep(2.5) or x)(1.0)
"""
    manager, client = start_new_kernel(
        kernel_name="python3", env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    try:
        for answers in (True, False):
            written = []
            hook = lambda message: written.append(message["content"])  # noqa: B023, E731
            reply = client.execute_interactive(code, allow_stdin=answers, output_hook=hook, timeout=60)
            assert reply["content"]["status"] == "ok"
            assert ("compiling car: 2 s so far" in str(written)) == answers
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)


def test_a_run_is_announced_when_it_compiles_and_not_when_it_is_run_again(screen):
    waits = []

    def slow_to_trace(t, state, mass):
        if waits:
            wait_until(screen.getvalue)
        return 0.0 * state.velocity

    # while the scene is built the force is tried, and nothing is said of that
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(forces.Gravity(), slow_to_trace))
    waits.append(True)
    simulate(scene, methods.euler, dt=0.1, steps=3)
    assert "compiling the run" in screen.getvalue()
    written = screen.getvalue()
    simulate(scene, methods.euler, dt=0.2, steps=3)
    assert screen.getvalue() == written


def test_a_scene_of_the_gallery_knows_its_name():
    assert SCENES["projectile"](speed=20.0).name == "projectile"


# what is kept


@pytest.fixture
def uncached():
    yield
    cache(None)


@pytest.mark.usefixtures("uncached")
def test_programs_are_kept_and_read(tmp_path):
    reads = []
    listener = lambda event, **_: reads.append(event) if event.endswith("cache_hits") else None  # noqa: E731
    before = jax.config.jax_compilation_cache_dir
    own = cache(tmp_path / "compiled")
    assert own.parent == tmp_path / "compiled"
    assert jax.jit(lambda x: x * 3.0 + 1.0)(2.0) == 7.0
    assert list(own.iterdir())
    jax.clear_caches()
    jax.monitoring.register_event_listener(listener)
    try:
        assert jax.jit(lambda x: x * 3.0 + 1.0)(2.0) == 7.0
    finally:
        jax.monitoring.unregister_event_listener(listener)
    assert reads
    assert cache(None) is None
    assert jax.config.jax_compilation_cache_dir == before


def test_each_compiler_and_each_cpu_has_a_folder_of_its_own(monkeypatch):
    here = compiling.name_compiler_target()
    assert here == compiling.name_compiler_target()
    assert compiling.version("jaxlib") in here
    monkeypatch.setattr(compiling, "_read_cpu_features", lambda: "flags: fpu sse")
    assert compiling.name_compiler_target() != here
    monkeypatch.setattr(compiling, "version", lambda package: "0.9.9")
    assert compiling.name_compiler_target().startswith("jaxlib-0.9.9-")


@pytest.mark.usefixtures("uncached")
def test_a_folder_that_others_own_is_read_and_not_written(tmp_path, monkeypatch):
    own = cache(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    assert cache(tmp_path) == own
    assert jax.config.jax_compilation_cache_dir == str(own)
    jax.jit(lambda x: x * 5.0 + 1.0)(2.0)
    assert not list(own.iterdir())
    own.rmdir()
    with pytest.warns(UserWarning, match="programs are compiled"):
        cache(tmp_path)
    assert jax.config.jax_compilation_cache_dir != str(own)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="cannot write into"):
        cache(tmp_path / "file")
