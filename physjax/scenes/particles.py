"""Particle systems: explosion, fountain, smoke, fire, sparks and snow.

Each particle is compared with the closed form from its own birth, which the emitter gives for every slot and generation.
"""

import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts, emitters, forces
from physjax.physics.forces import flows
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

UP = (0.0, 1.0, 0.0)


@scene
def explosion(particles: int = 400, speed: float = 8.0, g: float = 9.8) -> Problem:
    """Four hundred fragments thrown in all directions at one speed: a sphere that grows and falls."""
    center = np.asarray([0.0, 20.0, 0.0])
    burst = emitters.Emitter(
        particles,
        emitters.Point(center),
        key=0,
        life=2.5,
        speed=speed,
        size=0.25,
        opposed=True,
        look=emitters.Look(colour=((1.0, 0.6, 0.1), (0.5, 0.1, 0.1)), opacity=(1.0, 0.2)),
    )
    fragments = Scene(burst.unborn(), 0.01, (forces.Gravity(g),), emitter=burst)

    def off_the_sphere(flight):
        age = np.asarray(flight.time)[:, None]
        away = flight.position - center + 0.5 * g * age[..., None] ** 2 * np.asarray(UP)
        return np.abs(np.linalg.norm(away, axis=-1) - speed * age).max()

    def momentum(flight):
        return np.mean(flight.velocity[-1], axis=0) + g * flight.time[-1] * np.asarray(UP)

    return Problem(
        fragments,
        duration=2.0,
        frames=16,
        truths=(
            Truth("every fragment is on a sphere of radius s t that falls freely [m]", off_the_sphere, 0.0, 1e-9),
            Truth("total momentum over mass, less that of free fall, is zero to rounding [m/s]", momentum, 0.0, 1e-12),
        ),
    )


@scene
def fountain(rate: float = 200.0, speed: float = 6.0, cone: float = 0.5, restitution: float = 0.4) -> Problem:
    """A fountain of two hundred drops per second in a cone of half a radian, bouncing on frictionless ground."""
    g, life = 9.8, 1.6
    jet = emitters.Emitter(
        330, emitters.Point((0.0, 0.0, 0.0)), key=1, rate=rate, life=life, speed=speed, direction=UP, cone=cone
    )
    ground = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=restitution)
    drops = Scene(jet.unborn(), 1e-4, (forces.Gravity(g),), (ground,), emitter=jet)

    return Problem(
        drops,
        duration=2.0,
        frames=16,
        truths=(
            *_build_bounce_truths(g, restitution),
            _build_alive_truth(rate * life),
        ),
    )


@scene
def smoke(rate: float = 150.0, rise: float = 1.2, eddies: float = 0.3) -> Problem:
    """A plume of smoke that rises by buoyancy against drag, stirred by incompressible turbulence."""
    life = 2.0
    plume = emitters.Emitter(
        320,
        emitters.Disc((0.0, 0.0, 0.0), UP, 0.1),
        key=2,
        rate=rate,
        life=life,
        size=0.05,
        look=emitters.Look(size=(1.0, 4.0), colour=((0.3, 0.3, 0.3), (0.7, 0.7, 0.7)), opacity=(0.6, 0.0)),
    )
    puffs, rises = _build_hot_gas(plume, rise, 0.02, eddies, 0.8)
    return Problem(puffs, duration=3.0, frames=16, truths=(rises, _build_alive_truth(rate * life)))


@scene
def fire(rate: float = 400.0, rise: float = 1.5, eddies: float = 0.3) -> Problem:
    """A fire: hot gas that rises in a turbulent flow and glows from yellow to dark red, with additive light."""
    life, brightness = 0.8, (0.15, 0.3, 0.15, 0.0)
    flame = emitters.Emitter(
        330,
        emitters.Disc((0.0, 0.0, 0.0), UP, 0.15),
        key=4,
        rate=rate,
        life=life,
        size=0.12,
        look=emitters.Look(
            size=(1.0, 1.3, 0.8, 0.3),
            colour=((1.0, 0.75, 0.3), (1.0, 0.5, 0.1), (0.9, 0.2, 0.03), (0.4, 0.05, 0.02)),
            opacity=brightness,
            glows=True,
        ),
    )
    gas, rises = _build_hot_gas(flame, rise, 0.01, eddies, 0.5)

    def light(flight):
        return np.sum(_final_emitter(flight).appearance(flight.time[-1]).opacity)

    mean = np.mean((np.asarray(brightness[1:]) + np.asarray(brightness[:-1])) / 2)
    steady = Truth("the light is rate × life × mean opacity [1]", light, rate * life * mean, max(brightness))
    return Problem(gas, duration=1.6, frames=16, truths=(rises, steady, _build_alive_truth(rate * life)))


@scene
def sparks(rate: float = 250.0, speed: float = 3.0, restitution: float = 0.5, cooling: float = 0.5) -> Problem:
    """Sparks from a grinding wheel at a height of one metre, bouncing on the floor and cooling by Newton's law."""
    g, life, height = 9.8, 1.2, 1.0
    # e^(-t/τ) at 33 equally spaced ages; linear interpolation between them is off by at most (Δt/τ)²/8
    ages = np.linspace(0.0, life, 33)
    heat = np.exp(-ages / cooling)
    wheel = emitters.Emitter(
        310,
        emitters.Point((0.0, height, 0.0)),
        key=6,
        rate=rate,
        life=life,
        speed=speed,
        speed_spread=0.3,
        direction=(1.0, 1.0, 0.0),
        cone=0.5,
        size=0.02,
        look=emitters.Look(colour=np.stack([heat**0.25, heat**0.75, heat**2], axis=-1), opacity=heat, glows=True),
    )
    floor = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=restitution)
    flying = Scene(wheel.unborn(), 1e-6, (forces.Gravity(g),), (floor,), emitter=wheel)

    def off_newton(flight):
        emitter, now = _final_emitter(flight), flight.time[-1]
        seen = emitter.appearance(now)
        return np.abs(np.asarray(seen.opacity) - np.exp(-np.asarray(emitter.age(now)) / cooling))[seen.alive].max()

    cools = Truth("cools as e^(-t/τ) [1]", off_newton, 0.0, float(ages[1] / cooling) ** 2 / 8)
    truths = (*_build_bounce_truths(g, restitution, height), cools, _build_alive_truth(rate * life))
    return Problem(flying, duration=2.0, frames=16, truths=truths)


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
        size=0.06,
        look=emitters.Look(colour=((0.35, 0.55, 0.8),) * 2),
    )
    ground = contacts.Plane((0.0, 0.0, 0.0), UP, restitution=0.0, friction=1.0)
    air = forces.StokesDrag(mass * g / fall, wind=(wind, 0.0, 0.0))
    flakes = Scene(cloud.unborn(), mass, (forces.Gravity(g), air), (ground,), emitter=cloud)

    def path_error(flight):
        """Flakes are born at their terminal speed, and reach the velocity of the wind with the time constant m/b."""
        age, _ = _read_ages(flight)
        emitter = _final_emitter(flight)
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
            Truth("falls at its terminal speed, drifts with the wind, stays where it lands [m]", path_error, 0.0, 1e-8),
            _build_alive_truth(rate * life),
        ),
    )


def _read_ages(flight: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Age [s] of the particles alive at the end, 0 of all others, and the velocity each was born with [m/s]."""
    emitter, now = _final_emitter(flight), flight.time[-1]
    age = np.where(emitter.alive(now), emitter.age(now), 0.0)
    return age, np.asarray(emitter.births(emitter.slot, emitter.generation).velocity)


def _build_bounce_truths(g: float, restitution: float, height: float = 0.0) -> tuple[Truth, Truth]:
    """Thrown from a height [m], particles move uniformly over frictionless ground, and vertically in bounces."""

    def seen(flight):
        age, velocity = _read_ages(flight)
        return age, velocity, np.asarray(flight.position[-1])

    def off_the_line(flight):
        age, velocity, x = seen(flight)
        return np.abs(x[:, [0, 2]] - age[:, None] * velocity[:, [0, 2]])[age > 0].max()

    def off_the_parabolas(flight):
        age, velocity, x = seen(flight)
        impact = np.sqrt(velocity[:, 1] ** 2 + 2 * g * height)
        again = age - (velocity[:, 1] + impact) / g
        first = height + velocity[:, 1] * age - 0.5 * g * age**2
        second = restitution * impact * again - 0.5 * g * again**2
        off = np.abs(x[:, 1] - np.where(again < 0, first, second))
        return off[(age > 0) & (again < 2 * restitution * impact / g)].max()

    return (
        Truth("lands where v_x takes it in the time of flight, and goes on [m]", off_the_line, 0.0, 1e-9),
        Truth("first flight as thrown, second to K_r² of its height [m]", off_the_parabolas, 0.0, 1e-9),
    )


def _build_hot_gas(
    emitter: emitters.Emitter, rise: float, lag: float, eddies: float, width: float
) -> tuple[Scene, Truth]:
    """What buoyancy lifts through the air at `rise` [m/s], `lag` [s] behind eddies of a speed [m/s] and width [m]."""
    g, mass = 9.8, 1e-6
    drag = mass / lag
    # Archimedes carries the weight and what the drag takes at the terminal speed
    volume = (mass * g + drag * rise) / (1.225 * g)
    stirring = flows.Turbulence(drag, eddies, width, key=5)
    loads = (forces.Gravity(g), forces.Buoyancy(1.225, volume), forces.StokesDrag(drag), stirring)

    def rising(flight):
        age, _ = _read_ages(flight)
        flow = np.asarray(stirring.flow(flight.time[-1], jnp.asarray(flight.position[-1])))
        return np.mean((np.asarray(flight.velocity[-1]) - flow)[age > 10 * lag, 1])

    # smoke lags behind the eddies that it rises through by τ Du/Dt, which averages out over particles
    rises = Truth("rises relative to the air at its terminal speed [m/s]", rising, rise, 0.02 * rise)
    return Scene(emitter.unborn(), mass, loads, emitter=emitter), rises


def _build_alive_truth(expected: float) -> Truth:
    """In the steady state the number of particles alive is rate times life."""

    def count(flight):
        return np.sum(_final_emitter(flight).alive(flight.time[-1]))

    return Truth("the number alive is rate times life", count, expected, 1.0)


def _final_emitter(flight: Trajectory) -> emitters.Emitter:
    """The emitter at the end, with what is alive then."""
    emitter = None if flight.final_scene is None else flight.final_scene.emitter
    assert isinstance(emitter, emitters.Emitter)
    return emitter
