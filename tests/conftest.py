"""Tests run in float64 with strict dtype and rank promotion, and with every shape annotation of physjax executed.

`precision` runs a test twice: in float64, and in float32 with 64-bit types off, which is what games run in. What
`slow.txt` lists is slow as if it were marked so: the default run has some of every kind, and ends within minutes.
"""

import os
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

# one thread per worker: the workers fill the cores, and threads that spin for each other double the time of the suite
if "XLA_FLAGS" not in os.environ:
    FLAGS = "--xla_cpu_multi_thread_eigen=false"
    # most of what tests take is compiling: before jax 0.11 the older of two code generators does it in two thirds of the time
    if tuple(map(int, version("jax").split(".")[:2])) < (0, 11):
        FLAGS += " --xla_cpu_use_fusion_emitters=false"
    os.environ["XLA_FLAGS"] = FLAGS
os.environ.setdefault("MPLBACKEND", "Agg")
# what one file or worker has compiled the others read: a fifth of the time of the suite; kept for this run of it alone
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    COMPILED = tempfile.TemporaryDirectory(prefix="physjax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = COMPILED.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

import jax
import jaxtyping
import pytest

with jaxtyping.install_import_hook("physjax", "beartype.beartype"):
    import physjax  # noqa: F401

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_traceback_filtering", "off")  # whoever mends physjax wants the frames that its users are spared


SLOW = {line for line in (Path(__file__).parent / "slow.txt").read_text().splitlines() if not line.startswith("#")}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        name = item.nodeid.removeprefix("tests/")
        if name in SLOW or name.partition("[")[0] in SLOW:
            item.add_marker(pytest.mark.slow)


class Precision(NamedTuple):
    """A floating-point type and the distance from 1 to the next number in it."""

    dtype: jax.numpy.dtype
    eps: float


@pytest.fixture(autouse=True, scope="module")
def compiled_programs():
    """Forgotten after each file: Linux gives a process 65 530 mappings, and thousands of programs fill them."""
    yield
    jax.clear_caches()


@pytest.fixture(params=["float64", "float32"])
def precision(request):
    with jax.enable_x64(request.param == "float64"):
        dtype = jax.numpy.dtype(request.param)
        yield Precision(dtype, float(jax.numpy.finfo(dtype).eps))


@pytest.fixture
def unannotated():
    """Switch the executed annotations off, so that bad input reaches the checks that users meet."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
