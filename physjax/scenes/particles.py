"""Particle systems: what is born at a rate or in a burst, flies, and dies.

Each particle is compared with the closed form of its own birth, which the emitter knows for every slot and generation.
"""

import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, emitters, fields, forces
from physjax.scene import Scene
from physjax.scenes.gallery import scene
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

UP = (0.0, 1.0, 0.0)


@scene
def explosion(particles: int = 400, speed: float = 8.0, g: float = 9.8) -> Problem:
    """Four hundred fragments of equal speed thrown in all directions at once: a sphere that grows and falls."""
    center = np.asarray([0.0, 20.0, 0.0])
    burst = emitters.Emitter(
        particles, emitters.Point(center), key=0, life=2.0, speed=speed, look=emitters.Look(opacity=(1.0, 0.0))
    )
    fragments = Scene(burst.unborn(), 0.01, (forces.Gravity(g),), emitter=burst)

    def off_the_sphere(flight):
        age = np.asarray(flight.time)[:-1, None]
        away = flight.position[:-1] - center + 0.5 * g * age[..., None] ** 2 * np.asarray(UP)
        return np.abs(np.linalg.norm(away, axis=-1) - speed * age).max()

    def momentum(flight):
        return np.mean(flight.velocity[-2], axis=0) + g * flight.time[-2] * np.asarray(UP)

    return Problem(
        fragments,
        duration=2.0,
        frames=16,
        truths=(
            Truth("every fragment is on a sphere of radius s t that falls freely [m]", off_the_sphere, 0.0, 1e-9),
            Truth(
                "momentum by mass but for its fall, zero within three standard errors [m/s]",
                momentum,
                0.0,
                3 * speed / np.sqrt(3 * particles),
            ),
        ),
    )


@scene
def fountain(rate: float = 200.0, speed: float = 6.0, cone: float = 0.5, restitution: float = 0.4) -> Problem:
    """A fountain of two hundred drops a second in a cone of half a radian, which bounce on the ground without friction."""
    g, life = 9.8, 1.6
    jet = emitters.Emitter(
        330, emitters.Point((0.0, 0.0, 0.0)), key=1, rate=rate, life=life, speed=speed, direction=UP, cone=cone
    )
    ground = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=restitution)
    drops = Scene(jet.unborn(), 1e-4, (forces.Gravity(g),), (ground,), emitter=jet)

    def seen(flight):
        age, velocity = _newest(flight)
        lands = 2 * velocity[:, 1] / g
        return age, velocity, lands, np.asarray(flight.position[-1])

    def off_the_ring(flight):
        """Where it lands is the distance flown by then: no friction, so the way over the ground goes on as it began."""
        age, velocity, _, x = seen(flight)
        return np.abs(x[:, [0, 2]] - age[:, None] * velocity[:, [0, 2]])[age > 0].max()

    def off_the_parabolas(flight):
        age, velocity, lands, x = seen(flight)
        again = age - lands
        first = velocity[:, 1] * age - 0.5 * g * age**2
        second = restitution * velocity[:, 1] * again - 0.5 * g * again**2
        height = np.where(again < 0, first, second)
        return np.abs(x[:, 1] - height)[(age > 0) & (again < restitution * lands)].max()

    return Problem(
        drops,
        duration=2.0,
        frames=16,
        truths=(
            Truth("drops land on rings of radius 2 v_x v_y/g and go on [m]", off_the_ring, 0.0, 1e-9),
            Truth(
                "first flight to v_y²/2g, second to K_r² of it, as the closed form [m]", off_the_parabolas, 0.0, 1e-9
            ),
            _alive(rate * life),
        ),
    )


@scene
def smoke(rate: float = 150.0, rise: float = 1.2, eddies: float = 0.3) -> Problem:
    """A plume of smoke that buoyancy lifts against its drag, stirred by turbulence without divergence."""
    g, mass, lag, life = 9.8, 1e-6, 0.02, 2.0
    drag = mass / lag
    # Archimedes carries the weight and what the drag takes at the terminal speed
    volume = (mass * g + drag * rise) / (1.225 * g)
    stirring = fields.Turbulence(drag, eddies, 0.8, key=5)
    plume = emitters.Emitter(
        320,
        emitters.Disc((0.0, 0.0, 0.0), UP, 0.1),
        key=2,
        rate=rate,
        life=life,
        size=0.05,
        look=emitters.Look(size=(1.0, 4.0), colour=((0.3, 0.3, 0.3), (0.7, 0.7, 0.7)), opacity=(0.6, 0.0)),
    )
    loads = (forces.Gravity(g), forces.Buoyancy(1.225, volume), forces.StokesDrag(drag), stirring)
    puffs = Scene(plume.unborn(), mass, loads, emitter=plume)

    def rising(flight):
        age, _ = _newest(flight)
        flow = np.asarray(stirring.flow(flight.time[-1], jnp.asarray(flight.position[-1])))
        return np.mean((np.asarray(flight.velocity[-1]) - flow)[age > 10 * lag, 1])

    return Problem(
        puffs,
        duration=3.0,
        frames=16,
        truths=(
            # they lag behind eddies that they meet as they rise, by τ Du/Dt, which is of both signs
            Truth("through the air it rises at its terminal speed [m/s]", rising, rise, 0.02 * rise),
            _alive(rate * life),
        ),
    )


@scene
def snow(rate: float = 100.0, fall: float = 1.0, wind: float = 0.5) -> Problem:
    """Snow that falls at its terminal speed, drifts with the wind and stays where it lands."""
    g, mass, life = 9.8, 2e-6, 3.0
    cloud = emitters.Emitter(
        310,
        emitters.Box((-2.0, 1.5, -2.0), (2.0, 1.6, 2.0)),
        key=3,
        rate=rate,
        life=life,
        speed=fall,
        direction=(0.0, -1.0, 0.0),
        look=emitters.Look(colour=((0.9, 0.95, 1.0),) * 2),
    )
    ground = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=0.0, friction=1.0)
    air = forces.StokesDrag(mass * g / fall, wind=(wind, 0.0, 0.0))
    flakes = Scene(cloud.unborn(), mass, (forces.Gravity(g), air), (ground,), emitter=cloud)

    def off_the_way(flight):
        """Flakes are born at their terminal speed, and take m/b to go with the wind."""
        age, _ = _newest(flight)
        emitter = flight.final_scene.emitter
        start = np.asarray(emitter.births(emitter.slot, emitter.generation).position)
        down = np.minimum(age, start[:, 1] / fall)
        lag = fall / g
        along = wind * (down - lag * (1 - np.exp(-down / lag)))
        expected = start + np.stack([along, -fall * down, np.zeros_like(down)], axis=-1)
        return np.abs(np.asarray(flight.position[-1]) - expected)[age > 0].max()

    return Problem(
        flakes,
        duration=4.0,
        frames=16,
        truths=(
            Truth(
                "falls at its terminal speed, drifts as the wind takes it, lies where it lands [m]",
                off_the_way,
                0.0,
                1e-8,
            ),
            _alive(rate * life),
        ),
    )


def _newest(flight: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Age [s] of the particles alive at the end, 0 of all others, and the velocity each was born with [m/s]."""
    emitter, now = flight.final_scene.emitter, flight.time[-1]
    age = np.where(emitter.alive(now), emitter.age(now), 0.0)
    return age, np.asarray(emitter.births(emitter.slot, emitter.generation).velocity)


def _alive(expected: float) -> Truth:
    """In the steady state the number alive is rate times life."""

    def count(flight):
        return np.sum(flight.final_scene.emitter.alive(flight.time[-1]))

    return Truth("as many are alive as are born in a life", count, expected, 1.0)
