"""Machines in the plane, of bodies on exact joints with limits and motors: a crane, a car, a wrecking ball."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study import energy
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

CRATE = 0.5
"""The side of a crate of the wall [m]."""


@scene
def crane(travel: float = 3.0, lift: float = 1.2, response_time: float = 0.7, g: float = 9.8) -> Problem:
    """A trolley drives along its rail and a jib on it rises, both by servos, and a load on a rope swings below."""
    trolley, jib = inertia.planar_plate(400.0, (0.8, 0.3)), inertia.planar_segment(80.0, 2.0)
    load = inertia.planar_plate(150.0, (0.5, 0.5))
    bodies = rigid.PlanarInertia(
        *(jnp.stack(p) for p in zip(*((b.mass, b.moment) for b in (trolley, jib, load)), strict=True))
    )
    start = rigid.planar_bodies(bodies, [[0.0, 0.0], [1.0, 0.0], [2.0, -1.65]])
    rail = rigid.Sliders(
        [(-1, 0)],
        jnp.zeros((1, 2, 2)),
        (1.0, 0.0),
        limits=(-1.0, 8.0),
        servo=travel,
        response_time=response_time,
        force=1e5,
    )
    shoulder = rigid.Hinges(
        [(0, 1)],
        [[[0.0, 0.0], [-1.0, 0.0]]],
        limits=(-0.2, 1.5),
        servo=lift,
        response_time=response_time,
        torque=1e5,
    )
    rope = rigid.Ropes([(1, 2)], [[[1.0, 0.0], [0.0, 0.25]]], 1.5)
    moved = lambda f: 1 - np.exp(-np.asarray(f.time) / response_time)  # noqa: E731

    def stretch(flight: Trajectory) -> np.ndarray:
        angle = np.asarray(flight.state.angle)
        tip = flight.position[:, 1] + np.stack([np.cos(angle[:, 1]), np.sin(angle[:, 1])], axis=-1)
        top = flight.position[:, 2] + 0.25 * np.stack([-np.sin(angle[:, 2]), np.cos(angle[:, 2])], axis=-1)
        return np.maximum(np.linalg.norm(tip - top, axis=-1) - 1.5, 0.0)

    return Problem(
        Scene(start, bodies, (forces.Gravity(g), rail, shoulder, rope)),
        duration=4.0,
        truths=(
            Truth(
                "the trolley comes to its place as its servo says [m]",
                lambda f: f.position[1:, 0, 0] - travel * moved(f)[1:],
                0.0,
                0.05,
            ),
            Truth("so does the jib [rad]", lambda f: f.state.angle[1:, 1] - lift * moved(f)[1:], 0.0, 0.02),
            Truth("the rope grows no longer [m]", stretch, 0.0, 1e-9),
        ),
        looks=[
            rigid.PlanarShape.box((0.8, 0.3)),
            rigid.PlanarShape.box((2.0, 0.12)),
            rigid.PlanarShape.box((0.5, 0.5)),
        ],
        frames=24,
    )


@scene
def motor_car(torque: float = 120.0, speed: float = 30.0, friction: float = 0.9, g: float = 9.8) -> Problem:
    """A car whose two wheels are turned by motors: it gathers speed as their torque says, until they have theirs."""
    radius, body, wheel = 0.3, inertia.planar_plate(300.0, (2.4, 0.5)), inertia.planar_disc(20.0, 0.3)
    bodies = rigid.PlanarInertia(
        jnp.asarray([body.mass, wheel.mass, wheel.mass]), jnp.asarray([body.moment, wheel.moment, wheel.moment])
    )
    start = rigid.planar_bodies(bodies, [[0.0, 0.55], [-0.8, radius], [0.8, radius]])
    # forward is to the right, so that wheels turn clockwise
    axles = rigid.Hinges(
        [(0, 1), (0, 2)], [[[-0.8, -0.25], [0.0, 0.0]], [[0.8, -0.25], [0.0, 0.0]]], motor=-speed, torque=torque
    )
    rough = contacts.Coulomb(friction, friction)
    road = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=rough)
    shapes = [rigid.PlanarShape.box((2.4, 0.5)), rigid.PlanarShape.disc(radius), rigid.PlanarShape.disc(radius)]
    solids = rigid.Solids(shapes, (road,), coulomb=rough, pairs=np.zeros((0, 2), int))
    car = Scene(start, bodies, (forces.Gravity(g), axles), (solids,))
    weight = float(np.sum(bodies.mass)) + 2 * float(wheel.moment) / radius**2
    rate = 2 * torque / radius / weight

    def pace(flight: Trajectory) -> np.ndarray:
        return flight.state.momentum[1:, 0, 0] / float(body.mass) - np.minimum(rate * flight.time[1:], speed * radius)

    return Problem(
        car,
        duration=6.0,
        truths=(
            Truth("gathers speed at 2τ/r over its mass and that of its wheels' turning [m/s]", pace, 0.0, 0.02),
            Truth("its axles stay where they are [m]", lambda f: np.asarray(_measure_axles(f)), 0.0, 1e-6),
            Truth("stays on the road [m]", lambda f: f.position[:, 1:, 1] - radius, 0.0, 1e-4),
        ),
        frames=24,
    )


def _measure_axles(flight: Trajectory) -> np.ndarray:
    """How far the wheels are from where the body has them [m]."""
    angle = np.asarray(flight.state.angle)[:, :1]
    ahead, up = np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)
    axle = flight.position[:, :1] + np.array([[-0.8], [0.8]]) * ahead - 0.25 * up
    return np.linalg.norm(flight.position[:, 1:] - axle, axis=-1)


@scene
def wrecking_ball(columns: int = 3, rows: int = 4, length: float = 4.0, g: float = 9.8) -> Problem:
    """A ball of 400 kg on a rope swings into a wall of crates of 12.5 kg, and knocks it down."""
    ball, crate = inertia.planar_disc(400.0, 0.35), inertia.planar_plate(12.5, (CRATE, CRATE))
    count = columns * rows
    bodies = rigid.PlanarInertia(
        jnp.asarray([float(ball.mass)] + [float(crate.mass)] * count),
        jnp.asarray([float(ball.moment)] + [float(crate.moment)] * count),
    )
    pivot = np.array([0.0, length + 0.8])
    place = np.array([[0.65 + CRATE * i, CRATE * (j + 0.5)] for j in range(rows) for i in range(columns)])
    begun = pivot + length * np.array([-np.sin(1.2), -np.cos(1.2)])
    start = rigid.planar_bodies(bodies, np.concatenate([begun[None], place]))
    rope = rigid.Ropes([(-1, 0)], [[pivot, [0.0, 0.0]]], length)
    rough = contacts.Coulomb(0.5, 0.5)
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=rough)
    shapes = [rigid.PlanarShape.disc(0.35), *[rigid.PlanarShape.box((CRATE, CRATE))] * count]
    wall = Scene(start, bodies, (forces.Gravity(g), rope), (rigid.Solids(shapes, (floor,), coulomb=rough),))
    reach = lambda f: np.maximum(np.linalg.norm(f.position[:, 0] - pivot, axis=-1) - length, 0.0)  # noqa: E731

    def fall(flight: Trajectory) -> np.ndarray:
        """The energy of the ball before the wall, over its weight [m]."""
        before = flight.position[:, 0, 0] < -0.2
        stored = (
            0.5 * np.sum((flight.state.momentum[before, 0] / 400.0) ** 2, axis=-1) / g + flight.position[before, 0, 1]
        )
        return stored - begun[1]

    def gain(flight: Trajectory) -> np.ndarray:
        stored = np.asarray(jax.vmap(lambda t, s: energy.total(wall, t, s))(flight.time, flight.state))
        return np.diff(stored).clip(0.0) / (400.0 * g)

    return Problem(
        wall,
        duration=2.5,
        truths=(
            Truth("the rope grows no longer [m]", reach, 0.0, 1e-6),
            Truth("the ball keeps its energy until it comes to the wall [m]", fall, 0.0, 5e-3),
            Truth("nothing gives energy [m]", gain, 0.0, 2e-2),
            Truth(
                "the wall is down: the mean height of its upper row [m]",
                lambda f: f.position[-1, -columns:, 1].mean(),
                0.5,
                0.6,
            ),
        ),
        frames=24,
    )
