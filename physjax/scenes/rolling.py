"""Bodies on the ground that roll, slide into rolling, or tumble until they are at rest."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.show import solids
from physjax.study import energy
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory


@scene
def rolling(slope: float = 0.3, radius: float = 0.3, length: float = 0.8, g: float = 9.8) -> Problem:
    """A ball and a cylinder roll down a slope: the ball wins, a = (5/7) g sinθ against (2/3) g sinθ.

    The contact points of the cylinder are the ends of its axis, each with its radius; those of the ball its centre, twice.
    """
    down, up = _slope_direction(slope), np.array([np.sin(slope), np.cos(slope), 0.0])
    ball, roller = inertia.sphere(2.0, radius), inertia.cylinder(2.0, radius, length)
    both = inertia.Inertia(2.0, jnp.stack([ball.principal, roller.principal]))
    axis = np.zeros((2, 2, 3))
    axis[1, :, 2] = -length / 2, length / 2
    ground = contacts.Plane((0.0, 0.0, 0.0), up, coulomb=contacts.Coulomb(0.4, 0.4))
    start = rigid.bodies(both, radius * up + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    race = Scene(start, both, (forces.Gravity(g),), (rigid.SurfaceContact(rigid.ContactPoints(axis, radius), ground),))
    share = np.array([5 / 7, 2 / 3])
    duration = 1.5

    def way(flight):
        return (flight.position[-1] - flight.position[0]) @ down * 2 / (duration**2 * g * np.sin(slope))

    return Problem(
        race,
        duration=duration,
        looks=[solids.sphere(radius), solids.cylinder(radius, length)],
        conserved=(energy.ENERGY,),
        truths=(
            Truth("rolls down with a/(g sinθ) of 5/7 and 2/3 [1]", way, share, 1e-6),
            Truth(
                "rolls without slipping, ωr = v [relative]",
                lambda f: -_omega(f)[-1, :, 2] * radius / (_velocity(f)[-1] @ down),
                1.0,
                1e-9,
            ),
        ),
        frames=16,
    )


@scene
def bowling(speed: float = 6.0, friction: float = 0.12, radius: float = 0.108, g: float = 9.8) -> Problem:
    """A bowling ball thrown without spin slides for 2v₀/(7μg), then rolls at (5/7) v₀."""
    ball = inertia.sphere(6.0, radius)
    alley = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), coulomb=contacts.Coulomb(friction, friction))
    start = rigid.bodies(ball, (0.0, radius, 0.0), velocity=(speed, 0.0, 0.0))
    thrown = Scene(
        start, ball, (forces.Gravity(g),), (rigid.SurfaceContact(rigid.ContactPoints.sphere(radius), alley),)
    )
    slides = 2 * speed / (7 * friction * g)
    way = speed * slides - friction * g * slides**2 / 2 + 5 / 7 * speed * slides
    return Problem(
        thrown,
        duration=2 * slides,
        looks=solids.sphere(radius),
        truths=(
            Truth("rolls at (5/7) v₀ [relative]", lambda f: _velocity(f)[-1, 0] / speed, 5 / 7, 1e-6),
            Truth("rolls without slipping, ωr/v₀ [1]", lambda f: -_omega(f)[-1, 2] * radius / speed, 5 / 7, 1e-6),
            Truth("travels v₀t - μgt²/2, then 5/7 v₀t [relative]", lambda f: f.position[-1, 0] / way, 1.0, 1e-6),
        ),
        frames=32,
    )


@scene
def tumbling_box(height: float = 0.5, g: float = 9.8) -> Problem:
    """Three boxes dropped with a spin: the first sticks, the second bounces a few times, the third bounces for ever."""
    size = np.array([0.4, 0.2, 0.3])
    box = inertia.box(2.0, size)
    rough = np.array([0.6, 0.4, 0.0])
    floor = contacts.Plane(
        (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=np.array([0.0, 0.5, 1.0]), coulomb=contacts.Coulomb(rough, rough)
    )
    place = np.array([[-1.0, height, 0.0], [0.0, height, 0.0], [1.0, height, 0.0]])
    start = rigid.bodies(box, place, (0.9, 0.3, 0.2, 0.1), angular_velocity=(1.0, 2.0, 3.0))
    dropped = Scene(start, box, (forces.Gravity(g),), (rigid.SurfaceContact(rigid.ContactPoints.box(size), floor),))

    def face_error(flight):
        """By how much the height of each centre differs from the nearest half edge [m]."""
        above = flight.position[-1, :2, 1]
        return np.abs(above[:, None] - size / 2).min(axis=-1)

    return Problem(
        dropped,
        duration=4.0,
        looks=solids.box(size),
        truths=(
            Truth("two come to rest on a face [m]", face_error, 0.0, 1e-6),
            Truth("and do not move [m]", lambda f: f.position[-8:, :2] - f.position[-8, :2], 0.0, 1e-9),
            Truth(
                "the third conserves its energy [relative]",
                lambda f: _total_energy(f)[:, 2] / _total_energy(f)[0, 2],
                1.0,
                1e-6,
            ),
            Truth(
                "none gains energy [relative]",
                lambda f: np.maximum(_total_energy(f) / _total_energy(f)[0] - 1, 0.0),
                0.0,
                1e-6,
            ),
        ),
        frames=64,
    )


def _total_energy(flight: Trajectory) -> np.ndarray:
    """Energy of each body at every frame [J]."""
    states, scene = (jax.tree.map(jnp.asarray, part) for part in (flight.state, flight.scene))
    return np.asarray(jax.vmap(lambda t, s: energy.total(scene, t, s))(jnp.asarray(flight.time), states))


def _slope_direction(slope: float) -> np.ndarray:
    """The unit vector down a slope."""
    return np.array([np.cos(slope), -np.sin(slope), 0.0])


def _velocity(flight: Trajectory) -> np.ndarray:
    """Velocity of the centres of mass at every frame [m/s]."""
    assert flight.scene is not None
    return flight.state.momentum / flight.scene.mass.mass


def _omega(flight: Trajectory) -> np.ndarray:
    """Angular velocity at every frame [rad/s]."""
    assert flight.scene is not None
    states, mass = (jax.tree.map(jnp.asarray, part) for part in (flight.state, flight.scene.mass))
    return np.asarray(jax.vmap(lambda state: rigid.angular_velocity(state, mass))(states))
