"""Bad input is answered in plain words: what was given, what was expected, what to do."""

import equinox as eqx
import hypothesis.extra.numpy as nps
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physjax.checks import (
    as_positive_integer,
    as_real_argument,
    as_real_array,
    as_real_quantity,
    concrete_or_none,
    demand_all,
    demand_known,
    quantity,
)

quickly = settings(max_examples=40, deadline=None)


class Body(eqx.Module):
    """A module with each kind of number."""

    mass: jax.Array = quantity("mass", "kg", above=0)
    drag: jax.Array = quantity("drag", "kg/s", at_least=0, default=0.5)
    wind: jax.Array | None = quantity("wind", "m/s", default=None)


def test_python_numbers_stay_weak_and_arrays_keep_their_type(precision):
    for number in (2, 2.5):
        array = as_real_array("x", number)
        assert array.weak_type
        assert array.dtype == precision.dtype
        assert array == number
    for dtype in (jnp.float32, jnp.float16):
        assert as_real_array("x", np.ones(3, dtype)).dtype == dtype
    assert as_real_array("x", [1, 2]).dtype == precision.dtype, "integers become floats"
    assert as_real_array("x", np.int32(3)).dtype == precision.dtype


@pytest.mark.parametrize("value", [True, np.array([True]), 1j, np.ones(2, complex), "12", None, object(), {}])
def test_what_is_no_real_number_is_a_type_error(value):
    with pytest.raises(TypeError, match=r"^mass: got .*, expected real"):
        as_real_array("mass", value)


def test_long_values_are_shown_short():
    with pytest.raises(TypeError) as error:
        as_real_array("mass", "x" * 1000)
    assert len(str(error.value)) < 150


@quickly
@given(st.data())
def test_the_first_wrong_entry_is_named_and_the_wrong_ones_are_counted(data):
    shape = data.draw(nps.array_shapes(max_dims=3, max_side=4))
    good = data.draw(nps.arrays(bool, shape))
    values = np.arange(good.size, dtype=float).reshape(shape)
    if good.all():
        demand_all("x", jnp.asarray(values), good, "anything")
        return
    first = tuple(int(i) for i in np.argwhere(~good)[0])
    where = str(first[0] if len(first) == 1 else first)
    with pytest.raises(ValueError) as error:
        demand_all("x", jnp.asarray(values), good, "less")
    wrong = int((~good).sum())
    assert str(error.value) == (
        f"x: got {values[first]} at index {where} ({wrong} of {good.size} entries are wrong), expected less."
    )


@quickly
@given(st.sampled_from([np.nan, np.inf, -np.inf]), st.integers(0, 4))
def test_numbers_that_are_not_finite_are_found_wherever_they_stand(bad, index):
    values = np.ones(5)
    values[index] = bad
    with pytest.raises(ValueError, match=rf"speed: got {bad} at index {index} .* expected finite numbers"):
        as_real_quantity("speed", values)
    with pytest.raises(ValueError, match=rf"speed: got {bad}, expected finite numbers"):
        as_real_quantity("speed", bad)


@quickly
@given(st.floats(-10, 10))
def test_bounds_hold_strictly_or_not_as_they_say(value):
    for options, allowed, words in (({"above": 0}, value > 0, "> 0"), ({"at_least": 0.5}, value >= 0.5, ">= 0.5")):
        if allowed:
            assert as_real_quantity("x", value, **options) == value
        else:
            with pytest.raises(ValueError, match=rf"x: got .*, expected numbers {words}"):
                as_real_quantity("x", value, **options)


def test_an_argument_stays_where_it_was_given():
    for value in (2, 0.5, np.float32(0.5), np.array([1, 2])):
        found = as_real_argument("dt", value, np.dtype(np.float32), above=0.0)
        assert isinstance(found, np.ndarray)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, value)
    assert isinstance(as_real_argument("dt", jnp.ones(2), np.dtype(np.float32), above=0.0), jax.Array)
    for bad, error, words in (
        (0.0, ValueError, r"dt: got 0\.0, expected numbers > 0"),
        (np.nan, ValueError, "dt: got nan, expected finite numbers"),
        (np.array([1.0, -1.0]), ValueError, r"dt: got -1\.0 at index 1"),
        (True, TypeError, "dt: got dtype bool, expected real"),
        ("x", TypeError, "dt: got .*, expected real numbers"),
    ):
        with pytest.raises(error, match=words):
            as_real_argument("dt", bad, np.dtype(np.float32), above=0.0)


def test_values_are_not_looked_at_while_they_are_traced_but_types_are():
    assert jax.jit(lambda x: as_real_quantity("x", x, above=0))(-1.0) == -1.0
    assert jax.grad(lambda x: as_real_quantity("x", x, above=0) ** 2)(-1.0) == -2.0
    np.testing.assert_array_equal(jax.vmap(lambda x: as_real_quantity("x", x, above=0))(-jnp.ones(3)), -np.ones(3))
    with pytest.raises(TypeError, match="x: got dtype complex128, expected real"):
        jax.jit(lambda x: as_real_quantity("x", x))(1j)


def test_what_is_traced_has_no_concrete_value():
    seen = []
    jax.jit(lambda x: seen.append(concrete_or_none(x)))(1.0)
    assert seen == [None]
    assert isinstance(concrete_or_none(jnp.ones(2)), np.ndarray)


def test_a_quantity_is_an_array_leaf_that_keeps_its_unit():
    body = Body(3)
    assert jax.tree.leaves(body) == [3.0, 0.5]
    assert body.wind is None, "absent, not zero"
    assert Body.__dataclass_fields__["drag"].metadata["unit"] == "kg/s"


@pytest.mark.parametrize(
    ("numbers", "error", "message"),
    [
        ({"mass": 0.0}, ValueError, r"mass \[kg\]: got 0\.0, expected numbers > 0"),
        ({"mass": None}, TypeError, r"mass \[kg\]: got NoneType None, expected real numbers"),
        ({"mass": 1.0, "drag": None}, TypeError, r"drag \[kg/s\]: got NoneType None, expected real numbers"),
        (
            {"mass": 1.0, "drag": [0.0, -1.0]},
            ValueError,
            r"drag \[kg/s\]: got -1\.0 at index 1 .* expected numbers >= 0",
        ),
        ({"mass": 1.0, "wind": [np.nan]}, ValueError, r"wind \[m/s\]: got nan at index 0 .* expected finite"),
    ],
)
def test_a_bad_quantity_is_named_with_its_unit(numbers, error, message, unannotated):
    with pytest.raises(error, match=message):
        Body(**numbers)


def test_counts_are_python_integers_of_at_least_one():
    assert as_positive_integer("steps", np.int64(7)) == 7
    assert type(as_positive_integer("steps", np.int64(7))) is int
    assert as_positive_integer("index", 0, at_least=0) == 0
    for value in (0, -3):
        with pytest.raises(ValueError, match=rf"steps: got {value}, expected at least 1"):
            as_positive_integer("steps", value)
    for value in (1.0, True, "3", None, jnp.ones(())):
        with pytest.raises(TypeError, match=r"steps: got .*, expected an integer"):
            as_positive_integer("steps", value)
    with pytest.raises(TypeError, match=r"steps: got a traced value, .* Pass it as a static argument"):
        jax.jit(lambda n: as_positive_integer("steps", n))(3)


def test_an_unknown_name_is_answered_with_the_nearest():
    names = ["verlet", "leapfrog", "rk4", "euler"]
    assert demand_known("method", "rk4", names) == "rk4"
    with pytest.raises(ValueError, match=r"unknown method 'leepfrog'\. Did you mean leapfrog or euler\?"):
        demand_known("method", "leepfrog", iter(names))
    with pytest.raises(ValueError, match=r"unknown method 'zzz'\. Known: euler, leapfrog, rk4, verlet\."):
        demand_known("method", "zzz", names)
