"""Emitters: births are a closed form of slot and generation, and each particle lives from its own moment to its own end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, emitters, forces, methods, simulate
from physjax.backend import MIN_LANES_TO_SELECT

UP = (0.0, 1.0, 0.0)
HALF = (0.0, 0.5, 0.0)
MASS = 1e-3
FLOOR = contacts.Plane(point=(0.0, 0.0, 0.0), normal=UP, restitution=0.5, friction=0.1)
LECTURE = contacts.Plane(point=(0.0, 0.0, 0.0), normal=UP, restitution=0.5, friction=0.1, response=contacts.project)
DRAG = forces.QuadraticDrag(area=1e-5, coefficient=0.5, wind=(1.0, 0.0, 0.0))


def fountain(pool=1200, *, source=None, **options):
    """An emitter with something of everything."""
    options = {"rate": 1000.0, "life": 1.0, "speed": 5.0, "direction": UP, "cone": 0.4, "key": 3} | options
    options = {"speed_spread": 0.2, "life_spread": 0.1, "size_spread": 0.5} | options
    return emitters.Emitter(pool, source or emitters.Disc(HALF, UP, 0.2), **options)


def spray(emitter, *, loads=(DRAG,), touched=(LECTURE,), dtype=None):
    """The emitter in a scene with gravity."""
    return Scene(emitter.unborn(dtype), MASS, (forces.Gravity(), *loads), touched, emitter=emitter)


def thrown(emitter, age):
    """Where the particles of the last births are after an age [s], by the closed form."""
    birth = emitter.births(emitter.slot, emitter.generation)
    fall = 0.5 * 9.8 * np.asarray(age)[:, None] ** 2 * np.asarray(UP)
    return np.asarray(birth.position) + np.asarray(birth.velocity) * np.asarray(age)[:, None] - fall


@pytest.mark.parametrize("pool", [500, 2000])
@pytest.mark.parametrize("dt", [0.01, 0.9])
def test_a_throw_is_a_parabola_from_its_own_moment_on(pool, dt):
    """Also where slots are born more than once a step, and where births fall on the ends of steps (777 and 400 a second)."""
    for rate in (777.0, 400.0):
        scene = spray(fountain(pool, rate=rate, drop_oldest=True), loads=(), touched=())
        flight = simulate(scene, methods.rk4, dt=dt, steps=150)
        emitter, now = flight.final_scene.emitter, flight.time[-1]
        alive = np.asarray(emitter.alive(now))
        far = np.abs(thrown(emitter, emitter.age(now)) - flight.position[-1])[alive]
        assert alive.sum() > 300
        assert far.max() < 1e-11
        dead = np.asarray(flight.film.emitter.dies) <= np.asarray(flight.time)[:, None]
        assert dead.any()
        assert np.abs(flight.velocity)[dead].max() == 0.0


def test_nobody_is_born_twice_or_lost():
    """Over 10⁵ steps each birth number appears once, in order, at its time, however steps and births fall together."""
    emitter = fountain(7, rate=100.0, life=0.04, life_spread=0.0)
    seen = simulate(spray(emitter, loads=(), touched=()), methods.semi_implicit_euler, dt=0.01, steps=100_000)
    seen = np.asarray(seen.film.emitter.generation)
    numbers = np.sort(seen * 7 + np.arange(7))
    assert np.all(np.diff(seen, axis=0) >= 0)
    assert np.all(np.diff(seen, axis=0) <= 1)
    late = np.arange(100_001) - numbers[:, -1]
    assert np.all(np.abs(late) <= 1)
    assert late[-1] == 0
    assert np.all(np.diff(numbers[-1]) == 1)


def test_births_are_the_same_at_every_step_size():
    runs = [simulate(spray(fountain()), methods.rk4, dt=dt, duration=2.0).final_scene.emitter for dt in (0.02, 0.01)]
    assert np.array_equal(runs[0].generation, runs[1].generation)
    births = [run.births(run.slot, run.generation) for run in runs]
    assert all(np.abs(a - b).max() <= 1e-12 for a, b in zip(*births, strict=True))
    assert np.abs(runs[0].born - runs[1].born).max() <= 1e-12
    assert np.abs(runs[0].dies - runs[1].dies).max() <= 1e-12


@pytest.mark.slow
def test_a_run_resumed_at_any_frame_has_the_same_bits(precision):
    pool = 900 if precision.dtype == np.float32 else 3000
    floor = FLOOR if pool < MIN_LANES_TO_SELECT else LECTURE
    scene = spray(fountain(pool, rate=0.8 * pool), touched=(floor,), dtype=precision.dtype)
    whole = simulate(scene, methods.rk4, dt=0.02, steps=90, save_every=10)
    first = simulate(scene, methods.rk4, dt=0.02, steps=30, save_every=10)
    rest = simulate(first.final_scene, methods.rk4, dt=0.02, steps=60, save_every=10, first_step=first.final_step)
    for a, b in zip(jax.tree.leaves(whole.state), jax.tree.leaves(rest.state), strict=True):
        assert np.array_equal(a[3:], b)
    for name in emitters.Emitter.memory:
        assert np.array_equal(getattr(whole.final_scene.emitter, name), getattr(rest.final_scene.emitter, name))


@pytest.mark.parametrize(("pool", "precision"), [(3000, "float32")], indirect=["precision"])
def test_alone_and_in_a_batch_births_have_the_same_bits(precision, pool):
    """And the motion agrees to rounding, which is all that other shapes of a program allow."""

    def run(seed):
        emitter = fountain(pool, rate=0.8 * pool, key=jax.random.key(seed))
        flight = simulate(spray(emitter, dtype=precision.dtype), methods.rk4, dt=0.02, steps=60, save_every=60)
        last = flight.final_scene.emitter
        return flight.position[-1], (last.generation, last.born, last.dies), last.births(last.slot, last.generation)

    seeds = jnp.arange(3, dtype=jnp.uint32)
    batch = jax.jit(jax.vmap(run))(seeds)
    for i in range(3):
        alone = run(seeds[i])
        for a, b in zip(jax.tree.leaves(alone[1:]), jax.tree.leaves(batch[1:]), strict=True):
            assert np.array_equal(a, b[i])
        assert np.abs(alone[0] - batch[0][i]).max() <= 1e-5 * np.abs(alone[0]).max()


@pytest.mark.parametrize(("name", "precision"), [("disc", "float64"), ("shell", "float32")], indirect=["precision"])
def test_births_have_the_same_bits_in_every_program(precision, name):
    """Whether their numbers are arguments or constants that the compiler computes with, and in any part of the pool."""
    emitter = fountain(601, rate=500.0, source=SOURCES[name], direction=(0.6, 0.3, 0.2), cone=0.7)._cast(
        precision.dtype
    )
    slot, generation = emitter.slot, jnp.ones_like(emitter.slot)
    births = emitter.births(slot, generation)
    closed = jax.jit(lambda generation: emitter.births(slot, generation))(generation)
    part = emitter.births(slot[100:194], generation[100:194])
    for whole, constant, few in zip(births, closed, part, strict=True):
        assert np.array_equal(whole, constant)
        assert np.array_equal(whole[100:194], few)


def test_the_momentum_of_opposed_pairs_is_zero():
    emitter = fountain(400, rate=None, every=0.5, burst=100, opposed=True)
    births = emitter.births(emitter.slot, jnp.zeros_like(emitter.slot))
    assert np.array_equal(births.velocity[0::2], -births.velocity[1::2])
    assert np.array_equal(births.position[0::2], births.position[1::2])
    assert np.unique(np.abs(births.velocity[:, 1])).size == 200


def test_other_keys_have_the_same_statistics():
    """Means of speed, life, size, place and height within three standard errors of what the numbers say."""
    emitter = fountain(20_000, life_spread=0.3)
    births = emitter.births(emitter.slot, jnp.zeros_like(emitter.slot))
    other = fountain(20_000, life_spread=0.3, key=4)
    assert not np.array_equal(births.life, other.births(emitter.slot, jnp.zeros_like(emitter.slot)).life)
    mean_cosine = 0.5 * (1 + np.cos(0.4))
    speed = np.linalg.norm(births.velocity, axis=-1)
    expected = {
        "speed": (speed, 5.0),
        "life": (births.life, 1.0),
        "size": (births.size, 0.01),
        "x": (births.position[:, 0], 0.0),
        "z": (births.position[:, 2], 0.0),
        "radius": (np.hypot(births.position[:, 0], births.position[:, 2]), 0.2 * 2 / 3),
        "cosine": (births.velocity[:, 1] / speed, mean_cosine),
    }
    for name, (values, mean) in expected.items():
        values = np.asarray(values)
        assert abs(values.mean() - mean) < 3 * values.std() / np.sqrt(values.size), name


def test_number_alive_is_rate_times_life():
    flight = simulate(spray(fountain()), methods.semi_implicit_euler, dt=0.01, duration=4.0)
    alive = np.asarray(flight.film.emitter.alive(flight.time)).sum(axis=1)
    assert np.all(np.abs(alive[120:] - 1000) < 4 * np.sqrt(200 / 6))
    # one more at each birth; where that falls on a frame, rounding says on which side of it
    assert np.abs(alive[:80] - (1000 * np.asarray(flight.time[:80]) + 0.5)).max() < 0.5 + 1e-9


def test_bursts_come_together():
    emitter = fountain(400, rate=None, every=0.5, burst=100, start=0.25)
    flight = simulate(spray(emitter, loads=(), touched=()), methods.rk4, dt=0.1, steps=30)
    last, now = flight.final_scene.emitter, flight.time[-1]
    assert np.allclose(np.asarray(last.born).reshape(4, 100), np.asarray([[2.25], [2.75], [1.25], [1.75]]), atol=1e-14)
    alive = np.asarray(last.alive(now))
    assert np.abs(thrown(last, last.age(now)) - flight.position[-1])[alive].max() < 1e-12
    once = fountain(50, rate=None)
    flight = simulate(spray(once, loads=(), touched=()), methods.rk4, dt=0.1, steps=8)
    assert np.asarray(flight.film.emitter.alive(flight.time)).sum(axis=1).tolist() == [0] + [50] * 8


@pytest.mark.slow
def test_the_newly_born_forget_what_their_slot_lay_on():
    """Particles that come to rest on the floor and die there; the next ones fly as if nobody had been there."""
    floor = contacts.Plane(point=(0.0, 0.0, 0.0), normal=UP, restitution=0.0, friction=1.0)
    emitter = fountain(400, rate=100.0, life=3.0, speed=1.0, life_spread=0.0)
    flight = simulate(spray(emitter, loads=(), touched=(floor,)), methods.rk4, dt=0.02, duration=9.0)
    last, now = flight.final_scene.emitter, flight.time[-1]
    age = np.asarray(last.age(now))
    young, old = np.asarray(last.alive(now)) & (age < 0.3), np.asarray(last.alive(now)) & (age > 1.0)
    assert np.asarray(last.generation).min() >= 1
    assert young.sum() >= 29
    assert old.sum() >= 190
    assert np.abs(thrown(last, age) - flight.position[-1])[young].max() < 1e-12
    assert np.abs(flight.position[-1][old, 1]).max() < 1e-12
    assert np.abs(flight.velocity[-1][old]).max() == 0


@pytest.mark.slow
def test_a_landing_moves_with_speed_and_cone():
    """Gradients of the mean square distance of the landing points against central differences."""

    def distance(number):
        emitter = fountain(60, rate=None, life=2.0, life_spread=0.0, speed=number[0], cone=number[1])
        sticky = contacts.Plane(point=(0.0, 0.0, 0.0), normal=UP, restitution=0.0, friction=1.0)
        end = simulate(spray(emitter, touched=(sticky,)), methods.midpoint, dt=0.02, duration=1.6, save_every=80)
        x = end.position[-1]
        return jnp.mean(x[:, 0] ** 2 + x[:, 2] ** 2)

    at, h = jnp.asarray([5.0, 0.4]), 1e-5
    around = jax.jit(jax.vmap(distance))(at[None] + h * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))
    central = (around[:2] - around[2:]) / (2 * h)
    assert np.allclose(jax.jit(jax.jacfwd(distance))(at), central, rtol=1e-5)


SOURCES = {
    "point": emitters.Point(HALF),
    "disc": emitters.Disc(HALF, (0.6, 0.0, 0.8), 0.3),
    "box": emitters.Box((0.0, 1.0, 2.0), (0.5, 1.1, 4.0)),
    "ball": emitters.Sphere(HALF, 0.3),
    "shell": emitters.Sphere(HALF, 0.3, shell=True),
    "mesh": emitters.Mesh(
        np.asarray([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    ),
}
VARIANCE = {  # of x, y, z
    "point": (0, 0, 0),
    "disc": (0.09 / 4 * 0.64, 0.09 / 4, 0.09 / 4 * 0.36),
    "box": (0.25 / 12, 0.01 / 12, 4 / 12),
    "ball": (0.09 / 5,) * 3,
    "shell": (0.09 / 3,) * 3,
}


@pytest.mark.parametrize("name", SOURCES)
def test_sources_are_filled_evenly(name):
    u = jax.random.uniform(jax.random.key(0), (40_000, 3))
    place, outward = map(np.asarray, SOURCES[name](u))
    assert np.abs(np.linalg.norm(outward, axis=-1) - 1).max() < 1e-12
    if name == "mesh":
        vertices, faces = np.asarray(SOURCES[name].vertices[0]), np.asarray(SOURCES[name].faces[0])
        corner = vertices[faces]
        area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=-1)
        mean = area @ corner.mean(axis=1) / area.sum()
        inside = np.asarray([0.1, 0.2, 0.3])
        assert np.all(np.sum((place - inside) * outward, axis=-1) > 0)
    else:
        mean = np.asarray((0.25, 1.05, 3.0) if name == "box" else HALF)
        assert np.allclose(place.var(axis=0), VARIANCE[name], rtol=0.04, atol=1e-15)
    assert np.all(np.abs(place.mean(axis=0) - mean) <= 4 * place.std(axis=0) / 200 + 1e-12)
    if name in ("point", "box", "ball", "shell"):
        assert np.all(np.abs(outward.mean(axis=0)) < 4 / np.sqrt(3 * 40_000))
    if name == "box":
        assert np.abs(np.corrcoef(place.T, outward.T)[:3, 3:]).max() < 0.02


def test_in_the_plane_as_well():
    emitter = fountain(300, source=emitters.Sphere((0.0, 1.0), 0.1), rate=100.0, direction=(0.0, 1.0))
    scene = Scene(emitter.unborn(), MASS, (forces.Gravity(),), emitter=emitter)
    flight = simulate(scene, methods.rk4, dt=0.01, steps=100)
    last = flight.final_scene.emitter
    velocity = np.asarray(last.births(last.slot, jnp.maximum(last.generation, 0)).velocity)
    assert flight.ok.all()
    assert np.abs(np.arctan2(velocity[:, 0], velocity[:, 1])).max() <= 0.4


def test_a_look_goes_by_the_share_of_life():
    look = emitters.Look(size=(1.0, 3.0), colour=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), opacity=(0.0, 1.0, 0.0))
    emitter = fountain(300, rate=100.0, size_spread=0.0, life_spread=0.0, look=look)
    flight = simulate(spray(emitter), methods.rk4, dt=0.05, steps=60)
    film = flight.film.emitter
    seen, share = film.appearance(flight.time), np.asarray(film.age(flight.time))
    alive = np.asarray(seen.alive)
    assert seen.colour.shape == (61, 300, 3)
    assert np.all(np.asarray(seen.opacity)[~alive] == 0)
    assert np.allclose(np.asarray(seen.size)[alive], 0.01 * (1 + 2 * share[alive]), atol=1e-12)
    assert np.allclose(np.asarray(seen.opacity)[alive], 1 - np.abs(2 * share[alive] - 1), atol=1e-12)
    assert np.allclose(np.asarray(seen.colour)[alive][:, 2], share[alive], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate .*got 0.0, expected numbers > 0"),
        ({"life": -1.0}, "life .*got -1.0, expected numbers > 0"),
        ({"pool": 100}, "Give pool=1100, or drop_oldest=True"),
        ({"every": 1.0}, "expected one of them"),
        ({"rate": None, "burst": 10}, "without every="),
        ({"rate": None, "burst": 7, "every": 1.0}, "a divisor of the pool of 1200"),
        ({"direction": (0.0, 0.0, 0.0)}, "a vector that is not zero"),
        ({"opposed": True}, "expected bursts of an even number"),
        ({"cone": 4.0}, "from 0 to 3.1416"),
        ({"life_spread": 1.0}, "below 1"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_bad_numbers_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        fountain(**options)


@pytest.mark.usefixtures("unannotated")
def test_bad_scenes_are_refused():
    emitter = fountain()
    with pytest.raises(ValueError, match="Start from emitter"):
        Scene(Particles(jnp.zeros((3, 3)), jnp.zeros((3, 3))), emitter=emitter)
    with pytest.raises(ValueError, match="forces that couple the lanes"):
        Scene(emitter.unborn(), forces=(lambda t, state, mass: state.velocity,), emitter=emitter)
    with pytest.raises(ValueError, match="pinned= as well"):
        Scene(emitter.unborn(), pinned=jnp.zeros(1200, bool), emitter=emitter)
    with pytest.raises(TypeError, match="expected a seed"):
        fountain(key="seed")


def test_the_oldest_makes_way():
    emitter = fountain(100, drop_oldest=True)
    flight = simulate(spray(emitter), methods.rk4, dt=0.01, steps=100)
    alive = np.asarray(flight.film.emitter.alive(flight.time)).sum(axis=1)
    assert np.all(alive[12:] == 100)
    assert np.asarray(flight.final_scene.emitter.age(1.0)).max() < 0.1 + 1e-9


def test_saved_and_read_again(tmp_path):
    scene = spray(fountain())
    flight = simulate(scene, methods.rk4, dt=0.02, steps=20)
    flight.save(tmp_path / "spray.npz")
    again = type(flight).load(tmp_path / "spray.npz", scene=scene, method=methods.rk4)
    assert np.array_equal(again.film.emitter.dies, flight.film.emitter.dies)
    assert np.array_equal(again.final_scene.emitter.born, flight.final_scene.emitter.born)


def test_enough_particles_were_tried():
    """Windows slide over pools as large as this; smaller ones are done whole."""
    assert 1000 < MIN_LANES_TO_SELECT < 1200
