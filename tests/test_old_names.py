"""Classes that are written with the old names of methods, and calls that use them."""

import warnings
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import pytest

from physjax.old_names import serve_old_names


class Shape(eqx.Module):
    symmetric: ClassVar[bool] = False

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        serve_old_names(cls, {"gap": "signed_distance", "even": "symmetric"})

    def signed_distance(self, x):
        return x


serve_old_names(Shape, {"gap": "signed_distance", "even": "symmetric"})


def test_a_method_under_its_old_name_is_served_with_a_note_that_names_the_class_and_its_place():
    with pytest.warns(FutureWarning, match="Raised: got the method gap, which is now called signed_distance") as notes:

        class Raised(Shape):
            def gap(self, x):
                return x - 1.0

    assert [note.filename for note in notes] == [__file__]
    assert Raised().signed_distance(3.0) == Raised().gap(3.0) == 2.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")

        class Again(Raised):
            """The note was for the class that defines the method."""

    assert Again().signed_distance(3.0) == 2.0


def test_the_old_name_can_be_called_on_what_has_the_new_one():
    class Raised(Shape):
        def signed_distance(self, x):
            return x - 1.0

    assert Shape().gap(3.0) == 3.0
    assert Raised().gap(3.0) == 2.0
    assert Shape().even is False


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_an_override_may_ask_its_parent_by_the_old_name():
    class Raised(Shape):
        def signed_distance(self, x):
            return x - 1.0

    class Higher(Raised):
        def gap(self, x):
            return super().gap(x) - 1.0

    class Highest(Higher):
        def signed_distance(self, x):
            return super().signed_distance(x) - 1.0

    assert Higher().signed_distance(3.0) == 1.0
    assert Highest().gap(3.0) == Highest().signed_distance(3.0) == 0.0


def test_a_base_that_is_no_shape_itself_may_bring_the_old_name():
    class Lift:
        def gap(self, x):
            return x - 5.0

    class Drop:
        def signed_distance(self, x):
            return x + 5.0

    class Dropped(Drop, Shape):
        pass

    assert Dropped().gap(3.0) == 8.0
    with pytest.warns(FutureWarning, match="Lifted"):

        class Lifted(Lift, Shape):
            pass

    assert Lifted().signed_distance(3.0) == -2.0


def test_an_old_name_fulfils_an_abstract_method():
    class Base(eqx.Module):
        @abstractmethod
        def signed_distance(self, x):
            """Nothing yet."""

        def __init_subclass__(cls):
            serve_old_names(cls, {"gap": "signed_distance"})

    with pytest.warns(FutureWarning):

        class Flat(Base):
            def gap(self, x):
                return x

    assert Flat().signed_distance(1.0) == 1.0


@pytest.mark.parametrize("value", [True, property(lambda self: True)])
def test_a_flag_is_served_too(value):
    with pytest.warns(FutureWarning, match="symmetric"):

        class Even(Shape):
            even = value

    assert Even().symmetric is True


def test_a_flag_may_be_a_field():
    with pytest.warns(FutureWarning):

        class Even(Shape):
            even: bool = eqx.field(static=True, default=True)

    assert Even().symmetric
    assert not Even(False).symmetric


def test_a_number_that_is_called_like_an_old_method_is_a_number():
    with warnings.catch_warnings():
        warnings.simplefilter("error")

        class Slot(Shape):
            gap: jnp.ndarray
            width: jnp.ndarray

            def signed_distance(self, x):
                return x - self.gap

        class Filled(Shape):
            gap: float = 2.0

    assert Slot(2.0, 1.0).signed_distance(3.0) == 1.0
    assert Slot(2.0, 1.0).gap == 2.0
    assert Filled().gap == 2.0
    assert Filled().signed_distance(3.0) == 3.0
    with pytest.raises(TypeError, match="missing"):
        Slot()
