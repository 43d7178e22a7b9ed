"""A scene in space is reduced to the plane by what its parts declare, a user's own parts included."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from physjax import Particles, Scene, accuracy, contacts, forces, methods, simulate
from physjax.checks import quantity
from physjax.parts import Contact, Field, Force
from physjax.study.ablation.planar import reduce_to_plane
from physjax.study.ablation.variants import _refers_to_lanes, list_variants
from physjax.vectors import broadcast_vector, cross, dot, norm, scale, unit

PLANES = pytest.mark.parametrize("across", [0, 1, 2])


def to_space(vector, across):
    return np.insert(np.asarray(vector, float), across, 0.0, axis=-1)


class Whirl(Force):
    """Drag relative to air that turns about a place, in a wind: a vector, a place, an axial number, and plain ones."""

    strength: Array = quantity("strength", "kg/s", at_least=0)
    breeze: Array = quantity("breeze", "m/s", kind="vector")
    eye: Array = quantity("eye of the whirl", "m", kind="place")
    turn: Array = quantity("rate of turn", "rad/s", kind="axial")
    squeeze: Array | None = quantity("squeeze", "1/s", kind="tensor", default=None)

    def __call__(self, t, state, mass):
        arm = state.position - broadcast_vector(self.eye, state.position)
        if state.position.shape[-1] == 3:
            around = cross(broadcast_vector(self.turn, arm), arm)
        else:
            around = jnp.stack([-self.turn * arm[..., 1], self.turn * arm[..., 0]], axis=-1)
        air = broadcast_vector(self.breeze, arm) + around
        if self.squeeze is not None:
            rows = jnp.broadcast_to(self.squeeze, (*arm.shape, arm.shape[-1]))
            air = air + jnp.sum(rows * arm[..., None, :], axis=-1)
        return scale(-self.strength * jnp.ones(arm.shape[:-1]), state.velocity - air)


class Bumper(Contact):
    """A ball of one's own in the way."""

    middle: Array = quantity("middle", "m", kind="place")
    size: Array = quantity("size", "m", above=0)

    def signed_distance(self, t, position):
        return norm(position - broadcast_vector(self.middle, position)) - self.size

    def respond(self, t, state):
        out = unit(state.position - broadcast_vector(self.middle, state.position))
        depth = jnp.minimum(self.signed_distance(t, state.position), 0.0)
        inward = jnp.where(depth < 0, jnp.minimum(dot(state.velocity, out), 0.0), 0.0)
        return Particles(state.position - scale(depth, out), state.velocity - scale(2 * inward, out))


def thrown(across, *parts, surfaces=(), place=0.0, mass=0.3):
    position = to_space([[0.0, 1.0], [0.5, 2.0]], across)
    position[..., across] = place
    state = Particles(jnp.asarray(position), jnp.asarray(to_space([[3.0, 1.0], [-2.0, 0.5]], across)))
    return Scene(state, mass, parts, surfaces)


def run_of(scene):
    return simulate(scene, methods.rk4, dt=0.01, steps=100, save_every=25)


@PLANES
def test_a_force_and_a_contact_of_ones_own_move_alike_in_space_and_in_the_plane(across):
    squeeze = np.insert(to_space([[0.1, 0.3], [-0.2, 0.4]], across), across, 0.0, axis=0)
    turn, eye = np.zeros(3), to_space([0.2, 0.1], across)
    turn[across], eye[across] = 1.7, -0.4
    whirl = Whirl(0.5, to_space([1.0, -0.5], across), eye, turn, squeeze)
    bumper = Bumper(eye, 0.3)
    scene = thrown(across, whirl, surfaces=(bumper,), place=-0.4)
    run = run_of(scene)
    flat, restore = reduce_to_plane(scene, run)
    assert flat.state.position.shape == (2, 2)
    found = run_of(flat)
    np.testing.assert_allclose(restore(found.state).position, run.position, rtol=0, atol=1e-13)
    np.testing.assert_allclose(restore(found.state).velocity, run.velocity, rtol=0, atol=1e-13)
    assert np.abs(run.position[-1] - run.position[0]).max() > 0.5


def test_every_law_of_ours_that_declares_its_numbers_is_reduced():
    spin = jnp.asarray([0.0, 0.0, 2.0])
    room = contacts.Room((-5.0, -5.0, -0.1), (5.0, 5.0, 0.1), response=contacts.project)
    slab = contacts.Slab((0.0, -6.0, 3.0), (0.0, 1.0, 0.0), 0.5, response=contacts.project)
    acting = (
        forces.Gravity(), forces.Magnus(4e-3, 1.0, spin), forces.RotatingFrame(spin), forces.Constant((1.0, 0.0, 0.0)),
        forces.Kick((0.0, 1.0, 0.0), 0.1, 0.2), forces.Anchor((0.0, 1.0, 0.0), 2.0),
        forces.Control([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 0.5), forces.Blast((0.0, 1.0, 0.0), 0.1, 1.0, 0.1, 0.2),
        forces.Buoyancy(1.2, 1e-3), forces.Gravitation(G=0.1),
    )  # fmt: skip
    scene = thrown(2, *acting, surfaces=(room, slab))
    run = run_of(scene)
    flat, restore = reduce_to_plane(scene, run)
    np.testing.assert_allclose(restore(run_of(flat).state).position, run.position, rtol=0, atol=1e-12)


class Undeclared(Force):
    pull: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, state, mass):
        return -self.pull * state.velocity


class Sideways(Field):
    """It looks at an axis that no declaration names."""

    g: Array = quantity("g", "m/s²")

    def acceleration(self, t, state, mass):
        return self.g * state.velocity + self.g * state.velocity[..., 2:3]


class Askew(Field):
    """It declares a number, and is another law in the plane."""

    g: Array = quantity("g", "m/s²")

    def acceleration(self, t, state, mass):
        return self.g * state.velocity * (state.velocity.shape[-1] - 1)


class Turned(Force):
    rotation: Array = quantity("orientation", "1", kind="rotation")

    def __call__(self, t, state, mass):
        return -state.velocity


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (Undeclared(0.1), "pull of Undeclared is not declared"),
        (forces.independent(lambda t, state, mass: -state.velocity), "plain function"),
        (Turned((1.0, 0.0, 0.0, 0.0)), "rotation of Turned is a rotation in space"),
        (Sideways(0.1), "Sideways"),
        (Askew(0.1), "Askew acts differently in the plane"),
        (Whirl(0.1, (0.0, 0.0, 1.0), np.zeros(3), np.zeros(3)), "breeze of Whirl leaves the plane"),
        (Whirl(0.1, np.zeros(3), np.zeros(3), (1.0, 0.0, 0.0)), "turn of Whirl leaves the plane"),
        (Whirl(0.1, np.zeros(3), np.zeros(3), np.zeros(3), np.eye(3)[::-1]), "squeeze of Whirl mixes the plane"),
        (Bumper((0.0, -9.0, 0.5), 1.0), "middle of Bumper is not in the plane"),
        (contacts.Sphere((0.0, -9.0, 0.5), 1.0), "center of Sphere is not in the plane"),
    ],
)
def test_what_cannot_be_reduced_gives_the_reason(part, reason):
    whole = thrown(2, forces.StokesDrag(0.1))
    run = run_of(whole)
    parts = {"surfaces": (part,)} if isinstance(part, Contact) else {}
    scene = thrown(2, *(() if parts else (part,)), **parts)
    found = reduce_to_plane(scene, run)
    assert isinstance(found, str)
    assert reason in found


class Optional(Force):
    """An option that is absent at None, and an alternative, which is not."""

    drag: Array = quantity("drag", "kg/s")
    lift: Array | None = quantity("lift", "kg/s", default=None)
    instead: Array | None = quantity("drag instead", "kg/s", default=None)
    couples: ClassVar[bool] = False

    def __call__(self, t, state, mass):
        force = -(self.drag if self.instead is None else self.instead) * state.velocity
        return force if self.lift is None else force + self.lift * state.velocity[..., ::-1]


def test_an_option_is_what_is_absent_as_if_it_were_zero():
    anchor = forces.Anchor((0.0, 0.0, 0.0), 2.0, 0.3)
    scene = thrown(2, Optional(0.1, 0.2, 0.3), anchor, forces.Gravitation(G=0.1, softening=0.2, gm=jnp.ones(2)))
    names = [variant.name for variant in list_variants(scene, run_of(scene), {})[0]]
    assert [name for name in names if ": " in name] == [
        "Optional: lift", "Anchor: rest_length", "Gravitation: softening",
    ]  # fmt: skip


class Pull(Field):
    """All lanes pull the first: every number is declared per lane."""

    couples: ClassVar[bool] = True
    strength: Array = quantity("strength", "1/s²")

    def acceleration(self, t, state, mass):
        return -self.strength * (state.position - jnp.mean(state.position, axis=-2, keepdims=True))


class Pairs(Pull):
    """It refers to lanes by their index."""

    pair: tuple = eqx.field(static=True, default=(0, 1))


def test_a_lane_goes_unless_a_force_may_refer_to_it_by_index():
    assert [_refers_to_lanes(part) for part in (Pull(1.0), Pairs(1.0), Undeclared(1.0))] == [False, True, False]
    scene = thrown(2, Pull(1.0))
    told = accuracy.ablate(
        scene, lambda f: f.position[-1, 0], method=methods.rk4, dt=0.1, duration=0.2, lanes={"other": 1}, seconds=0.0
    )
    assert told["other"].verdict == "needed"
    with pytest.raises(ValueError, match="Pairs refers to lanes"):
        accuracy.ablate(
            thrown(2, Pairs(1.0)), lambda f: f.position[-1, 0], method=methods.rk4, dt=0.1, duration=0.2, lanes={"x": 1}
        )
