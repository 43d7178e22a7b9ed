"""Wrong names are answered by right ones: on modules and classes, and for arguments."""

import sys
import traceback

import jax.numpy as jnp
import pytest

import physjax
from physjax import (
    Particles,
    Scene,
    animate,
    contacts,
    emitters,
    forces,
    inertia,
    lattices,
    methods,
    plot,
    rigid,
    simulate,
    springs,
    tracebacks,
)
from physjax.name_hints import SYNONYMS, suggest_names

PLACES = (physjax, animate, contacts, emitters, forces, inertia, lattices, methods, plot, rigid, springs)
ARGUMENTS = {
    "dt",
    "duration",
    "steps",
    "mass",
    "pinned",
    "friction",
    "coulomb",
    "stiffness",
    "restitution",
    "rows",
    "panels",
    "angular_velocity",
    "axis",
    "coefficient",
    "density",
    "points",
}


@pytest.mark.parametrize(
    ("place", "name", "words"),
    [
        (rigid.PlanarShape, "circle", "type object 'PlanarShape' has no attribute 'circle'. Did you mean disc?"),
        (rigid.Shape, "cube", "Did you mean box?"),
        (rigid.Shape, "ball", "Did you mean sphere?"),
        (rigid.Shape, "shpere", "Did you mean sphere?"),
        (rigid, "Hinge", "Did you mean Hinges or hinge?"),
        (forces, "gravity", "module 'physjax.physics.forces' has no attribute 'gravity'. Did you mean Gravity?"),
        (forces, "Drag", "Did you mean QuadraticDrag or SphereDrag or StokesDrag?"),
        (contacts, "Floor", "Did you mean Plane?"),
        (methods, "runge_kutta", "Did you mean rk4?"),
        (methods, "velocity_verlet", "Did you mean verlet?"),
        (methods, "impicit_euler", "Did you mean implicit_euler"),
        (inertia, "cube", "Did you mean box?"),
        (lattices, "flag", "Did you mean cloth?"),
        (springs, "Spring", "Did you mean Springs?"),
        (springs, "zzz", "It has Rods, Ropes, Springs."),
        (emitters, "Circle", "Did you mean Disc"),
        (plot, "path", "Did you mean paths?"),
        (physjax, "run", "module 'physjax' has no attribute 'run'. Did you mean simulate?"),
        (physjax.physics, "collision", "Did you mean contacts?"),
    ],
)
def test_a_wrong_name_is_answered_by_the_right_one(place, name, words):
    assert not hasattr(place, name)
    with pytest.raises(AttributeError) as caught:
        getattr(place, name)
    assert words in str(caught.value)
    shown = traceback.format_exception_only(caught.value)[-1]
    assert shown.startswith("AttributeError: ")
    assert shown.count("Did you mean") <= 1, "Python adds no guess of its own"


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("from physjax import rk4", "cannot import name 'rk4' from 'physjax'. Did you mean methods.rk4?"),
        ("from physjax import Gravity", "Did you mean forces.Gravity?"),
        ("from physjax import Drag", "Did you mean forces.QuadraticDrag or forces.SphereDrag or forces.StokesDrag?"),
        ("from physjax import simulat", "Did you mean simulate"),
        (
            "from physjax.physics import forcs",
            "cannot import name 'forcs' from 'physjax.physics'. Did you mean forces?",
        ),
        ("from physjax.stepping.methods import rk_4", "from 'physjax.stepping.methods'. Did you mean rk4?"),
        ("from physjax.scenes import SCENE", "Did you mean SCENES or scene"),
    ],
)
def test_a_wrong_import_is_answered_by_the_right_name(statement, words):
    with pytest.raises(ImportError) as caught:
        exec(statement, {})
    assert words in str(caught.value)
    with pytest.raises(ImportError, match=r"^cannot import name '_rk4' from 'physjax' \("):
        exec("from physjax import _rk4", {})


def test_a_name_of_a_namespace_is_found_where_it_is():
    assert not hasattr(physjax, "rk4")
    with pytest.raises(
        AttributeError, match=r"module 'physjax' has no attribute 'gravity'\. Did you mean forces\.Gravity\?"
    ):
        _ = physjax.gravity


def test_names_that_python_asks_for_are_refused_as_ever():
    with pytest.raises(AttributeError, match=r"^module 'physjax\.physics\.forces' has no attribute '__wrapped__'$"):
        _ = forces.__wrapped__
    assert getattr(rigid.Shape, "_missing", 3) == 3
    assert isinstance(sys.modules["physjax.physics.forces"].__getattr__, type(lambda: 0))


def test_every_synonym_leads_to_a_name_that_there_is():
    known = ARGUMENTS.union(*map(dir, PLACES), dir(rigid.PlanarShape), dir(rigid.Shape))
    meant = {name for names in SYNONYMS.values() for name in names}
    assert meant <= known, meant - known
    assert all(word == word.lower().replace("_", "") for word in SYNONYMS), "as they are looked up"


def test_a_suggestion_is_one_of_the_names():
    assert suggest_names("timestep", ["dt", "steps"]) == "Did you mean dt?"
    assert suggest_names("timestep", ["mass"]) == "It has mass."
    assert suggest_names("qqq", [f"name_{i}" for i in range(40)]) == ""
    assert suggest_names("circle", []) == ""


@pytest.mark.usefixtures("unannotated")
def test_a_wrong_argument_is_answered_too(monkeypatch):
    monkeypatch.setattr(tracebacks, "_shorten", lambda error: error)  # as without the frames that tests want to see
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)))
    with pytest.raises(TypeError, match=r"argument 'timestep'\. Did you mean dt\? It takes scene, method, dt, steps="):
        simulate(scene, methods.rk4, timestep=0.1, steps=3)
    with pytest.raises(TypeError, match=r"argument 'masses'\. Did you mean mass\? It takes state, mass="):
        Scene(scene.state, masses=2.0)
    with pytest.raises(TypeError, match=r"argument 'spin'\. Did you mean angular_velocity\?"):
        forces.SpinLift(radius=0.03, spin=3.0)
    with pytest.raises(TypeError, match=r"argument 'spin'\. Did you mean axis\?"):
        forces.Magnus(area=1.0, coefficient=1.0, spin=3.0)
    with pytest.raises(TypeError, match=r"argument 'anchors'\. Did you mean points\?"):
        rigid.Rods([(-1, 0)], anchors=[(0.0, 0.0)])
    with pytest.raises(TypeError, match=r"argument 'segments'\. Did you mean panels\?"):
        lattices.bridge(4.0, 0.5, segments=6, mass=1.0, stiffness=100.0)


def test_a_wind_of_a_cloth_is_told_to_who_asks_for_one():
    with pytest.raises(AttributeError, match=r"QuadraticDrag or InAir\? A cloth has a wind of its own: sheet\.wind"):
        _ = forces.Wind
