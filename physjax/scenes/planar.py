"""Bodies in the plane that collide, roll and topple: a cradle, a break, dominoes, a marble run, a see-saw."""

import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.energy.quantities import ENERGY, MOMENTUM
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

UP = (0.0, 1.0)


@scene
def newtons_cradle(speed: float = 1.0) -> Problem:
    """Five balls in a row, hit by one, two and three more of their kind: as many leave at the other end, as fast."""
    radius, balls = 0.1, 5
    ball = inertia.planar_disc(1.0, radius)
    coming = np.array([1, 2, 3])
    number = np.arange(balls)
    moves = number < coming[:, None]
    # those that come are a little apart from the rest, which touch
    x = 2 * radius * number - 0.3 * moves
    place = np.stack([x, np.broadcast_to(-0.4 * np.arange(3)[:, None], x.shape)], axis=-1)
    velocity = np.stack([speed * moves, 0.0 * x], axis=-1)
    leaves = speed * (number >= balls - coming[:, None])
    return Problem(
        Scene(
            rigid.planar_bodies(ball, place, velocity=velocity),
            ball,
            contacts=(rigid.Solids(rigid.PlanarShape.disc(radius), restitution=1.0),),
        ),
        duration=0.8,
        conserved=(ENERGY, MOMENTUM),
        truths=(
            Truth(
                "as many leave as have come, as fast [m/s]",
                lambda f: f.state.momentum[-1, ..., 0],
                leaves,
                1e-3 * speed,
            ),
            Truth(
                "momentum is conserved [kg m/s]",
                lambda f: f.state.momentum.sum(axis=-2)[..., 0] - speed * coming,
                0.0,
                1e-12 * speed,
            ),
        ),
    )


@scene
def billiard_break(speed: float = 8.0) -> Problem:
    """A cue ball breaks a rack of fifteen without friction: energy and momentum stay, and what is mirrored stays so."""
    radius, mass = 0.0286, 0.17
    row = np.concatenate([np.full(i + 1, i) for i in range(5)])
    column = np.concatenate([np.arange(i + 1) for i in range(5)])
    rack = radius * np.stack([np.sqrt(3) * row, 2 * column - row], axis=-1)
    mirror = np.array(
        [int(np.flatnonzero((row == r) & (column == r - c))[0]) for r, c in zip(row, column, strict=True)]
    )
    place = np.concatenate([[[-0.3, 0.0]], rack])
    velocity = np.zeros_like(place)
    velocity[0, 0] = speed
    ball = inertia.planar_disc(mass, radius)
    energy = 0.5 * mass * speed**2
    return Problem(
        Scene(
            rigid.planar_bodies(ball, place, velocity=velocity),
            ball,
            contacts=(rigid.Solids(rigid.PlanarShape.disc(radius), restitution=1.0),),
        ),
        duration=0.25,
        conserved=(ENERGY, MOMENTUM),
        truths=(
            Truth(
                "momentum is conserved [relative]",
                lambda f: f.state.momentum.sum(axis=1) / (mass * speed) - [1.0, 0.0],
                0.0,
                1e-12,
            ),
            Truth(
                "energy is conserved [relative]",
                lambda f: 0.5 * (f.state.momentum**2).sum(axis=(1, 2)) / mass / energy,
                1.0,
                1e-9,
            ),
            Truth(
                "stays mirror symmetric [m]",
                lambda f: f.position[-1, 1:] - f.position[-1, 1:][mirror] * [1.0, -1.0],
                0.0,
                1e-9,
            ),
        ),
    )


@scene
def dominoes(count: int = 30, push: float = 1.0, g: float = 9.8) -> Problem:
    """Thirty dominoes in a row, of which the first is pushed: they fall one after the other, and a wave runs along."""
    size, gap = np.array([0.1, 0.6]), 0.35
    stone, rough = inertia.planar_plate(1.0, tuple(size)), contacts.Coulomb(0.4, 0.4)
    floor = contacts.Plane((0.0, 0.0), UP, restitution=0.0, coulomb=contacts.Coulomb(0.8, 0.8))
    place = np.stack([gap * np.arange(count), np.full(count, size[1] / 2)], axis=-1)
    turn = np.where(np.arange(count) == 0, -push, 0.0)
    velocity = np.stack([-turn * size[1] / 2, 0 * turn], axis=-1)  # it turns about its foot
    pairs = [(i, i + 1) for i in range(count - 1)]
    shape = rigid.PlanarShape.box(tuple(size))
    row = Scene(
        rigid.planar_bodies(stone, place, velocity=velocity, angular_velocity=turn),
        stone,
        (forces.Gravity(g),),
        contacts=(rigid.Solids(shape, surfaces=(floor,), coulomb=rough, pairs=pairs),),
    )
    return Problem(
        row,
        duration=8.0,
        truths=(
            Truth("fall one after the other [s]", lambda f: np.minimum(np.diff(_find_falls(f)), 0.0), 0.0, 0.0),
            Truth("have all fallen [rad]", lambda f: np.minimum(-f.state.angle[-1] - 0.9, 0.0), 0.0, 0.0),
            Truth("the wave keeps its speed [relative]", _compare_wave_speeds, 1.0, 0.1),
        ),
        frames=160,
    )


@scene
def marble_run(slope: float = 0.2, g: float = 9.8) -> Problem:
    """Two marbles roll down three ramps between walls: on the first at 2/3 g sin θ, as a disc does that does not slip."""
    radius, length, thick, drop = 0.1, 2.0, 0.1, 0.9
    tilt = slope * np.array([-1.0, 1.0, -1.0])
    ramps = np.stack([0.45 * np.array([-1.0, 1.0, -1.0]), -drop * np.arange(3)], axis=-1)
    along, normal = np.array([np.cos(slope), -np.sin(slope)]), np.array([np.sin(slope), np.cos(slope)])
    start = ramps[0] + (radius + thick / 2) * normal - np.outer([0.8, 0.4], along)
    shapes = [rigid.PlanarShape.box((length, thick))] * 3 + [rigid.PlanarShape.disc(radius)] * 2
    mass = np.array([1.0, 1.0, 1.0, 1.0, 1.0])
    moment = np.array([1.0, 1.0, 1.0, radius**2 / 2, radius**2 / 2])
    bodies = rigid.PlanarInertia(jnp.asarray(mass), jnp.asarray(moment))
    rough = contacts.Coulomb(0.6, 0.6)
    ground = -drop * 2 - 0.8
    floor = contacts.Plane((0.0, ground), UP, restitution=0.0, coulomb=rough)
    # a marble that is faster than a ramp is long stops at the wall and rolls back
    walls = [contacts.Plane((-1.5 * side, 0.0), (side, 0.0), restitution=0.0) for side in (1.0, -1.0)]
    pairs = [(i, j) for j in (3, 4) for i in range(3)] + [(3, 4)]
    run = Scene(
        rigid.planar_bodies(bodies, np.concatenate([ramps, start]), np.concatenate([tilt, [0.0, 0.0]])),
        bodies,
        (forces.Gravity(g),),
        contacts=(rigid.Solids(shapes, surfaces=(floor, *walls), coulomb=rough, pairs=pairs),),
        pinned=np.arange(5) < 3,
    )
    rolls = lambda f: f.time < 0.75  # noqa: E731
    way = lambda f: (f.position[rolls(f), 3:] - start) @ along  # noqa: E731
    fall = lambda f: g * np.sin(slope) / 3 * f.time[rolls(f), None] ** 2  # noqa: E731
    return Problem(
        run,
        duration=7.0,
        truths=(
            Truth("rolls at 2/3 g sin θ [m]", lambda f: way(f) - fall(f), 0.0, 1e-3),
            Truth(
                "turns by its way over its radius [rad]",
                lambda f: f.state.angle[rolls(f), 3:] + way(f) / radius,
                0.0,
                1e-2,
            ),
            Truth(
                "never goes through what it rolls on [m]",
                lambda f: np.minimum(f.position[:, 3:, 1] - ground - radius, 0),
                0.0,
                1e-3,
            ),
        ),
        frames=112,
    )


@scene
def see_saw(heavy: float = 2.0, arm: float = 0.6, g: float = 9.8) -> Problem:
    """A plank on a round log with two crates: balanced where m₁ d₁ = m₂ d₂, the law of the lever."""
    log, plank, side = 0.6, np.array([3.0, 0.1]), 0.2
    mass = np.array([1.0, 1.0, heavy, 1.0])
    size = np.array([plank, [side, side], [side, side]])
    moment = np.concatenate([[1.0], mass[1:] * (size**2).sum(axis=-1) / 12])
    bodies = rigid.PlanarInertia(jnp.asarray(mass), jnp.asarray(moment))
    deck = log + plank[1]
    place = np.array([[0.0, 0.0], [0.0, log + plank[1] / 2], [-arm, deck + side / 2], [heavy * arm, deck + side / 2]])
    shapes = [rigid.PlanarShape.disc(log), *(rigid.PlanarShape.box(tuple(sides)) for sides in size)]
    rough = contacts.Coulomb(0.6, 0.6)
    balance = Scene(
        rigid.planar_bodies(bodies, place),
        bodies,
        (forces.Gravity(g),),
        contacts=(rigid.Solids(shapes, coulomb=rough, pairs=[(0, 1), (1, 2), (1, 3)]),),
        pinned=np.arange(4) < 1,
    )
    return Problem(
        balance,
        duration=2.0,
        truths=(
            Truth("stays level [rad]", lambda f: f.state.angle[:, 1], 0.0, 1e-3),
            Truth("the crates stay where they are [m]", lambda f: f.position[:, 2:] - place[2:], 0.0, 2e-3),
        ),
    )


def _find_falls(flight: Trajectory) -> np.ndarray:
    """The times at which each domino has turned by 0.3 rad [s], linear between frames."""
    angle, time = -flight.state.angle, flight.time
    after = np.argmax(angle > 0.3, axis=0)
    body = np.arange(angle.shape[1])
    low, high = angle[after - 1, body], angle[after, body]
    return time[after - 1] + (0.3 - low) / (high - low) * (time[after] - time[after - 1])


def _compare_wave_speeds(flight: Trajectory) -> np.floating:
    """The time that the wave takes for the third quarter of the row, of that for the second."""
    falls = _find_falls(flight)
    quarter = len(falls) // 4
    return (falls[3 * quarter] - falls[2 * quarter]) / (falls[2 * quarter] - falls[quarter])
