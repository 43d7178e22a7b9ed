"""Fast bodies, thin and curved surfaces, closing walls: nothing passes, balls roll, and failures are reported."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, inertia, methods, rigid, simulate, stability

G = 9.8
R, r = 1.0, 0.1
BALL, HULL = inertia.sphere(1.0, r), rigid.ContactPoints.sphere(r)


class Bowl(contacts.Surface):
    """The inside of a sphere of radius R about the origin, given by its signed distance alone."""

    def signed_distance(self, t, position):
        return R - jnp.sqrt(jnp.sum(position * position, axis=-1))


class Globe(contacts.Surface):
    """The outside of it, given by that alone."""

    def signed_distance(self, t, position):
        return jnp.sqrt(jnp.sum(position * position, axis=-1)) - R


class Pillar(contacts.Surface):
    """A post along z, given by its signed distance alone."""

    def signed_distance(self, t, position):
        return jnp.hypot(position[..., 0], position[..., 1]) - 0.1


class Sheet(contacts.Surface):
    """A plate of a millimetre with two sides, given by that alone."""

    def signed_distance(self, t, position):
        return jnp.abs(position[..., 0] + 0.3 * position[..., 1] - 1) / np.sqrt(1.09) - 5e-4


# nothing passes


def test_balls_meet_a_post_and_a_thin_plate_as_geometry_says_however_fast():
    """Straight lines past a post, mirrored in it where they are nearer than R + r, and in the plate behind it."""
    small, post, plate, path = 0.02, 0.3, 1.0, 4.6
    aside = np.linspace(0.0, 0.5, 40)
    speed = np.tile((100.0, 1000.0), 20)
    start = np.stack([np.full(40, -3.2), aside, 0 * aside], axis=-1)
    body, hull = inertia.sphere(0.01, small), rigid.ContactPoints.sphere(small)
    touching = (
        rigid.SurfaceContact(hull, contacts.Sphere((0.0, 0.0, 0.0), post)),
        rigid.SurfaceContact(hull, contacts.Slab((plate, 0.0, 0.0), (1.0, 0.0, 0.0), thickness=1e-3)),
    )
    bodies = rigid.bodies(body, jnp.asarray(start), velocity=jnp.asarray(speed[:, None] * np.eye(3)[0]))
    dt = jnp.asarray(path / 3 / speed)  # five radii of the post a step
    run = simulate(Scene(bodies, body, (), touching), methods.rk4, dt=dt, steps=3, save_every=3)

    x, v, left = start, np.tile(np.eye(3)[0], (40, 1)), np.full(40, path)
    hits = aside < post + small
    reach = np.where(hits, np.sqrt(np.maximum((post + small) ** 2 - aside**2, 0)), 0)
    normal = np.stack([-reach, aside, 0 * aside], axis=-1) / (post + small)
    way = np.where(hits, -reach - x[:, 0], 0)
    x, left = x + way[:, None] * v, left - way
    v = np.where(hits[:, None], v - 2 * normal[:, :1] * normal, v)
    x = x + left[:, None] * v
    face = plate - 5e-4 - small
    back = x[:, 0] > face
    x[:, 0], v[:, 0] = np.where(back, 2 * face - x[:, 0], x[:, 0]), np.where(back, -v[:, 0], v[:, 0])
    assert run.ok.all()
    assert hits.sum() == 25
    assert back.sum() > 14
    np.testing.assert_allclose(run.position[-1], x, atol=1e-9)
    np.testing.assert_allclose(run.state.momentum[-1] / 0.01 / speed[:, None], v, atol=1e-9)


@pytest.mark.slow
def test_no_corner_of_dice_and_rods_passes_a_thin_plate():
    """At 3 m/s and 60 Hz, tumbling, a plate of a millimetre: no corner is ever behind the face it came from."""
    rng, n = np.random.default_rng(0), 64
    sizes = np.where(np.arange(n)[:, None] % 2, (0.5, 0.02, 0.02), (0.04, 0.04, 0.04))
    place, velocity = np.zeros((n, 3)), rng.normal(size=(n, 3))
    place[:, 0], velocity[:, 0] = -0.6 - rng.uniform(0, 0.3, n), 3.0
    parts = (place, rng.normal(size=(n, 4)), velocity, rng.normal(size=(n, 3)) * 10)
    box, hull = inertia.box(0.1, jnp.asarray(sizes)), rigid.ContactPoints.box(jnp.asarray(sizes))
    plate = contacts.Slab((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), thickness=1e-3, restitution=0.8)
    bodies = rigid.bodies(box, *(jnp.asarray(part) for part in parts))
    run = simulate(Scene(bodies, box, (), (rigid.SurfaceContact(hull, plate),)), methods.rk4, dt=1 / 60, steps=45)
    corners = jax.vmap(lambda state: hull.arms(state) + state.position[None])(run.state)
    assert run.ok.all()
    assert float(corners[..., 0].max()) < -5e-4 + 1e-9


def test_a_body_that_straddles_a_plate_is_refused():
    box = inertia.box(1.0, (0.4, 0.4, 0.4))
    plate = contacts.Slab((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), thickness=1e-3)
    contact = rigid.SurfaceContact(rigid.ContactPoints.box((0.4, 0.4, 0.4)), plate)
    with pytest.raises(ValueError, match=r"on the wrong side, 0\.101 m deep"):
        Scene(rigid.bodies(box, (-0.1, 0.0, 0.0)), box, (), (contact,))


@pytest.mark.slow
def test_balls_keep_to_mirror_images_in_a_room_its_edges_and_corners_too():
    """Without a force the place in each direction is a triangle wave; the first ball flies straight into a corner."""
    rng, side, duration = np.random.default_rng(1), 1.0, 5.0
    x, v = rng.uniform(r + 0.01, side - r - 0.01, (64, 3)), rng.normal(size=(64, 3)) * 2
    x[0], v[0] = 0.5, 1.0
    room = contacts.Room((0.0, 0.0, 0.0), (side, side, side))
    bodies = rigid.bodies(BALL, jnp.asarray(x), velocity=jnp.asarray(v))
    run = simulate(
        Scene(bodies, BALL, (), (rigid.SurfaceContact(HULL, room),)), methods.rk4, dt=0.01, steps=500, save_every=500
    )
    width = side - 2 * r
    unfolded = np.mod(x - r + v * duration, 2 * width)
    right = r + np.where(unfolded > width, 2 * width - unfolded, unfolded)
    np.testing.assert_allclose(run.position[-1], right, atol=1e-9)


@pytest.mark.slow
def test_coupled_bodies_are_stopped_by_a_plate_and_non_finite_after_passing_a_ball():
    """Their impacts are resolved at the end of a step: a scene that has passed through a ball by then reports it."""
    places = jnp.array([[[-1.0, 0.0, 0.0], [-1.0, 5.0, 0.0]], [[-1.0, 2.0, 0.0], [-1.0, 5.0, 0.0]]])
    bodies = rigid.bodies(BALL, places, velocity=jnp.array([[100.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    spring = rigid.Joints([(0, 1)], [[[0.0, 0.0, 0.0], [0.0, -5.0, 0.0]]], stiffness=1e-3)
    through = contacts.Sphere((0.0, 0.0, 0.0), 0.3)
    stopped = contacts.Slab((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), thickness=1e-3)
    runs = [
        simulate(
            Scene(bodies, BALL, (spring,), (rigid.SurfaceContact(HULL, surface),)), methods.rk4, dt=1 / 60, steps=3
        )
        for surface in (through, stopped)
    ]
    assert runs[0].ok.tolist() == [False, True]
    assert runs[1].ok.all()
    assert (runs[1].position[-1, :, 0, 0] < 0).all()


def darts(n):
    """Starts and velocities of fast particles, past and onto a post and a plate behind it."""
    x, v = np.zeros((n, 2)), np.zeros((n, 2))
    x[:, 0], x[:, 1] = -1 - np.linspace(0, 1, n) * np.pi % 1, np.linspace(-0.2, 0.2, n)
    v[:, 0] = np.linspace(0, 1, n) * np.e % 1 * 4 + 2
    return Particles(jnp.asarray(x), jnp.asarray(v))


def test_a_users_shape_is_met_however_thin_it_is():
    """Straight on for a second: from the signed distance alone a post is met as a circle is, a plate as a line."""
    start = darts(200)
    end = Particles(start.position + start.velocity, start.velocity)
    missing = jnp.full(200, jnp.nan), jnp.zeros(200)

    @jax.jit
    def look(start, end):
        shapes = Pillar(), Sheet()
        return [(s.deepest(0.0, 1.0, start, end, missing), s.may_dip(0.0, 1.0, start, end)) for s in shapes]

    post, plate = look(start, end)
    y = np.asarray(start.position[:, 1])
    ends = np.asarray(end.position[:, 0])
    meets = (np.abs(y) < 0.1) & (ends > -np.sqrt(np.maximum(0.01 - y * y, 0)))
    for (share, depth), may, hits in ((*post, meets), (*plate, ends + 0.3 * y > 1)):
        np.testing.assert_array_equal(np.isfinite(share), hits)
        assert hits.any()
        assert not hits.all()
        assert (np.asarray(depth)[hits] < 0).all()
        assert may[hits].all()


@pytest.mark.slow
def test_particles_meet_a_users_shapes_like_those_of_the_library():
    start = darts(64)
    start = start._replace(velocity=40 * start.velocity)
    ours = contacts.Sphere((0.0, 0.0), 0.1), contacts.Slab((1.0, 0.0), (1.0, 0.3), thickness=1e-3)
    own, right = (
        simulate(Scene(start, contacts=shapes), methods.rk4, dt=1 / 60, steps=6)
        for shapes in ((Pillar(), Sheet()), ours)
    )
    np.testing.assert_allclose(own.position[-1], right.position[-1], atol=1e-9)


# curved ground


def bowl_errors(bowl):
    """How far a ball that rolls in a bowl is from its start after one period of 200 steps, and after two of 100."""
    from scipy.special import ellipk

    swing = 0.8
    start = (R - r) * np.array([np.sin(swing), -np.cos(swing), 0.0])
    period = 4 * ellipk(np.sin(swing / 2) ** 2) * np.sqrt(7 * (R - r) / (5 * G))
    bodies = rigid.bodies(BALL, jnp.asarray(np.tile(start, (2, 1))))
    scene = Scene(bodies, BALL, (forces.Gravity(G),), (rigid.SurfaceContact(HULL, bowl),))
    run = simulate(scene, methods.rk4, dt=jnp.array([period / 200, period / 100]), steps=200, save_every=200)
    return np.abs(np.asarray(run.position[-1]) - start).max(axis=-1)


@pytest.mark.slow
def test_a_ball_rolls_in_a_bowl_with_second_order():
    """φ'' = -(5/7) g sin φ/(R - r), whose period is an elliptic integral."""
    rough = contacts.Coulomb(50.0, 50.0)
    fine, coarse = bowl_errors(contacts.Sphere((0.0, 0.0, 0.0), R, inside=True, restitution=0.0, coulomb=rough))
    assert fine < 1e-5
    assert coarse / 2 / fine > 3.5  # two periods against one


@pytest.mark.slow
def test_a_ball_rolls_in_a_users_bowl_with_second_order():
    rough = contacts.Coulomb(50.0, 50.0)
    fine, coarse = bowl_errors(Bowl(restitution=0.0, coulomb=rough))
    assert fine < 1e-5
    assert coarse / 2 / fine > 3.5


@pytest.mark.slow
def test_a_ball_rolls_off_a_globe_where_it_must():
    """Rolling without slip from rest at the top it leaves at cos θ = 10/17: from v² it is less, by energy."""
    rough, v = contacts.Coulomb(50.0, 50.0), 0.6 * (R + r)
    globe = contacts.Sphere((0.0, 0.0, 0.0), R, restitution=0.0, coulomb=rough)
    body = rigid.bodies(BALL, (0.0, R + r, 0.0), velocity=(v, 0.0, 0.0), angular_velocity=(0.0, 0.0, -v / r))
    scene = Scene(body, BALL, (forces.Gravity(G),), (rigid.SurfaceContact(HULL, globe),))
    x = np.asarray(simulate(scene, methods.rk4, dt=1e-3, steps=900).position)
    signed_distance, leaves = np.linalg.norm(x, axis=-1) - R - r, 10 / 17 + 7 / 17 * v**2 / (G * (R + r))
    cosine = x[:, 1] / np.linalg.norm(x, axis=-1)
    assert signed_distance[cosine > leaves + 0.01].max() < 1e-9
    assert signed_distance[-1] > 1e-3
    assert cosine[np.argmax(signed_distance > 1e-6)] == pytest.approx(leaves, abs=0.03)


@pytest.mark.slow
def test_a_particle_leaves_a_users_globe_where_it_must():
    """From a signed distance alone: it slides from the top with v, and leaves at cos θ = 2/3 + v²/(3 g R)."""
    v = 0.6
    slide = Particles(jnp.array([0.0, R]), jnp.array([v, 0.0]))
    scenes = [
        Scene(slide, forces=(forces.Gravity(G),), contacts=(globe,))
        for globe in (Globe(restitution=0.0), contacts.Sphere((0.0, 0.0), R, restitution=0.0))
    ]
    own, ours = (np.asarray(simulate(scene, methods.rk4, dt=2e-3, steps=400).position) for scene in scenes)
    np.testing.assert_allclose(own, ours, atol=1e-12)
    signed_distance, leaves = np.linalg.norm(own, axis=-1) - R, 2 / 3 + v**2 / (3 * G * R)
    cosine = own[:, 1] / np.linalg.norm(own, axis=-1)
    assert signed_distance[cosine > leaves + 1e-3].max() < 1e-9
    assert signed_distance[-1] > 0.01


def test_shapes_follow_from_their_signed_distance():
    """Normal and curvature by differentiation are those that a sphere says in closed form."""
    rng = np.random.default_rng(0)
    x, v = (jnp.asarray(rng.normal(size=(5, 3))) for _ in range(2))
    for own, ours in ((Globe(), contacts.Sphere((0.0, 0.0, 0.0), R)), (Bowl(), contacts.Sphere((0.0,) * 3, R, True))):
        np.testing.assert_allclose(own.normal_at(0.0, x), ours.normal_at(0.0, x), atol=1e-14)
        np.testing.assert_allclose(
            own.curvature_acceleration(0.0, x, v), ours.curvature_acceleration(0.0, x, v), atol=1e-13
        )
        np.testing.assert_allclose(own.normal_rate(0.0, x, v), ours.normal_rate(0.0, x, v), atol=1e-13)


# a wall that closes in

CLOSING, STEP = 0.1, 0.5


@cache
def between_closing_walls():
    """Two balls between two walls: of the first the right one closes in, of the second it stands."""
    moves = jnp.array([[-CLOSING, 0.0], [0.0, 0.0]])
    walls = contacts.Plane((0.0, 0.0), (1.0, 0.0)), contacts.Plane((1.0, 0.0), (-1.0, 0.0), velocity=moves)
    balls = Particles(jnp.array([[0.5, 0.0], [0.5, 0.0]]), jnp.array([[1.0, 0.0], [1.0, 0.0]]))
    return simulate(Scene(balls, contacts=walls), methods.rk4, dt=STEP, steps=21)


def test_a_closing_wall_that_passes_a_waiting_ball_is_reported():
    run = between_closing_walls()
    x, t = np.asarray(run.position[:, 0, 0]), np.asarray(run.time)
    fine = np.isfinite(x)
    assert (x[fine] > -1e-12).all()
    assert (x[fine] < 1 - CLOSING * t[fine] + 1e-12).all()
    assert run.ok.tolist() == [False, True]
    assert 18 < int(run.first_bad_step[0]) <= 21
    phase = np.mod(0.5 + t, 2)
    np.testing.assert_allclose(run.position[:, 1, 0], np.where(phase > 1, 2 - phase, phase), atol=1e-12)


@pytest.mark.slow
def test_an_overrun_lane_is_explained():
    found = stability.explain(between_closing_walls(), lane=0)
    assert found.cause == "contact"
    assert "waited for the next" in str(found)


def test_a_ball_between_closing_walls_is_where_its_bounces_take_it():
    run = between_closing_walls()
    x, v, t, end = 0.5, 1.0, 0.0, 18 * STEP
    while True:
        hit = (1 - CLOSING * t - x) / (v + CLOSING) if v > 0 else -x / v
        if t + hit >= end:
            break
        x, t = x + hit * v, t + hit
        v = -v - 2 * CLOSING if v > 0 else -v
    assert float(run.position[18, 0, 0]) == pytest.approx(x + v * (end - t), abs=1e-9)


def test_derivatives_of_a_step_with_more_impacts_than_have_them_are_not_numbers():
    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def end(speed, length):
        walls = contacts.Plane(jnp.zeros(1), jnp.ones(1)), contacts.Plane(length[None], -jnp.ones(1))
        scene = Scene(Particles(jnp.full(1, 0.5), speed[None]), contacts=walls)
        return scene.step(methods.rk4, 0.0, 1.0).state.position[0]

    speeds, length = jnp.array([7.6, 8.6, 30.6]), jnp.asarray(1.0)
    np.testing.assert_allclose(end(speeds, length), [0.1, 0.9, 0.9], atol=1e-12)
    # eight impacts, nine, and thirty-one: a path folded into the room
    for derivative in (jax.jacfwd, jax.jacrev):
        by_speed = np.diagonal(derivative(end)(speeds, length))
        np.testing.assert_allclose(by_speed, [1.0, np.nan, np.nan], atol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(end, 1)(speeds, length), [-8.0, np.nan, np.nan], atol=1e-12)


def test_a_slab_that_comes_over_the_place_where_a_ball_rests_is_met_by_the_face_it_came_with():
    slab = contacts.Slab((0.0, 0.0), (-1.0, 0.3), thickness=0.2, restitution=0.8, velocity=(-50.0, 0.0))
    height = np.linspace(-0.6, 0.6, 64)
    place = np.stack([-3.0 - np.linspace(0.0, 1.0, 64) ** 2, height], axis=-1)
    scene = Scene(Particles(jnp.asarray(place), jnp.zeros((64, 2))), contacts=(slab,))
    end = simulate(scene, methods.semi_implicit_euler, dt=0.01, steps=16, save_every=16).velocity[-1]
    normal = np.array([-1.0, 0.3]) / np.hypot(1.0, 0.3)
    np.testing.assert_allclose(end, np.broadcast_to(1.8 * 50.0 / np.hypot(1.0, 0.3) * normal, (64, 2)), rtol=1e-9)
