"""What is said while a program compiles, and where compiled programs are kept from one session to the next."""

import hashlib
import os
import platform
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Protocol, runtime_checkable

import jax
from jax.experimental.compilation_cache import compilation_cache

from physjax.files import ensure_writable_folder

QUIET_SECONDS = 1.0
"""A program that is compiled within this is not worth a word."""
SECONDS_PER_LOOK = 0.25
"""How often a thread looks at what another is doing, at a cost of some µs: the line goes soon after the compiler is done."""
PAUSE_SECONDS = 1.0
"""A pause in compiling that is part of it: between its programs JAX differentiates, or moves numbers."""
IDLE_SECONDS = 10.0
"""The thread that looks ends when there has been nothing to look at for this long."""
COMPILER_MODULES = {"jax._src.interpreters.partial_eval", "jax._src.interpreters.mlir", "jax._src.compiler"}
"""Where JAX traces, lowers and compiles; a run that was compiled before passes through none of them."""


# what is said


@runtime_checkable
class Screen(Protocol):
    """Where lines are written for somebody to read."""

    def write(self, text: str, /) -> object:
        """Write a text."""
        ...

    def flush(self) -> object:
        """Show what was written."""
        ...


@contextmanager
def announce_compiling(what: str) -> Iterator[None]:
    """Around a call that may compile, or above its `def`: one line says so, and for how long, and is removed at the end.

    Only while a program is compiled for more than a second, not while it runs, and only where somebody watches: on a
    terminal or in a notebook, not in a file or a pipe, not inside `jit`, and not next to a progress bar. Of calls inside
    each other the outermost is named.
    """
    screen, thread = _find_screen(), threading.get_ident()
    if screen is None or thread in _watched or is_compiling(thread):  # then it is being traced itself
        yield
        return
    _watched[thread] = notice = _Notice(screen, what, thread)
    _wake_watch()
    try:
        yield
    finally:
        del _watched[thread]
        notice.end()


class _Notice:
    """The line about one call, written by another thread, which looks at what the call is doing."""

    def __init__(self, screen: Screen, what: str, thread: int):
        self._screen, self._what, self._thread = screen, what, thread
        self._since = self._last_seen = time.monotonic()  # when it began to compile, and when it was last seen to
        self._writing, self._ended, self._line = threading.Lock(), False, ""

    def look(self) -> None:
        """Show the line, with the time so far, or remove it."""
        now = time.monotonic()
        if is_compiling(self._thread):
            self._last_seen = now
        elif now - self._last_seen >= PAUSE_SECONDS:
            self._since = now
        line = f"compiling {self._what}: {now - self._since:.0f} s so far"
        lasting = self._last_seen - self._since >= QUIET_SECONDS and not _has_progress_bar()
        with self._writing:
            if not self._ended:
                self._replace_line(line if lasting else "")

    def end(self) -> None:
        """Remove the line, and write no other."""
        with self._writing:
            self._ended = True
            self._replace_line("")

    def _replace_line(self, line: str) -> None:
        """Write a line over the one before it, if they differ."""
        if line != self._line:
            self._screen.write(f"\r{line:{len(self._line)}}" + ("" if line else "\r"))
            self._screen.flush()
            self._line = line


_watched: dict[int, _Notice] = {}
_watch: threading.Thread | None = None
_waking = threading.Lock()


def _wake_watch() -> None:
    """See to it that somebody looks: one thread for all calls, since to start one takes as long as a short run."""
    global _watch
    with _waking:
        if _watch is None or not _watch.is_alive():  # so after a fork
            _watch = threading.Thread(target=_look_at_all, name="physjax compiling", daemon=True)
            _watch.start()


def _look_at_all() -> None:
    """Look at all calls again and again, until there has been none for a while."""
    global _watch
    last = time.monotonic()
    while True:
        time.sleep(SECONDS_PER_LOOK)
        notices = tuple(_watched.values())
        for notice in notices:
            notice.look()
        last = time.monotonic() if notices else last
        with _waking:
            if not _watched and time.monotonic() - last > IDLE_SECONDS:
                _watch = None
                return


def is_compiling(thread: int) -> bool:
    """Whether a thread is tracing, lowering or compiling a program, by what is on its stack.

    JAX reports each of these only when it is over, and a run that takes long looks the same from outside.
    """
    frame = sys._current_frames().get(thread)
    while frame is not None and frame.f_globals.get("__name__") not in COMPILER_MODULES:
        frame = frame.f_back
    return frame is not None


def _find_screen() -> Screen | None:
    """Where somebody reads what is written now: a terminal, or a notebook, whose standard error is red; else None."""
    ipython = sys.modules.get("IPython")
    kernel = None if ipython is None else getattr(ipython.get_ipython(), "kernel", None)
    if kernel is not None:
        # who runs a notebook as a file, for its output, answers no questions
        answers = kernel.get_parent().get("content", {}).get("allow_stdin", False)
        return sys.stdout if answers else None
    return sys.stderr if sys.stderr is not None and sys.stderr.isatty() else None


def _has_progress_bar() -> bool:
    """Whether a bar of tqdm, ours or the user's, is being drawn: it shows that something goes on, on the same line."""
    tqdm = sys.modules.get("tqdm")
    return tqdm is not None and len(getattr(tqdm.tqdm, "_instances", ())) > 0


# what is kept


def cache(folder: str | os.PathLike[str] | None) -> Path | None:
    """Keep every program that is compiled from now on in a folder, and read it from there in later sessions.

    Returns the folder inside that is this machine's own: programs belong to a version of jaxlib and to the features of
    a CPU, so that none is read where it was not made for. A folder that exists and cannot be written is only read, with
    a warning if it holds nothing for this machine. None puts things back as they were. Nothing is kept unless this is
    called, and nothing is ever deleted: remove the folder when it is too large (some 20 kB a program).

    A program read runs as fast as one compiled, but is traced all the same before it can be looked up. On two cores the
    first run of three tumbling boxes takes 2.2 s of processor time instead of 9.4 with jax 0.12, 4.9 instead of 13.5
    with 0.10.1. That one prints two lines on "cpu_aot_loader" for each program that it reads, about preferences of the
    compiler that no CPU lists among its features, and reads it all the same; the environment variable
    `TF_CPP_MIN_LOG_LEVEL=3`, set before Python starts, keeps it quiet. Who can write into the folder can make those who
    read it run anything: a class reads one that only its teacher writes.

    Example:
        >>> import pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     own = cache(folder)
        ...     own.parent == pathlib.Path(folder), cache(None)
        (True, None)
    """
    own = None
    _restore_settings()
    if folder is not None:
        own = Path(folder) / name_compiler_target()
        nearest = own if own.is_dir() else Path(folder)
        if nearest.is_dir() and not os.access(nearest, os.W_OK):
            _read_only(own)
        else:
            _change_settings(str(ensure_writable_folder(own)), least_seconds=0.0)
    compilation_cache.reset_cache()  # jax looks for the folder once, at the first program
    return own


def _read_only(own: Path) -> None:
    """Read from a folder and write nothing into it, if it is there."""
    if own.is_dir():
        _change_settings(str(own), least_seconds=FOREVER_SECONDS)
    else:
        words = f"cache: {own} does not exist and cannot be written, so programs are compiled. Run physjax warm as its owner."
        warnings.warn(words, stacklevel=3)


def _change_settings(folder: str, *, least_seconds: float) -> None:
    """Have jax read from a folder, and write what takes this long to compile, however small."""
    for name, value in zip(SETTINGS, (folder, least_seconds, -1), strict=True):
        _settings_before[name] = getattr(jax.config, name)
        jax.config.update(name, value)


def _restore_settings() -> None:
    while _settings_before:
        jax.config.update(*_settings_before.popitem())


SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
"""Of jax, in this order. By itself it keeps no small programs; a scene is built by hundreds, as slow together as a large one."""
FOREVER_SECONDS = 1e9
"""No program takes this long to compile, so none is written."""
_settings_before: dict[str, object] = {}


def name_compiler_target() -> str:
    """What compiled programs depend on, as the name of a folder: jaxlib's version, and the kind and features of the CPU.

    JAX tells the devices of its cache apart by their kind alone, and code for one CPU stops another that lacks an
    instruction.
    """
    features = hashlib.sha256(_read_cpu_features().encode()).hexdigest()[:12]
    return f"jaxlib-{version('jaxlib')}-{platform.machine()}-{features}"


def _read_cpu_features() -> str:
    """The model and instruction sets of the first CPU, where Linux lists them; elsewhere the name that the system gives it."""
    listed = Path("/proc/cpuinfo")
    if not listed.exists():
        return platform.processor()
    first = listed.read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    return "\n".join(
        line for line in first if line.split(":")[0].strip() in ("model name", "flags", "Features", "CPU part")
    )
