"""Numbers are what they are declared to be: held against the lanes when a scene is built, never guessed from a shape."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import (
    Force,
    Particles,
    Scene,
    contacts,
    emitters,
    forces,
    methods,
    projectile,
    quantity,
    rigid,
    simulate,
    springs,
    stability,
)
from physjax.backend import MIN_LANES_TO_CUT, MIN_STEPS_PER_FRAME
from physjax.physics.forces import flows
from physjax.physics.rigid import inertia
from physjax.stepping.blocks import Blocks

BALL = Particles(jnp.array([0.0, 1.0]), jnp.array([3.0, 4.0]))
TWO = np.array([0.1, 0.2])
NUMBERS = {
    "drag coefficient b": lambda n: forces.StokesDrag(n),
    "area": lambda n: forces.QuadraticDrag(n, 0.4),
    "drag coefficient C_d": lambda n: forces.QuadraticDrag(0.1, n),
    "density of the fluid": lambda n: forces.QuadraticDrag(0.1, 0.4, n),
    "radius": lambda n: forces.SphereDrag(n),
    "viscosity": lambda n: forces.SphereDrag(0.1, viscosity=n),
    "lift coefficient C_L": lambda n: forces.Magnus(0.1, n, 1.0),
    "spin axis": lambda n: forces.Magnus(0.1, 0.4, n),
    "volume": lambda n: forces.Buoyancy(1.0, volume=n),
    "surface of the fluid": lambda n: forces.Buoyancy(1.0, radius=0.1, surface=n),
    "stiffness": lambda n: forces.Anchor((0.0, 0.0), n),
    "rest length": lambda n: forces.Anchor((0.0, 0.0), 1.0, n),
    "damping": lambda n: forces.Anchor((0.0, 0.0), 1.0, damping=n),
    "start of the kick": lambda n: forces.Kick((1.0, 0.0), n, 0.02),
    "duration of the kick": lambda n: forces.Kick((1.0, 0.0), 0.0, n),
    "impulse": lambda n: forces.Blast((0.0, 0.0), n, 1.0, 0.0, 0.02),
    "reach of the blast": lambda n: forces.Blast((0.0, 0.0), 1.0, n, 0.0, 0.02),
    "omega": lambda n: forces.RotatingFrame(n),
    "omega_rate": lambda n: forces.RotatingFrame(1.0, n),
    "g": lambda n: forces.Gravity(n),
    "duration": lambda n: forces.Control([[1.0, 0.0]], n),
    "circulation": lambda n: flows.Vortex(1.0, n, 0.1, (0.0, 0.0)),
    "strength μ": lambda n: flows.Attractor(n, 0.1, (0.0, 0.0)),
}
PLANE = ((0.0, 0.0), (0.0, 1.0))
SURFACES = {
    "restitution K_r": lambda n, **about: contacts.Plane(*PLANE, restitution=n, **about),
    "friction K_f": lambda n, **about: contacts.Plane(*PLANE, friction=n, **about),
    "static friction μ_s": lambda n, **about: contacts.Plane(*PLANE, coulomb=contacts.Coulomb(n, 0.1), **about),
    "kinetic friction μ_k": lambda n, **about: contacts.Plane(*PLANE, coulomb=contacts.Coulomb(0.3, n), **about),
    "radius": lambda n, **about: contacts.Sphere((0.0, -1.0), n, **about),
    "thickness": lambda n, **about: contacts.Slab((0.0, -1.0), (0.0, 1.0), n, **about),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_of_one_ball_is_not_applied_by_component(name, unannotated):
    with pytest.raises(ValueError, match=rf"{name} \[.*\] has the shape \(2,\), expected a number of shape \(\)"):
        Scene(BALL, forces=(NUMBERS[name](TWO),))


@pytest.mark.parametrize("response", [contacts.impact, contacts.project])
@pytest.mark.parametrize("name", SURFACES)
def test_a_number_of_a_surface_is_not_applied_by_component(name, response, unannotated):
    surface = SURFACES[name](TWO, response=response)
    with pytest.raises(ValueError, match=rf"{name} \[.*\] has the shape \(2,\), expected a number of shape \(\)"):
        Scene(BALL, contacts=(surface,))


def test_what_is_nested_in_a_part_is_held_against_the_lanes_too(unannotated):
    brick = inertia.box(1.0, (0.1, 0.1, 0.1))
    spring = rigid.AtPoint((0.0, 0.1, 0.0), forces.Anchor((0.0, 0.0, 0.0), np.ones(3)))
    with pytest.raises(ValueError, match=r"stiffness \[N/m\] has the shape \(3,\), expected a number"):
        Scene(rigid.bodies(brick, (0.0, 0.0, 0.0)), brick, (spring,))


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_along_one_axis_of_the_lanes_must_say_which(name, unannotated):
    grid = Particles(jnp.ones((3, 3, 2)), jnp.ones((3, 3, 2)))
    number = np.linspace(0.1, 0.3, 3)
    with pytest.raises(ValueError, match=r"has the shape \(3,\), .* (Say which axis is meant|write Gravity)"):
        Scene(grid, forces=(NUMBERS[name](number),))
    Scene(grid, forces=(NUMBERS[name](np.broadcast_to(number[:, None], (3, 3))),))


# gravity, and what other engines are given


@pytest.mark.parametrize(
    ("given", "call"),
    [
        ((0.0, -9.8), r"Gravity\(vector=\(0.0, -9.8\)\)"),
        ((0.0, 0.0, -9.81), r"Gravity\(vector=\(0.0, 0.0, -9.81\)\)"),
        (-9.8, r"Gravity\(9.8\), with up=2 where z is up"),
    ],
)
def test_gravity_as_other_engines_take_it_is_refused_with_the_right_call(given, call, unannotated):
    with pytest.raises(ValueError, match=rf"^g .*expected a number >= 0: gravity points down the axis.*{call}"):
        forces.Gravity(given)


@pytest.mark.parametrize("vector", [(0.0, -9.8), (-3.0, -4.0), (0.0, 9.8), (2.0, 0.0)])
def test_gravity_as_a_vector_is_the_acceleration_of_a_falling_ball(vector):
    weight = forces.Gravity(vector=vector)
    fall = simulate(Scene(BALL, forces=(weight,)), methods.verlet, dt=0.1, steps=10)
    right = np.add([0.0, 1.0], [3.0, 4.0]) + 0.5 * np.asarray(vector)
    np.testing.assert_allclose(fall.position[-1], right, rtol=1e-12)
    energy = 0.5 * np.sum(np.square(fall.velocity), -1) + jax.vmap(lambda s: weight.potential(0.0, s, jnp.ones(())))(
        fall.state
    )
    np.testing.assert_allclose(energy, energy[0], rtol=1e-12)


def test_a_gravity_vector_along_an_axis_is_the_g_along_it():
    straight = forces.Gravity(vector=(0.0, 0.0, -1.62))
    assert (float(straight.g), straight.up, straight.vector) == (1.62, 2, None)


@pytest.mark.parametrize(
    ("about", "up"),
    [
        ({"vector": np.tile([0.0, 0.0, -9.8], (4, 1))}, 2),
        ({"vector": (0.1, 0.0, -9.8)}, 2),
        ({"vector": (0.1, -9.0, -1.0)}, 1),
        ({"vector": (0.0, 9.8, 0.0)}, 1),
        ({"vector": (0.1, 0.0, -9.8), "up": 1}, 1),
    ],
)
def test_the_axis_that_is_up_is_the_one_a_gravity_vector_pulls_against(about, up):
    state = Particles(jnp.zeros((4, 3)), jnp.ones((4, 3)))
    scene = Scene(state, forces=(forces.Gravity(**about),))
    assert scene.up == up
    np.testing.assert_allclose(scene.acceleration(0.0, state), np.broadcast_to(about["vector"], (4, 3)), rtol=1e-7)


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        (lambda: forces.Gravity(up="z"), r"up \(0: x, 1: y, 2: z\): got str 'z', expected an integer"),
        (lambda: forces.Gravity(up=True), "got bool True, expected an integer"),
        (lambda: forces.Gravity(up=-1), "got -1, expected at least 0"),
        (lambda: forces.Buoyancy(1.0, volume=1.0, up="z"), "got str 'z', expected an integer"),
        (lambda: forces.Gravity(5.0, vector=(0.0, -9.8)), "both g = 5.0 and a vector, expected one"),
        (lambda: forces.Gravity(up=2, vector=(0.0, -9.8, 0.0)), "up = 2, but a vector down the axis 1"),
        (lambda: Scene(BALL, forces=(forces.Gravity(up=2),)), "got axis 2, but places here have 2 components"),
        (lambda: Scene(BALL, forces=(forces.Gravity(vector=(0.0, 0.0, -9.8)),)), "got axis 2, but places here"),
    ],
)
def test_an_axis_or_a_gravity_that_cannot_be_is_refused_at_once(given, fault, unannotated):
    with pytest.raises((TypeError, ValueError), match=fault):
        given()


@pytest.mark.parametrize(
    ("weight", "axis"), [({"g": 1.62}, 1), ({"g": 9.81}, 1), ({"up": 2}, 2), ({"vector": (0, 0, -3)}, 2)]
)
def test_what_floats_in_balance_stays_where_only_gravity_is_told_g_and_up(weight, axis, precision):
    with jax.numpy_dtype_promotion("standard"):
        still = Particles(jnp.zeros(3, precision.dtype), jnp.zeros(3, precision.dtype))
        lift = forces.Buoyancy(1000.0, volume=0.5)
        scene = Scene(still, 500.0, (lift, forces.Gravity(**weight)))
    assert scene.forces[0].up == axis
    flight = simulate(scene, methods.rk4, dt=0.1, steps=100, save_every=100)
    assert float(jnp.abs(flight.position).max()) < 1e4 * precision.eps


@pytest.mark.parametrize(
    "parts",
    [
        (forces.Gravity(1.62), forces.Buoyancy(1.0, volume=1.0, g=9.8)),
        (forces.Gravity(), forces.Buoyancy(1.0, volume=1.0, up=0)),
        (forces.Gravity(), forces.Gravity(up=0)),
        (forces.Gravity(vector=(1.0, -9.0)), forces.Buoyancy(1.0, volume=1.0)),
    ],
)
def test_forces_that_disagree_about_gravity_are_refused(parts):
    with pytest.raises(ValueError, match=r"expected one (g and one )?axis"):
        Scene(BALL, forces=parts)


@pytest.mark.parametrize("angle", [45.0, -30.0, [0.5, 60.0]])
def test_an_angle_in_degrees_is_told(angle, unannotated):
    with pytest.warns(UserWarning, match=r"angle \[rad\]: got .* expected radians.*np.deg2rad"):
        projectile.horizontal_range(20.0, angle)


def test_components_that_come_first_are_refused():
    with pytest.raises(
        ValueError, match=r"got the shape \(3, 1000\), which is 3 particles of 1000 components.*transpose"
    ):
        Scene(Particles(jnp.zeros((3, 1000)), jnp.zeros((3, 1000))))


# tables, and lanes that are cut


class Lift(Force):
    """Updraft by height, from a table over 0 to 4 m that is the same for all lanes."""

    table: jax.Array

    def __call__(self, t, state, mass):
        y, table = state.position[..., 1], self.table.reshape(-1)
        lift = jnp.interp(y, jnp.linspace(0.0, 4.0, table.shape[0]), table)
        return jnp.stack([jnp.zeros_like(y), lift], axis=-1)


class DeclaredLift(Lift):
    """The same, declared."""

    table: jax.Array = quantity("lift over height", "N", per=None)


class Engine(Force):
    """A push along x with a thrust for each lane and a table of gears for all."""

    couples: ClassVar[bool] = False
    thrust: jax.Array = quantity("thrust", "N", at_least=0)
    gears: jax.Array = quantity("gear ratios", "1", per="table")

    def __call__(self, t, state, mass):
        push = jnp.broadcast_to(self.thrust * jnp.sum(self.gears), state.lanes)
        return jnp.stack([push, jnp.zeros_like(push)], axis=-1)


def crowd(count):
    rng = np.random.default_rng(0)
    place = np.stack([rng.uniform(-1, 1, count), rng.uniform(0.5, 2, count)], axis=-1)
    return place, rng.normal(size=(count, 2))


def tables(kind, entries):
    waves = np.sin(np.linspace(0.0, 9.0, entries))
    if kind == "Control":
        return forces.Control(np.stack([9 * waves, 3 * waves], axis=-1), duration=0.4)
    return (DeclaredLift if kind == "declared" else Lift)(jnp.asarray(5 * waves))


@pytest.mark.parametrize(
    ("count", "kind"),
    [
        (MIN_LANES_TO_CUT, "Control"),
        (MIN_LANES_TO_CUT, "declared"),
        (MIN_LANES_TO_CUT, "not declared"),
        pytest.param(1024, "Control", marks=pytest.mark.slow),
        pytest.param(1024, "not declared", marks=pytest.mark.slow),
    ],
)
def test_a_table_as_long_as_the_lanes_is_not_cut_with_them(count, kind):
    place, speed = crowd(count)
    force = tables(kind, count)
    floor = (contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.7),) if count == 1024 else ()
    some = np.arange(0, count, count // 8)

    def ends(lanes):
        state = Particles(jnp.asarray(place[lanes]), jnp.asarray(speed[lanes]))
        parts = (
            (forces.Gravity(), eqx.tree_at(lambda f: f, force, force))
            if kind != "not declared"
            else (forces.Gravity(), force)
        )
        scene = Scene(state, forces=parts, contacts=floor)
        steps = 4 * MIN_STEPS_PER_FRAME
        return simulate(scene, methods.euler, dt=0.0125, steps=steps, save_every=steps).position[-1]

    np.testing.assert_allclose(np.asarray(ends(slice(None)))[some], ends(some), atol=1e-12)


def test_lanes_are_cut_by_what_is_declared_and_stay_together_where_nothing_is():
    state = Particles(jnp.zeros((MIN_LANES_TO_CUT, 2)), jnp.zeros((MIN_LANES_TO_CUT, 2)))
    thrust = np.linspace(0.0, 1.0, MIN_LANES_TO_CUT)
    cut = lambda force: Blocks.of(Scene(state, forces=(force,)), state, MIN_STEPS_PER_FRAME) is not None  # noqa: E731
    assert cut(Engine(thrust, np.ones(4)))
    assert cut(Engine(thrust, np.ones(MIN_LANES_TO_CUT)))
    assert cut(DeclaredLift(jnp.ones(MIN_LANES_TO_CUT)))
    assert not cut(Lift(jnp.ones(MIN_LANES_TO_CUT)))
    assert not cut(Lift(jnp.ones((3, MIN_LANES_TO_CUT))))


def test_one_lane_of_two_keeps_a_vector_of_two_components_whole():
    state = Particles(jnp.array([[1.0, 0.0], [3.0, 0.0]]), jnp.zeros((2, 2)))
    scene = Scene(
        state, forces=(forces.Anchor((0.5, 0.25), np.array([1.0, 1e4])), flows.Vortex(0.1, 1.0, 1.0, (0.5, 0.25)))
    )
    told = stability.explain(scene, methods.verlet, 0.1, steps=12, lane=1)
    np.testing.assert_allclose(abs(told.rate), 100.0, rtol=1e-2)


# fields that are no numbers


class Switch(Force):
    """A force with a field that decides what is compiled."""

    way: object

    def __call__(self, t, state, mass):
        return state.velocity


@pytest.mark.parametrize(
    ("value", "advice"),
    [
        (True, r"the bool True.*way: bool = eqx.field\(static=True\)"),
        (3, r"the int 3.*way: int = eqx.field\(static=True\), or a float if it is a number: 3.0"),
        ("up", r"the str 'up'.*way: str = eqx.field\(static=True\)"),
        (jnp.sin, r"declare it with eqx.field\(static=True\)"),
    ],
)
def test_a_field_that_is_no_number_is_told_how_to_be_declared(value, advice):
    with pytest.raises(TypeError, match=rf"^Switch: the field way holds .*{advice}"):
        Scene(BALL, forces=(Switch(value),))


@pytest.mark.parametrize("about", [{"kind": "velocity"}, {"per": "scene"}])
def test_what_a_quantity_cannot_be_is_refused(about):
    with pytest.raises(ValueError, match="expected a kind of"):
        quantity("thrust", "N", **about)


# traced numbers beyond their bounds

G = (forces.Gravity(),)


def flight(**about):
    return simulate(Scene(**{"state": BALL, "forces": G, **about}), methods.rk4, dt=0.01, steps=2)


def on(shape, *numbers, **about):
    return flight(contacts=(shape(*numbers, response=contacts.project, **about),))


def floor(**about):
    return (contacts.Plane((0.0, 0.0), (0.0, 1.0), response=contacts.project, **about),)


def along(x, y):
    return jnp.stack([x + 0 * y, y])


TRACED = {
    "dt": (lambda q: simulate(Scene(BALL, forces=G), methods.rk4, dt=q, steps=2), 0.01, -0.01),
    "mass": (lambda q: flight(mass=q), 1.0, -1.0),
    "no mass": (lambda q: flight(mass=q), 1.0, 0.0),
    "g": (lambda q: flight(forces=(forces.Gravity(q),)), 9.8, -9.8),
    "linear drag": (lambda q: flight(forces=(forces.StokesDrag(q),)), 1.0, -1.0),
    "area": (lambda q: flight(forces=(forces.QuadraticDrag(q, 0.4),)), 0.1, -0.1),
    "stiffness": (lambda q: flight(forces=(forces.Anchor((0.0, 0.0), q),)), 5.0, -5.0),
    "infinite": (lambda q: flight(forces=(forces.Anchor((0.0, 0.0), q),)), 5.0, np.inf),
    "restitution": (lambda q: flight(contacts=floor(restitution=q)), 1.0, 1.5),
    "restitution < 0": (lambda q: flight(contacts=floor(restitution=q)), 0.0, -0.5),
    "friction": (lambda q: flight(contacts=floor(friction=q)), 0.5, 2.0),
    "kinetic over static": (lambda q: flight(contacts=floor(coulomb=contacts.Coulomb(0.5, q))), 0.5, 0.6),
    "g of the fluid": (
        lambda q: flight(forces=(forces.Gravity(q), forces.Buoyancy(1.0, volume=0.1, g=9.8))),
        9.8,
        5.0,
    ),
    "adaptive dt": (
        lambda q: simulate(Scene(BALL), methods.adaptive(methods.euler, atol=0.1, rtol=0.1), dt=q, steps=2),
        0.1,
        -0.1,
    ),
    "tolerance": (
        lambda q: simulate(Scene(BALL), methods.adaptive(methods.euler, atol=q, rtol=0.1), dt=0.1, steps=2),
        0.1,
        -0.1,
    ),
    "no direction": (
        lambda q: flight(contacts=(contacts.Plane((0.0, 0.0), jnp.stack([0 * q, q]), response=contacts.project),)),
        1.0,
        0.0,
    ),
    "sphere": (lambda q: on(contacts.Sphere, (0.0, -1.0), q), 0.5, -0.5),
    "room": (
        lambda q: flight(
            contacts=(contacts.Room((-9.0, -9.0), jnp.stack([9.0 + 0 * q, q]), response=contacts.project),)
        ),
        9.0,
        -10.0,
    ),
    "starts below": (
        lambda q: flight(contacts=(contacts.Plane(jnp.stack([0 * q, q]), (0.0, 1.0), response=contacts.project),)),
        1.0,
        1.1,
    ),
    "duration": (lambda q: flight(forces=(forces.Kick((1.0, 0.0), 0.0, q),)), 0.1, -0.1),
    "spring": (
        lambda q: flight(state=Particles(jnp.eye(2), jnp.zeros((2, 2))), forces=(springs.Springs([[0, 1]], q, 1.0),)),
        5.0,
        -5.0,
    ),
    "moment": (
        lambda q: simulate(
            Scene(_BODY, inertia.box(q, (0.1, 0.2, 0.3)), (forces.Gravity(),)), methods.euler, dt=0.01, steps=2
        ),
        1.0,
        -1.0,
    ),
}
_BODY = rigid.bodies(inertia.box(1.0, (0.1, 0.2, 0.3)), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("name", TRACED)
def test_a_traced_number_beyond_its_bounds_is_a_status_of_its_lane(name, unannotated):
    run, good, bad = TRACED[name]
    if name not in ("moment", "spring"):
        with pytest.raises(ValueError, match="expected"):
            run(bad)
    values = jnp.array([good, bad, good])
    ok, ends = jax.jit(jax.vmap(lambda q: (lambda f: (f.ok, f.final_scene.state.position))(run(q))))(values)
    np.testing.assert_array_equal(ok, [True, False, True])
    np.testing.assert_array_equal(ends[0], ends[2])
    np.testing.assert_allclose(ends[0], run(good).final_scene.state.position, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("bad", [pytest.param("life", marks=pytest.mark.slow), "drag"])
def test_a_birth_does_not_put_right_what_a_traced_number_has_spoilt(bad):
    def run(q):
        life, drag = (q, 1.0) if bad == "life" else (1.0, jnp.stack([jnp.ones_like(q), q, jnp.ones_like(q)]))
        jet = emitters.Emitter(3, emitters.Point((0.0, 0.0)), key=1, life=life, rate=100.0, drop_oldest=True)
        scene = Scene(jet.unborn(), 1e-3, (forces.StokesDrag(drag),), emitter=jet)
        return simulate(scene, methods.euler, dt=0.01, steps=3).ok

    right = [True, True, True]
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(run))(jnp.array([1.0, -1.0])), [right, [False] * 3 if bad == "life" else [True, False, True]]
    )


def test_one_bad_lane_among_traced_ones_harms_no_other():
    drag = jnp.array([1.0, -1.0, 0.5])
    state = Particles(jnp.zeros((3, 2)), jnp.ones((3, 2)))
    run = jax.jit(lambda drag: simulate(Scene(state, forces=(forces.StokesDrag(drag),)), methods.rk4, dt=0.1, steps=5))
    flight = run(drag)
    np.testing.assert_array_equal(flight.ok, [True, False, True])
    np.testing.assert_array_equal(flight.first_bad_step, [-1, 1, -1])
    assert stability.explain(flight).cause == "input"
    assert "a traced number beyond its bounds" in str(stability.explain(flight, lane=1))
    good = simulate(Scene(state, forces=(forces.StokesDrag(jnp.abs(drag)),)), methods.rk4, dt=0.1, steps=5)
    np.testing.assert_allclose(flight.position[-1, ::2], good.position[-1, ::2], rtol=1e-14)


def test_derivatives_of_good_lanes_pass_the_check_of_traced_numbers():
    def far(q):
        return flight(forces=(forces.StokesDrag(q), *G), contacts=floor(restitution=q / 2)).position[-1, 0]

    h = 1e-5
    np.testing.assert_allclose(jax.grad(far)(1.0), (far(1.0 + h) - far(1.0 - h)) / (2 * h), rtol=1e-6)
