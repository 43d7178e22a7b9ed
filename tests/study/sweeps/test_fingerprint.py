"""What a sweep's folder, and a sweep in memory, know of the Python functions that a measure calls back."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import sweep
from physjax.study.sweeps.batching import trace_measure

AXES = {"x": np.linspace(0.0, 1.0, 5)}
NUMBER = jax.ShapeDtypeStruct((), jnp.float64)
GAIN = 2.0


def calling(function):
    """A measure whose whole answer comes from a Python function."""
    return lambda x: jax.pure_callback(function, NUMBER, x, vmap_method="expand_dims")


def quiet(measure, **options):
    return sweep(measure, AXES, progress=False, **options)


def known(measure):
    """What a folder would know a measure by."""
    return trace_measure(measure, {"x": NUMBER}).persistent_digest


def gained(x):
    return GAIN * np.asarray(x)


def through_a_global(x):
    return gained(x) + 1.0


def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)


def scaled(factor):
    return lambda x: np.asarray(factor * x)


def table(values):
    return lambda x: np.interp(x, [0.0, 0.5, 1.0], values)


def deep(function):
    return lambda x: np.asarray([function(y) for y in np.ravel(x)]).reshape(np.shape(x))


def defaulted(power):
    def raised(x, power=power, *, scale=power):
        return scale * np.asarray(x) ** power

    return raised


def test_two_callbacks_are_told_apart_in_memory_and_in_a_folder(tmp_path):
    """A program in memory was found by its text, in which a callback is only a number: cosines came out as sines."""
    x = AXES["x"]
    for function in (np.sin, np.cos):
        measure = calling(lambda x, function=function: np.asarray(function(x)))
        np.testing.assert_allclose(quiet(measure).values, function(x), rtol=1e-15)
    quiet(calling(np.sin), out=tmp_path)
    assert quiet(calling(np.sin), out=tmp_path).ok.all()
    with pytest.raises(ValueError, match="another measure, or one with other constants"):
        quiet(calling(np.cos), out=tmp_path)
    np.testing.assert_allclose(sweep.load(tmp_path).values, np.sin(x), rtol=1e-15)


def test_an_array_that_a_callback_closes_over_may_change_between_sweeps():
    values = np.zeros(3)
    for factor in (1.0, 0.0, 3.0):
        values[:] = factor
        assert (quiet(calling(table(values))).values == factor).all()


@pytest.mark.parametrize(
    ("one", "same", "others"),
    [
        (np.sin, np.sin, (np.cos, np.arcsin)),
        (scaled(2.0), scaled(2.0), (scaled(2.1), scaled(np.float32(2.0)), scaled(2), scaled(np.array(2.0)))),
        (table(np.arange(3.0)), table(np.arange(3.0)), (table([0.0, 1.0, 2.0]), table(np.array([0.0, 1.0, 2.5])))),
        (table(jnp.arange(3.0)), table(jnp.arange(3.0)), (table(jnp.arange(3.0) + 1),)),
        (deep(scaled(2.0)), deep(scaled(2.0)), (deep(scaled(2.1)), deep(math.sin), deep(factorial))),
        (defaulted(2), defaulted(2), (defaulted(3),)),
        (
            functools.partial(np.multiply, 2.0),
            functools.partial(np.multiply, 2.0),
            (functools.partial(np.add, 2.0), functools.partial(np.multiply, 3.0)),
        ),
        (lambda x: x + (GAIN in {1, 2}), lambda x: x + (GAIN in {1, 2}), (lambda x: x + (GAIN in {1, 3}),)),
    ],
)
def test_a_callback_is_known_by_what_it_does(one, same, others):
    digest = known(calling(one))
    assert known(calling(same)) == digest
    found = [known(calling(other)) for other in others]
    assert len({digest, *found}) == 1 + len(found)


def test_a_callback_is_known_by_the_globals_it_reads_however_deep(monkeypatch):
    before = known(calling(through_a_global))
    monkeypatch.setitem(globals(), "GAIN", 2.5)
    assert known(calling(through_a_global)) != before
    monkeypatch.undo()
    assert known(calling(through_a_global)) == before
    monkeypatch.setitem(globals(), "gained", lambda x: np.asarray(x))
    assert known(calling(through_a_global)) != before


class Model:
    """Something with a state, which nobody can look into."""

    gain = 2.0

    def __call__(self, x):
        return self.gain * np.asarray(x)

    def apply(self, x):
        return self.gain * np.asarray(x)


def changing(x):
    global GAIN
    return GAIN


def reads_a_file(x):
    return np.load("table.npy") * x


def reads_another(x):
    with open("table.txt") as file:
        return float(file.read()) * x


def imports(x):
    import json

    return json.loads("2") * x


def draws(x):
    return np.random.normal() * x  # noqa: NPY002


RANDOM, MODEL = np.random.default_rng(0), Model()


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (MODEL, r"an object of type .*Model"),
        (MODEL.apply, r"an object of type .*Model"),
        (lambda x: MODEL.gain * x, r"an object of type .*Model"),
        (lambda x: RANDOM.normal() * x, r"an object of type numpy.*Generator"),
        (scaled(np.array([None, 2.0])), r"an array of objects"),
        (np.vectorize(math.sin), r"an object of type numpy.*vectorize"),
        (np.frompyfunc(math.sin, 1, 1), r"an object of type numpy.*ufunc"),
        (functools.lru_cache(scaled(2.0)), r"an object of type functools"),
        (reads_a_file, r"'load'"),
        (reads_another, r"'open'"),
        (imports, r"the module json"),
        (draws, r"'random'"),
        (lambda x: pytest.approx(x), r"the module pytest"),
        (lambda x: getattr(np, "sin")(x), r"'getattr'"),  # noqa: B009
    ],
)
def test_a_callback_that_cannot_be_seen_to_the_bottom_is_refused_in_a_folder_alone(function, reason, tmp_path):
    with pytest.raises(ValueError, match=rf"got out= with .* depends on {reason}.*Leave out= away"):
        quiet(calling(function), out=tmp_path)
    assert not list(tmp_path.glob("chunk-*"))


def test_other_ways_out_of_a_program_are_refused_and_messages_are_not(tmp_path):
    def watched(x):
        jax.debug.callback(MODEL, x)
        jax.experimental.io_callback(MODEL.apply, None, x)
        return 2.0 * x

    def asked(x):
        return jax.lax.cond(x > 0.0, lambda: jax.experimental.io_callback(np.sin, NUMBER, x), lambda: x)

    def foreign(x):
        return jax.ffi.ffi_call("someone_elses", NUMBER)(x)

    assert known(watched) == known(watched)
    with pytest.raises(ValueError, match=r"io_callback to sin may return something else each time"):
        known(asked)
    with pytest.raises(ValueError, match=r"the compiled code of 'someone_elses' through jax.ffi"):
        known(foreign)


@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey, lambda seed: np.full(9999, float(seed))])
def test_constants_that_a_measure_closes_over_are_known_wherever_they_are_used(make):
    def drawn(seed):
        constant = make(seed)
        used = lambda x: x + (jax.random.normal(constant) if constant.size < 9 else constant.sum())  # noqa: E731
        inner = jax.custom_jvp(used)
        inner.defjvp(lambda x, v: (used(*x), v[0]))
        return lambda x: jax.lax.fori_loop(0, 2, lambda i, y: jax.jit(inner)(y), x)

    assert known(drawn(1)) == known(drawn(1)) != known(drawn(2))
