"""A mistake is read in a few lines: the user's own, and a sentence that says what is wrong, which is the last."""

import json
import math
import re
import subprocess
import sys
import traceback

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import (
    Particles,
    Scene,
    aim_at,
    contacts,
    explore,
    forces,
    inertia,
    lattices,
    methods,
    rigid,
    simulate,
    springs,
)

LONGEST = 15
THREE = Particles(jnp.zeros((3, 2)), jnp.ones((3, 2)))
BALL = Particles(jnp.zeros(2), jnp.ones(2))
FALL = Scene(BALL, forces=(forces.Gravity(),))


def under(force):
    return Scene(THREE, forces=(force,))


def run(method=methods.rk4, scene=FALL, **options):
    return simulate(scene, method, **({"dt": 0.01, "steps": 2} | options))


def decide(t, state, mass):
    if state.position[0, 0] > 0:
        return -state.velocity
    return 0 * state.velocity


def hurry(system, t, state, dt):
    return state if state.position[1] > 0 else methods.euler(system, t, state, dt)


def misspell(t, state, mass):
    return -state.velocty


def assign(t, state, mass):
    push = 0 * state.velocity
    push[:, 1] = -9.8
    return push


def sway(t):
    return jnp.array([0.0, 0.1]) if t > 1 else jnp.zeros(2)


def fail(t, state, mass):
    try:
        return {}["wind"]
    except KeyError as error:
        raise RuntimeError("no wind is known") from error


MISTAKES = {
    "`if` in a force": (lambda: under(decide), "e.g. def drag"),
    "NumPy in a force": (lambda: under(lambda t, state, mass: -np.sin(state.velocity)), "e.g. def drag"),
    "math in a force": (lambda: under(lambda t, state, mass: math.sin(t) * state.velocity), "e.g. def drag"),
    "float() in a force": (lambda: under(lambda t, state, mass: float(t) * state.velocity), "e.g. def drag"),
    "a force of wrong shape": (lambda: under(lambda t, state, mass: state.velocity[:, 0]), "e.g. def drag"),
    "a force of wrong dtype": (lambda: under(lambda t, state, mass: state.velocity > 0), "e.g. def drag"),
    "a force without return": (lambda: under(lambda t, state, mass: None), "e.g. def drag"),
    "a force of a list": (lambda: under(lambda t, state, mass: [0.0, -1.0]), "e.g. def drag"),
    "a force of one argument": (lambda: under(lambda state: state.velocity), "e.g. def drag"),
    "shapes that do not meet in a force": (
        lambda: under(lambda t, state, mass: state.velocity * jnp.ones(5)),
        "(?i)incompatible shapes",
    ),
    "a misspelt field in a force": (lambda: under(misspell), "Did you mean: 'velocity'"),
    "an array that is written to": (lambda: under(assign), r"x.at\[idx\].set"),
    "`if` in a method": (lambda: run(hurry), r"hurry \(test_tracebacks.py, line \d+\) decides by .*\nWrite jnp.where"),
    "a method of two arguments": (lambda: run(lambda state, dt: state), "takes 2 positional arguments but 4"),
    "`if` in what is recorded": (
        lambda: run(record=lambda t, state: 1.0 if state.position[0] > 0 else 0.0),
        "decides by .*\nWrite jnp.where",
    ),
    "a record of one argument": (lambda: run(record=lambda state: state), "takes 1 positional argument but 2"),
    "a method by its name": (lambda: run("rk4"), "e.g. methods.rk4"),
    "a negative dt": (lambda: run(dt=-0.01), "expected numbers > 0"),
    "a dt that is no number": (lambda: run(dt=float("nan")), "expected finite numbers"),
    "half a step": (lambda: run(steps=2.5), "expected an integer"),
    "neither steps nor duration": (lambda: run(steps=None), "expected exactly one of them"),
    "no mass": (lambda: Scene(BALL, mass=0.0), "expected numbers > 0"),
    "masses of other lanes": (lambda: Scene(THREE, mass=jnp.ones(5)), r"expected \(\) or the lanes' shape \(3,\)"),
    "a mass in words": (lambda: Scene(BALL, mass="1 kg"), "expected real numbers"),
    "a list as state": (lambda: Scene([[0.0, 0.0]]), "expected Particles"),
    "a force without a comma": (lambda: Scene(BALL, forces=forces.Gravity()), r"Write forces=\(force,\)"),
    "a class as a force": (lambda: under(forces.Gravity), "Call it"),
    "a contact without a comma": (
        lambda: Scene(BALL, contacts=contacts.Plane((0.0, 0.0), (0.0, 1.0))),
        r"Write contacts=\(contact,\)",
    ),
    "pins of other lanes": (lambda: Scene(THREE, pinned=[True]), r"expected booleans of the lanes' shape"),
    "springs to nodes that are not there": (lambda: under(springs.Springs([(0, 7)], 10.0, 1.0)), "join 8 nodes"),
    "rods to nodes that are not there": (lambda: under(springs.Rods([(0, 7)], 1.0)), "the scene has 3 bodies"),
    "springs between numbers": (lambda: springs.Springs([(0.0, 1.0)], 10.0, 1.0), "expected integers"),
    "one number as friction": (
        lambda: contacts.Plane((0.0, 0.0), (0.0, 1.0), coulomb=0.5),
        r"expected contacts.Coulomb\(static=0.5",
    ),
    "friction in words": (lambda: contacts.Plane((0.0, 0.0), (0.0, 1.0), friction="rough"), "expected real numbers"),
    "a negative friction": (lambda: contacts.Plane((0.0, 0.0), (0.0, 1.0), friction=-1.0), "friction"),
    "a bounce that gains energy": (
        lambda: contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=2.0),
        "expected numbers from 0 to 1",
    ),
    "a plane without a normal": (lambda: contacts.Plane((0.0, 0.0), (0.0, 0.0)), "a vector that is not zero"),
    "a plane of another space": (
        lambda: Scene(BALL, contacts=(contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),)),
        r"expected a vector of shape \(2,\)",
    ),
    "`if` in a motion": (
        lambda: Scene(BALL, contacts=(contacts.Plane((0.0, 0.0), (0.0, 1.0), motion=contacts.Motion(sway)),)),
        "decides by .*\nWrite jnp.where",
    ),
    "a force in words": (lambda: forces.Gravity("9.8"), "expected real numbers"),
    "a negative drag": (lambda: forces.StokesDrag(-0.2), "expected numbers >= 0"),
    "a keyword that is none": (
        lambda: Scene(BALL, force=()),
        r"keyword argument 'force'\. Did you mean forces\? It takes state, mass=, forces=",
    ),
    "a keyword of a part that is none": (
        lambda: forces.SpinLift(spin=3.0),
        r"'spin'\. Did you mean angular_velocity\? It takes \w+",
    ),
    "a run without a method": (lambda: simulate(FALL), "It takes scene, method, dt"),
    "bodies without inertia": (
        lambda: Scene(rigid.planar_bodies(inertia.planar_disc(1.0, 0.5), [[0.0, 0.0]])),
        "expected a PlanarInertia",
    ),
    "a cloth of one row": (lambda: lattices.cloth(1.0, 1.0, 1, 3, mass=1.0, structural=1.0), "expected at least 2"),
    "a target of another space": (lambda: aim_at(FALL, target=(1.0, 2.0, 3.0), speed=3.0), "as many components"),
    "a scene that there is not": (lambda: explore("projektile"), "Did you mean projectile"),
    "a slider that there is not": (
        lambda: explore(lambda speed: FALL, spede=(1, 2), duration=1.0),
        "of its own: speed",
    ),
}
CAUSED = {"an error of a force with a cause": (lambda: Scene(BALL, forces=(fail,)), "no wind is known")}


@pytest.fixture(scope="module")
def shown():
    """What Python prints of each mistake where annotations are not executed and no option of JAX is set."""
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_a_mistake_is_read_in_a_few_lines_that_end_in_what_is_wrong(shown):
    for name in MISTAKES:
        text, message = shown[name]
        assert len(text.splitlines()) <= LONGEST, text
        assert re.search(MISTAKES[name][1], text), text
        assert message in "\n".join(text.splitlines()[-5:]), text
        assert message.count("\n") <= 4


def test_the_line_of_the_user_within_a_force_is_shown(shown):
    text, _ = shown["a misspelt field in a force"]
    assert "return -state.velocty" in text
    assert text.count("physjax/tracebacks.py") == 1  # all that is seen of physjax
    assert "site-packages" not in text


def test_what_a_user_raises_keeps_its_reason(shown):
    text, _ = shown["an error of a force with a cause"]
    assert "KeyError: 'wind'" in text
    assert "direct cause" in text


def test_jax_shows_all_frames_where_it_is_asked_to():
    before = jax.config.jax_traceback_filtering
    jax.config.update("jax_traceback_filtering", "off")
    try:
        with pytest.raises(ValueError, match="mass") as raised:
            Scene(BALL, mass=0.0)
    finally:
        jax.config.update("jax_traceback_filtering", before)
    assert any(frame.filename.endswith("checks.py") for frame in traceback.extract_tb(raised.value.__traceback__))


def format_mistake(make):
    try:
        make()
    except Exception as error:
        error.__traceback__ = error.__traceback__.tb_next  # without the line above
        return "".join(traceback.format_exception(error)), str(error)
    return "nothing was raised", ""


if __name__ == "__main__":
    print(json.dumps({name: format_mistake(make) for name, (make, _) in (MISTAKES | CAUSED).items()}))
