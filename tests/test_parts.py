"""What a force can do by default, how any callable becomes one, and what a step consists of."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Force, Particles, Pins, Scene, contacts, emitters, forces, lattices, methods, simulate
from physjax.memory_masks import has_memory
from physjax.parts import Function, adopt_force


def falling(*, forces=(), contacts=(), **options):
    state = Particles(jnp.array([[0.0, 0.1], [1.0, 2.0]]), jnp.array([[1.0, -2.0], [0.0, -1.0]]))
    return Scene(state, 2.0, forces, contacts, **options)


def floor(response):
    return contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=response)


class Push(Force):
    """A force that says nothing but what it is."""

    def __call__(self, t, state, mass):
        return jnp.ones_like(state.velocity)


class Leak(eqx.Module):
    """A user's module that is not derived from `Force`: a jet whose pressure falls step by step."""

    couples: ClassVar[bool] = False
    pressure: jax.Array
    area: jax.Array

    def __call__(self, t, state, mass):
        return jnp.broadcast_to(self.pressure * self.area, state.velocity.shape)

    def advance(self, t, dt, state):
        return Leak(self.pressure * (1 - dt), self.area), state


# abilities


def test_a_force_that_says_nothing_has_no_ability():
    push = Push()
    flags = (push.couples, push.is_field, push.has_potential, push.jumps, push.has_linearisation, push.remembers)
    assert flags == (False,) * 6
    assert push.potential(0.0, None, None) is None
    assert push.averaged_over_step(0.0, 0.1, None) is push
    assert push.linearised_at(0.0, None, None) is push
    assert push.discontinuities() == ()
    assert push.advance(0.0, 0.1, "state") == (push, "state")
    assert (push.weight, push.up_axis, push.under((9.8, 1))) == (None, None, push)


def test_abilities_are_seen_where_they_are_defined():
    sheet = lattices.rope((0.0, 0.0), (1.0, 0.0), 3, mass=0.3, stiffness=10.0)
    brittle = lattices.rope((0.0, 0.0), (1.0, 0.0), 3, mass=0.3, stiffness=10.0, breaks_at=0.1)
    assert forces.Gravity().has_potential
    assert forces.Gravity().is_field
    assert forces.Gravity().up_axis == 1
    assert forces.Kick((1.0, 0.0), at=0.5, duration=0.1).jumps
    assert sheet.springs.has_linearisation
    assert (sheet.springs.remembers, brittle.springs.remembers) == (False, True)
    assert not forces.QuadraticDrag(area=1.0, coefficient=1.0).has_potential


# adopting what users bring


def test_a_plain_function_is_adopted_as_a_force_that_couples():
    (force,) = falling(forces=(lambda t, state, mass: -state.velocity,)).forces
    assert isinstance(force, Force)
    assert isinstance(force, Function)
    assert force.couples
    (single,) = falling(forces=(forces.independent(lambda t, state, mass: -state.velocity),)).forces
    assert not single.couples


def test_a_module_of_the_users_own_keeps_its_class_its_fields_and_its_abilities():
    leak = Leak(jnp.asarray(3.0), jnp.asarray(0.5))
    adopted = adopt_force(leak)
    assert isinstance(adopted, Leak)
    assert isinstance(adopted, Force)
    assert (type(adopted).__name__, type(adopted).__module__) == ("Leak", __name__)
    assert type(adopt_force(leak)) is type(adopted)
    assert adopted.remembers
    assert not adopted.has_potential
    assert not adopted.couples
    paths = lambda tree: [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(tree)]  # noqa: E731
    assert sorted(paths(adopted)) == sorted(paths(leak)) == [".area", ".pressure"]
    assert adopt_force(adopted) is adopted


def test_an_adopted_force_runs_and_its_memory_is_kept():
    film = simulate(falling(forces=(Leak(jnp.asarray(3.0), jnp.asarray(0.5)),)), methods.euler, dt=0.1, steps=3)
    np.testing.assert_allclose(film.parts[0].pressure, 3.0 * 0.9 ** np.arange(4), rtol=1e-12)
    # v += dt (p A / m), with the pressure at the start of each step
    gained = 0.1 * 0.5 / 2.0 * 3.0 * np.sum(0.9 ** np.arange(3))
    np.testing.assert_allclose(film.velocity[-1] - film.velocity[0], gained, rtol=1e-12)


def test_a_module_that_does_not_say_whether_it_couples_counts_as_coupling():
    class Silent(eqx.Module):
        strength: float

        def __call__(self, t, state, mass):
            return self.strength * state.position

    assert falling(forces=(Silent(2.0),)).couples


# what a step changes


def named(mask):
    return {jax.tree_util.keystr(path) for path, changes in jax.tree.leaves_with_path(mask) if changes}


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (lambda: falling(forces=(forces.Gravity(),)), set()),
        (lambda: falling(forces=(Leak(jnp.asarray(3.0), jnp.asarray(0.5)),)), {".forces[0].pressure"}),
        (lambda: falling(contacts=(floor(contacts.project),)), set()),
        (lambda: falling(contacts=(floor(contacts.impact),)), {".contacts[0].touching_since"}),
    ],
    ids=["gravity", "leak", "projected floor", "timed floor"],
)
def test_changing_marks_the_state_and_memories_and_nothing_else(scene, expected):
    found = named(scene().changing())
    assert {name for name in found if not name.startswith(".state")} == expected
    assert {".state.position", ".state.velocity"} <= found


def test_changing_marks_the_births_of_an_emitter():
    fountain = emitters.Emitter(4, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=1.0, rate=2.0)
    scene = Scene(fountain.unborn(), forces=(forces.Gravity(),), emitter=fountain)
    changed = {name for name in named(scene.changing()) if name.startswith(".emitter")}
    assert changed == {f".emitter.{name}" for name in fountain.memory}


@pytest.mark.parametrize("response", [contacts.project, contacts.impact])
def test_what_is_not_marked_does_not_change_in_a_step(response):
    scene = falling(forces=(forces.Gravity(), Leak(jnp.asarray(3.0), jnp.asarray(0.5))), contacts=(floor(response),))
    after = scene.step(methods.rk4, 0.0, 0.1)
    mask = scene.changing()
    for fixed, a, b in zip(*map(jax.tree.leaves, (mask, scene, after)), strict=True):
        if not fixed:
            np.testing.assert_array_equal(a, b)


# stages


def stage_names(scene):
    return [
        stage.name if stage.part is None else (stage.name, stage.part) for stage in scene.stages(methods.rk4, 0.0, 0.1)
    ]


def test_a_free_step_is_one_stage():
    assert stage_names(falling(forces=(forces.Gravity(),))) == ["move"]
    assert stage_names(falling(contacts=(floor(contacts.impact),))) == ["move"]


def test_stages_come_in_the_order_of_the_step():
    leak, ground = Leak(jnp.asarray(3.0), jnp.asarray(0.5)), floor(contacts.project)
    wall = contacts.Plane((9.0, 0.0), (-1.0, 0.0), restitution=0.5, response=contacts.project)
    scene = falling(forces=(forces.Gravity(), leak), contacts=(ground, wall), pinned=jnp.array([True, False]))
    expected = ["move", ("resolve contacts", 0), ("resolve contacts", 1), "prescribe", ("advance memory", 1)]
    assert stage_names(scene) == expected


def test_stages_one_after_the_other_are_the_step():
    state = Particles(jnp.array([[0.0, 0.05], [1.0, 0.1]]), jnp.array([[0.0, 0.0], [0.0, -1.0]]))
    hand = Pins(jnp.array([True, False]), path=lambda t: jnp.stack([jnp.sin(t), 0.05 - t]))
    scene = Scene(
        hand.prepare(state).prescribe(0.0, state),
        forces=(forces.Gravity(), Leak(jnp.asarray(3.0), jnp.asarray(0.5))),
        contacts=(floor(contacts.project),),
        pinned=hand,
    )
    now, seen = scene, []
    for stage in scene.stages(methods.verlet, 0.0, 0.1):
        now = stage.run(now)
        seen.append((stage.name, now.state.position))
    whole = scene.step(methods.verlet, 0.0, 0.1)
    for a, b in zip(jax.tree.leaves(now), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b)
    places = dict(seen)
    # the hand goes through the floor: it is put back by the contact, and then on its path again
    assert places["move"][0, 1] < 0
    assert places["resolve contacts"][0, 1] == 0
    np.testing.assert_allclose(places["prescribe"][0], [np.sin(0.1), -0.05], rtol=1e-12)


def test_parts_with_memory_are_known_without_a_step():
    scene = falling(
        forces=(forces.Gravity(), Leak(jnp.asarray(1.0), jnp.asarray(1.0))), contacts=(floor(contacts.impact),)
    )
    assert [has_memory(part) for part in (*scene.forces, *scene.contacts, scene.emitter)] == [False, True, True, False]
