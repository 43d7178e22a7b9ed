"""Every public name shows an example, and every example does what it shows."""

import doctest
import inspect
from types import ModuleType

import jax
import numpy as np
import pytest
from matplotlib import pyplot as plt

import physjax
from physjax import Trajectory


def offered(module):
    """Public functions and classes of a module: what it lists or, where it lists nothing, what it defines."""
    listed = getattr(module, "__all__", None)
    for name in listed or vars(module):
        thing = getattr(module, name)
        ours = listed or (getattr(thing, "__module__", None) == module.__name__ and not name.startswith("_"))
        if ours and (inspect.isclass(thing) or inspect.isfunction(thing)):
            yield name, thing


def public():
    """All that a user can name, each thing once: under the first, which is the shortest, of its names."""
    modules = [thing for name in physjax.__all__ if isinstance(thing := getattr(physjax, name), ModuleType)]
    parts = {name: part for name, part in vars(Trajectory).items() if not name.startswith("_") and inspect.getdoc(part)}
    offers = {f"{module.__name__.rpartition('.')[2]}.": offered(module) for module in modules}
    offers = {"": offered(physjax), "Trajectory.": parts.items()} | offers
    names = {}
    for prefix, offer in offers.items():
        for name, thing in offer:
            names.setdefault(thing, prefix + name)
    return {name: thing for thing, name in names.items()}


NAMES = public()


def run(name, docstring, names):
    """Run the examples of a docstring, of which there must be some."""
    example = doctest.DocTestParser().get_doctest(docstring, names, name, None, None)
    assert example.examples, f"{name} has no example"
    told = []
    doctest.DocTestRunner(optionflags=doctest.REPORT_NDIFF).run(example, out=told.append, clear_globs=False)
    assert not told, "".join(told)
    return example.globs


@pytest.fixture(scope="module")
def stock():
    """The objects that the package's own docstring makes, with 64-bit types off and promotion allowed, as users have it."""
    plain = jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow")
    with plain[0], plain[1], plain[2], np.printoptions():
        yield run("physjax", physjax.__doc__, {})
    plt.close("all")


MODULES = [thing for name in physjax.__all__ if isinstance(thing := getattr(physjax, name), ModuleType)]


@pytest.mark.parametrize(
    "module", [m for m in MODULES if ">>>" in (m.__doc__ or "")], ids=lambda module: module.__name__
)
def test_the_example_of_a_module(module, stock):
    run(module.__name__, inspect.getdoc(module), dict(stock))


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of(name, stock, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(name, inspect.getdoc(NAMES[name]), dict(stock))
