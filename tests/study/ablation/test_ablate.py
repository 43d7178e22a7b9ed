"""What each part of a model is worth, where the true worth is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, accuracy, contacts, emitters, forces, lattices, methods, reference, simulate
from physjax.scenes import SCENES
from physjax.scenes.registry import read_table
from physjax.study.ablation.ablate import COSTLY, NEEDED, NEGLIGIBLE, NONE, UNRESOLVED, _judge_entries
from physjax.study.ablation.variants import list_pair_variants, list_variants

UNTIMED = {"seconds": 0.0}
YEAR = 365.25 * 86400.0


def test_the_air_hardly_lifts_a_steel_ball():
    air, steel, radius = 1.225, 7850.0, 0.01
    volume = 4 / 3 * np.pi * radius**3
    lift, weightless = forces.Buoyancy(air, volume, up=0), forces.Buoyancy(1e-14, volume, up=0)
    ball = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), steel * volume, (forces.Gravity(up=0), lift, weightless))
    told = accuracy.ablate(ball, lambda f: f.velocity[-1, 0], method=methods.rk4, dt=0.1, duration=1.0, **UNTIMED)
    # against what is left of the fall once the air has lifted: 0.016 %
    share = told["Buoyancy 1"].change / abs(told.whole.outcome)
    assert share == pytest.approx(air / steel / (1 - air / steel), rel=1e-9)
    assert [effect.verdict for effect in told.effects] == [NEEDED, NEGLIGIBLE, NONE]
    assert told["Gravity"].change == pytest.approx(9.8, rel=1e-9)


def test_which_law_of_drag_a_raindrop_needs_at_which_size():
    told = accuracy.ablate(
        SCENES["raindrop"]().scene, lambda f: f.velocity[-1, :, 0], method=methods.rk4, dt=0.01, duration=6.0, error=0.25,
        save_every=600, **UNTIMED,
    )  # fmt: skip
    diameter = read_table("raindrop_terminal_velocity.csv")["diameter_mm"]
    stokes, fast = told["SphereDrag: Stokes' law instead"], told["SphereDrag: quadratic law instead"]
    # creeping flow ends at 0.1 mm; a constant coefficient fits no small drop
    assert (stokes.verdicts[diameter <= 0.1] == NEGLIGIBLE).all()
    assert (stokes.verdicts[diameter >= 0.2] == NEEDED).all()
    assert (fast.verdicts[diameter <= 0.9] == NEEDED).all()
    assert (fast.verdicts[diameter >= 1.2] == NEGLIGIBLE).all()
    # by Stokes' law the speed is known: v∞ = 2 (ρ_w - ρ_a) g r² / 9η, approached as 1 - exp(-g't/v∞)
    terminal = 2 / 9 * (998.2 - 1.204) * 9.8 * (diameter / 2000) ** 2 / 1.813e-5
    known = -terminal * np.expm1(-9.8 * (1 - 1.204 / 998.2) * 6.0 / terminal)
    np.testing.assert_allclose(-stokes.outcome, known, rtol=1e-7)
    assert told["Buoyancy"].verdict == NEGLIGIBLE
    assert (told["SphereDrag"].verdicts == NEEDED).all()


@pytest.mark.slow
def test_which_planets_matter_to_the_earth_to_one_kilometre_over_a_year():
    scene = SCENES["solar_system"]().scene
    names = read_table("solar_system_de421.csv")["body"][: scene.state.lanes[0]].tolist()
    earth, sun = names.index("earthmoon"), names.index("sun")

    def from_the_sun(flight):
        at = flight.position[-1]
        return at[earth] - jnp.nan_to_num(at[sun])

    others = {name: names.index(name) for name in ("sun", "venus", "uranus", "neptune", "pluto")}
    told = accuracy.ablate(
        scene, from_the_sun, method=methods.rk4, dt=YEAR / 1464, duration=YEAR, save_every=1464, error=1e3, scale=1.0,
        lanes=others, **UNTIMED,
    )  # fmt: skip
    assert told.whole.numerical.max() < 100.0
    verdicts = {name: told[name].verdict for name in others}
    assert verdicts == dict(sun=NEEDED, venus=NEEDED, uranus=NEEDED, neptune=NEGLIGIBLE, pluto=NONE)
    fixed = [i for i in range(len(names)) if names[i] != "neptune"]
    without = Scene(
        Particles(*(leaf[np.array(fixed)] for leaf in scene.state)), scene.mass[np.array(fixed)],
        (forces.Gravitation(gm=scene.forces[0].gm[np.array(fixed)]),),
    )  # fmt: skip
    apart = []
    for one, order in ((scene, names), (without, [names[i] for i in fixed])):
        x = reference(one, [YEAR], rtol=1e-12, atol=1e-3).position[-1]
        apart.append(x[order.index("earthmoon")] - x[order.index("sun")])
    true = np.abs(apart[0] - apart[1]).max()
    assert told["neptune"].change.max() == pytest.approx(true, rel=0.01)


def test_bend_springs_in_a_taut_rope_pull_it_straight_as_the_dispersion_says():
    count, k, bend, stretch, m = 9, 50.0, 4.0, 1.4, 0.02
    rope = lattices.rope(
        (0.0, 0.0), (8.0, 0.0), count, mass=m * (count - 1), stiffness=k, bend=bend, length=8.0 / stretch
    )
    q, small, tau = np.pi / (count - 1), 1e-5, 1e-4
    lifted = np.asarray(rope.state.position) + small * np.sin(q * np.arange(count))[:, None] * np.array([0.0, 1.0])
    state = Particles(jnp.asarray(lifted), jnp.zeros_like(rope.state.position))
    told = accuracy.ablate(
        Scene(state, m, (rope.springs,), pinned=rope.nodes["ends"]),
        lambda f: f.velocity[-1, count // 2, 1] / (small * tau), method=methods.rk4, dt=1e-5, duration=tau, **UNTIMED,
    )  # fmt: skip
    # a stretched spring to the j-th neighbour on both sides: -2k (1 - L/l) (1 - cos jq)/m times the height
    taut = 2 * (1 - 1 / stretch) / m
    structural, bending = (taut * number * (1 - np.cos(j * q)) for j, number in ((1, k), (2, bend)))
    assert told.whole.outcome == pytest.approx(-structural - bending, rel=1e-4)
    found = told[f"Springs: those of {bend:g} N/m"]
    assert found.change == pytest.approx(bending, rel=1e-4)
    assert found.verdict == NEEDED


@pytest.mark.slow
def test_the_third_dimension_goes_where_nothing_needs_it():
    ball = Particles(jnp.asarray([0.0, 1.0, 0.5]), jnp.asarray([3.0, 4.0, 0.0]))
    spin = forces.Magnus(4.3e-3, 3.0, (0.0, 0.0, 3.0))
    floor = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.7, friction=0.2, response=contacts.project)
    parts = (forces.Gravity(), forces.QuadraticDrag(4.3e-3, 0.4, wind=(-2.0, 0.0, 0.0)), spin)
    run = {"method": methods.midpoint, "dt": 0.01, "duration": 1.5, "save_every": 50, **UNTIMED}
    told = accuracy.ablate(Scene(ball, 0.145, parts, (floor,)), lambda f: f.position[-1], **run)
    assert told["third dimension"].change.max() < 1e-12
    assert told["third dimension"].verdict == NONE
    assert told["Magnus"].verdict == told["QuadraticDrag: wind"].verdict == told["Plane: friction"].verdict == NEEDED
    assert told["third dimension"].flops < told.whole.flops
    text = str(told)
    assert [word for word in ("not timed", "verdict", "Plane: friction") if word not in text] == []
    assert len(told.plot().axes) == 1


def test_a_float32_program_counts_steps_as_simulate_does():
    with jax.enable_x64(False):
        ball = Scene(Particles(jnp.zeros(2), jnp.ones(2)), 0.1, (forces.Gravity(),))
        run = {"method": methods.rk4, "dt": 0.01, "duration": 2.0, "save_every": 200, **UNTIMED}
        told = accuracy.ablate(ball, lambda f: f.position[-1, 0], **run)
    assert told.dt == 0.01
    assert told["Gravity"].verdict == NONE  # it pulls across


@pytest.mark.slow
def test_what_is_born_stays_born_when_something_else_is_left_out():
    jet = emitters.Emitter(
        60, emitters.Point((0.0, 0.0, 0.0)), key=1, life=1.0, rate=50.0, speed=6.0, direction=(0, 1, 0)
    )
    fountain = Scene(jet.unborn(), 1e-3, (forces.Gravity(), forces.QuadraticDrag(1e-4, 0.4)), emitter=jet)
    told = accuracy.ablate(
        fountain, lambda film: film.position[-1, :, 1].max(), method=methods.midpoint, dt=0.01, duration=1.0, **UNTIMED
    )
    # without gravity the first to be born flies at its speed, but for the drag
    assert 3.0 < told["Gravity"].outcome < 6.0
    assert told["Gravity"].verdict == told["QuadraticDrag"].verdict == NEEDED
    assert told.notes == ("third dimension kept: particles are born in space",)


def test_the_third_dimension_stays_where_something_leaves_the_plane():
    ball = Particles(jnp.asarray([0.0, 1.0, 0.0]), jnp.asarray([3.0, 4.0, 0.0]))
    run = {"method": methods.rk4, "dt": 0.01, "duration": 0.1, **UNTIMED}
    tilted = contacts.Plane((0.0, -9.0, 0.0), (0.0, 1.0, 1.0), response=contacts.project)
    told = accuracy.ablate(Scene(ball, 0.1, (forces.Gravity(),), (tilted,)), lambda f: f.position[-1], **run)
    assert told.notes == ("third dimension kept: normal of Plane leaves the plane",)
    assert "third dimension kept" in str(told)


def test_a_verdict_weighs_the_change_against_what_counts_and_what_is_numerical():
    change, numerical, threshold = np.array([1e-9, 1e-4, 1.0, np.nan]), np.full(4, 1e-6), np.full(4, 1e-3)
    assert _judge_entries(change, numerical, numerical, threshold, False).tolist() == [NONE, NEGLIGIBLE, NEEDED, NEEDED]
    assert _judge_entries(change, numerical, numerical, threshold, True).tolist() == [NONE, COSTLY, NEEDED, NEEDED]


@pytest.mark.slow
def test_times_are_taken_side_by_side_and_what_costs_is_told():
    many = Particles(jnp.zeros((4000, 3)), jnp.ones((4000, 3)))
    # many terms that act on nothing, which take their time all the same
    field = forces.independent(lambda t, s, m: 1e-7 * jnp.sin(jnp.exp(jnp.sin(jnp.exp(jnp.sin(s.velocity))))))
    told = accuracy.ablate(
        Scene(many, 1.0, (forces.Gravity(), field)), lambda f: f.velocity[-1, 0, 0], method=methods.rk4, dt=0.01,
        duration=1.0, save_every=100, seconds=2.0,
    )  # fmt: skip
    found = told["<lambda>"]
    assert found.verdict == COSTLY
    assert found.saved > 0.1 * told.whole.seconds
    assert found.flops < told.whole.flops
    assert len(told.plot().axes) == 2


@pytest.mark.slow
def test_what_may_be_left_out_alone_and_two_at_once():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0))
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)), 1.0, (forces.Gravity(), forces.StokesDrag(0.1)), (floor,))
    alone, notes = list_variants(scene, simulate(scene, methods.rk4, dt=0.1, steps=2), {})
    assert [r.name for r in alone] == ["Gravity", "StokesDrag", "Plane", "Plane: timing of impacts"]
    assert notes == []
    found = list_pair_variants(scene)
    assert [r.name for r in found] == ["Gravity and StokesDrag", "Gravity and Plane", "StokesDrag and Plane"]
    assert [(len(r.scene.forces), len(r.scene.contacts)) for r in found] == [(0, 1), (1, 0), (1, 0)]


def test_bad_input_is_told_in_plain_words(unannotated):
    scene = Scene(Particles(jnp.zeros((2, 2)), jnp.ones((2, 2))), 1.0, (forces.Gravity(),))
    run = {"method": methods.rk4, "dt": 0.1, "duration": 1.0}
    with pytest.raises(TypeError, match="expected a function of the run"):
        accuracy.ablate(scene, 3.0, **run)
    with pytest.raises(ValueError, match="index into the last axis"):
        accuracy.ablate(scene, lambda f: f.position[-1], lanes={"moon": 2}, **run)


def test_damping_that_keeps_a_method_stable_is_not_called_none():
    swing = Scene(
        Particles(jnp.ones(1), jnp.zeros(1)),
        forces=(forces.Anchor(jnp.zeros(1), stiffness=100.0), forces.StokesDrag(10.0)),
    )
    found = accuracy.ablate(
        swing, lambda f: f.position[-1], method=methods.euler, dt=0.05, duration=10.0, scale=1.0, seconds=0.0
    )
    assert np.isfinite(found["StokesDrag"].outcome).all()
    assert found["StokesDrag"].verdict == UNRESOLVED
