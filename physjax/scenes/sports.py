"""Balls in play, in metres from the player: x towards the goal, y up, z to the right.

A ball is a particle: contacts act on its centre, a radius in front of the drawn surface, and its spin is constant.
"""

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.stepping.reference import reference
from physjax.study.problem import Problem, Truth


@scene
def basketball(angle: float = 0.96, g: float = 9.8) -> Problem:
    """Free throws with backspin at four speeds, off the backboard and down through the ring.

    The board is an infinite plane, so a truth checks that it is hit where the real one is, from 2.90 to 3.95 m high; the
    ring is not modelled, and a truth checks that the ball passes clear of it.
    """
    mass, radius = 0.624, 0.12
    board, ring, rim, clearance = 4.6, 4.6 - 0.375, 3.05, 0.225 - radius
    speed, area = np.linspace(7.96, 8.08, 4), np.pi * radius**2
    launch = speed[:, None] * np.array([np.cos(angle), np.sin(angle)])
    shots = Scene(
        Particles(jnp.broadcast_to(jnp.asarray([0.0, 2.1]), launch.shape), jnp.asarray(launch)),
        mass=mass,
        forces=(
            forces.Gravity(g),
            forces.QuadraticDrag(area, coefficient=0.5),
            forces.Magnus(area, coefficient=0.15, axis=1.0),
        ),
        contacts=(contacts.Plane((board - radius, 0.0), (-1.0, 0.0), restitution=0.75),),
    )

    def board_height(flight):
        """Height at which the board is hit: from the last frame before, in a straight line."""
        last = np.argmin(flight.velocity[..., 0] > 0, axis=0) - 1
        (x, v), lane = flight.state, np.arange(speed.size)
        x, v = x[last, lane], v[last, lane]
        return x[:, 1] + v[:, 1] / v[:, 0] * (board - radius - x[:, 0])

    return Problem(
        shots,
        duration=1.2,
        truths=(
            Truth(
                "flies to the board as diffrax has it [m]", lambda f: _path_error(f, f.velocity[..., 0] > 0), 0.0, 1e-9
            ),
            Truth("hits the board between its edges at 2.90 and 3.95 m [m]", board_height, 3.425, 0.525),
            Truth(
                "falls through the ring without touching it: centres closer than 10.5 cm [m]",
                lambda f: _find_crossing(f, 1, rim, -1)[..., 0] - ring,
                0.0,
                clearance,
            ),
        ),
        frames=64,
    )


@scene
def free_kick(speed: float = 25.0, g: float = 9.8) -> Problem:
    """A football curled around the wall into the goal, which a straight shot would miss by metres; it bounces once."""
    mass, radius = 0.43, 0.11
    wall, goal, post, bar, edge = 9.15, 22.0, 3.66, 2.44, 1.0
    up, aside = np.radians(10.0), np.radians(16.0)
    aim = np.array([np.cos(up) * np.cos(aside), np.sin(up), np.cos(up) * np.sin(aside)])
    area, rough = np.pi * radius**2, contacts.Coulomb(static=0.5, kinetic=0.4)
    ball = Scene(
        Particles(jnp.asarray([0.0, radius, 0.0]), jnp.asarray(speed * aim)),
        mass=mass,
        forces=(
            forces.Gravity(g),
            forces.QuadraticDrag(area, coefficient=0.25),
            forces.Magnus(area, coefficient=0.25, axis=(0.0, 1.0, 0.0)),
        ),
        contacts=(contacts.Plane((0.0, radius, 0.0), (0.0, 1.0, 0.0), restitution=0.6, coulomb=rough),),
    )
    bounced = lambda flight: np.diff(flight.velocity[:, 1]) > 0  # noqa: E731
    flown = lambda flight: np.concatenate([[True], ~np.maximum.accumulate(bounced(flight))])  # noqa: E731
    line = lambda flight: _find_crossing(flight, 0, goal, +1)  # noqa: E731
    return Problem(
        ball,
        duration=1.12,
        truths=(
            Truth(
                "flies and curves to the ground as diffrax has it [m]", lambda f: _path_error(f, flown(f)), 0.0, 1e-9
            ),
            Truth(
                "passes next to the last player of the wall, 1 m from its middle [m]",
                lambda f: np.maximum(edge + radius - _find_crossing(f, 0, wall, +1)[2], 0.0),
                0.0,
                0.0,
            ),
            Truth("was aimed next to the goal [m]", lambda f: np.maximum(post - goal * aim[2] / aim[0], 0.0), 0.0, 0.0),
            Truth("goes in between the posts [m]", lambda f: line(f)[2], 0.0, post - radius),
            Truth("goes in under the bar [m]", lambda f: line(f)[1], bar / 2, bar / 2 - radius),
            Truth("bounces once before the line", lambda f: np.sum(bounced(f) & (f.position[1:, 0] < goal)), 1, 0),
        ),
    )


def _path_error(flight, before):
    """Largest distance [m] from diffrax's solution without contacts, over the frames before the first contact."""
    free = Scene(flight.scene.state, flight.scene.mass, flight.scene.forces)
    path = reference(free, flight.time, rtol=1e-12, atol=1e-12)
    return (np.linalg.norm(flight.position - path.position, axis=-1) * before).max()


def _find_crossing(flight, axis, level, way):
    """Where each lane first crosses a level of one coordinate, upward (`way` +1) or downward (-1), by linear interpolation."""
    beyond = way * (flight.position[..., axis] - level)
    first = np.argmax((beyond[:-1] < 0) & (beyond[1:] >= 0), axis=0)[None, ..., None]
    before, after = (np.take_along_axis(x, first, axis=0)[0] for x in (flight.position[:-1], flight.position[1:]))
    share = (level - before[..., axis]) / (after[..., axis] - before[..., axis])
    return before + share[..., None] * (after - before)
