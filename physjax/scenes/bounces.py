"""Balls that bounce and sleds that slide and stop: contacts are resolved at their time of impact within the step.

Contacts act on the centre of a ball, so each surface is a radius in front of the floor or wall that is drawn.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.energy.quantities import ENERGY
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

SHORTEST_BOUNCE_SECONDS = 1e-7
"""A ball whose flight is shorter than this lies on the floor: it rises by less than a nanometre."""


@scene
def bouncing_ball(restitution: float = 0.8, wind: float = 10.0, g: float = 9.8) -> Problem:
    """Forty-eight basketballs dropped from 1 to 2 m in a downdraught of 10 m/s, each bouncing three or four times.

    In still air the drag -|v|v is not smooth where a ball turns round, which limits every method to order 3. In the
    downdraught the relative velocity never changes sign, so that only the treatment of the bounce can lower an order.
    """
    mass, radius, coefficient, density = 0.624, 0.12, 0.5, 1.225
    area = np.pi * radius**2
    drop = np.linspace(1.0, 2.0, 48)
    balls = Scene(
        Particles(jnp.asarray(radius + drop)[:, None], jnp.zeros((drop.size, 1))),
        mass=mass,
        forces=(forces.Gravity(g, up=0), forces.QuadraticDrag(area, coefficient, density, wind=(-wind,))),
        contacts=(contacts.Plane((radius,), (1.0,), restitution=restitution),),
    )
    air = _Downdraught(g, wind, np.sqrt(2 * mass * g / (density * coefficient * area)))
    impact = -air.after(air.landing(drop, 0.0), 0.0)[1]

    def exact(t):
        height, velocity = _trace_bounces(t, air, drop, restitution)
        return Particles(radius + height[..., None], velocity[..., None])

    def apex(flight):
        """The apex after the first bounce, from the first frame on the way up."""
        rising = np.argmax(flight.velocity[..., 0] > 0, axis=0)
        height, velocity = (leaf[rising, np.arange(drop.size), 0] for leaf in flight.state)
        return height - radius + air.climb(velocity)

    excess = lambda flight: np.maximum(apex(flight) - restitution**2 * drop, 0.0)  # noqa: E731
    rises = air.climb(restitution * impact)
    return Problem(
        balls,
        duration=2.0,
        exact=exact,
        truths=(
            Truth("rebounds to the height reached from K_r times the impact speed [m]", apex, rises, 1e-9),
            Truth("rebounds to less than K_r² h, its height in a vacuum [m]", excess, 0.0, 0.0),
        ),
    )


@scene
def tennis_ball(g: float = 9.8) -> Problem:
    """Tennis balls by the rules: dropped from 254 cm they rebound to 135 to 147 cm, which is 0.7291 <= K_r <= 0.7607."""
    mass, radius, drop = 0.0577, 0.0335, 2.54
    restitution = np.linspace(0.7291, 0.7607, 5)
    start = jnp.full((restitution.size, 1), radius + drop)
    balls = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=mass,
        forces=(forces.Gravity(g, up=0),),
        contacts=(contacts.Plane((radius,), (1.0,), restitution=restitution),),
    )
    fall = np.sqrt(2 * drop / g)

    def exact(t):
        t = t[:, None]
        since = t - fall
        falling, speed = since < 0, restitution * g * fall
        height = np.where(falling, drop - 0.5 * g * t**2, speed * since - 0.5 * g * since**2)
        return Particles(radius + height[..., None], np.where(falling, -g * t, speed - g * since)[..., None])

    def rebound(flight):
        return flight.position[-1, :, 0] - radius + flight.velocity[-1, :, 0] ** 2 / (2 * g)

    return Problem(
        balls,
        duration=1.5,
        exact=exact,
        truths=(
            Truth("rebounds to K_r² h [m]", rebound, restitution**2 * drop, 1e-9),
            Truth("rebounds to 135 to 147 cm [m]", rebound, 1.41, 0.06),
        ),
    )


@scene
def balls_in_a_box(count: int = 64, seed: int = 0) -> Problem:
    """Sixty-four balls in a square box of one metre with elastic walls; they do not collide with each other."""
    radius, side = 0.02, 1.0
    lower, upper = radius, side - radius
    random = np.random.default_rng(seed)
    position = random.uniform(lower, upper, (count, 2))
    velocity = random.normal(size=(count, 2))
    corner = np.ones(2)
    balls = Scene(
        Particles(jnp.asarray(position), jnp.asarray(velocity)),
        mass=2.7e-3,
        contacts=(contacts.Room(lower * corner, upper * corner),),
    )

    def exact(t):
        # a straight line through mirror images of the box, folded back into it
        room = upper - lower
        along = (position - lower + velocity * t[:, None, None]) / room
        there = np.mod(along, 2)
        return Particles(lower + room * np.minimum(there, 2 - there), np.where(there < 1, velocity, -velocity))

    return Problem(
        balls,
        duration=2.0,
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth(
                "every |velocity component| is conserved [m/s]",
                lambda f: np.abs(f.velocity[-1]),
                np.abs(velocity),
                1e-12,
            ),
            Truth(
                "no ball leaves the box [m]",
                lambda f: np.maximum(np.abs(f.position - side / 2) - side / 2 + radius, 0),
                0.0,
                1e-12,
            ),
        ),
    )


class SpinUp(eqx.Module):
    """The angle of a room that spins at a constant rate [rad/s]."""

    rate: jax.Array

    def __call__(self, t: ArrayLike) -> Array:
        """Ω t [rad]."""
        return self.rate * t


@scene
def spinning_room(spin: float = 1.5, count: int = 48, seed: int = 0) -> Problem:
    """Balls in a square room of a space station, which spins: its elastic walls hit them, and carry none of them along.

    In the frame of the room ½|u|² - ½Ω²r², Jacobi's integral, is constant in flight and through every bounce.
    """
    random = np.random.default_rng(seed)
    position, velocity = random.uniform(-0.9, 0.9, (count, 2)), random.normal(size=(count, 2))
    spun = contacts.Motion(angle=SpinUp(jnp.asarray(float(spin))))
    walls = contacts.Room((-1.0, -1.0), (1.0, 1.0), motion=spun)
    balls = Scene(Particles(jnp.asarray(position), jnp.asarray(velocity)), mass=2.7e-3, contacts=(walls,))

    def jacobi(flight: Trajectory) -> np.ndarray:
        x, v = np.asarray(flight.position), np.asarray(flight.velocity)
        seen = v - spin * np.stack([-x[..., 1], x[..., 0]], axis=-1)
        return 0.5 * (seen * seen).sum(axis=-1) - 0.5 * spin**2 * (x * x).sum(axis=-1)

    def beyond(flight: Trajectory) -> np.ndarray:
        angle = spin * np.asarray(flight.time)[:, None]
        (c, s), x = (np.cos(angle), np.sin(angle)), np.asarray(flight.position)
        inside = np.stack([c * x[..., 0] + s * x[..., 1], c * x[..., 1] - s * x[..., 0]])
        return np.maximum(np.abs(inside) - 1.0, 0.0)

    return Problem(
        balls,
        duration=2.0,
        truths=(
            Truth("Jacobi's integral is conserved [m²/s²]", lambda f: jacobi(f) - jacobi(f)[:1], 0.0, 1e-9),
            Truth("no ball leaves the room [m]", beyond, 0.0, 1e-9),
        ),
        frames=48,
    )


@scene
def sled(angle: float = 0.3, g: float = 9.8) -> Problem:
    """Five sleds on a slope of 0.3 rad with dry friction: one sticks, the others slide, stop, or come back down."""
    # sleds at rest, from the start or after they have stopped, stick where μ_s > tan(angle) = 0.309
    static, kinetic = np.array([0.35, 0.20, 0.50, 0.50, 0.20]), np.array([0.30, 0.10, 0.45, 0.40, 0.10])
    uphill = np.array([0.0, 0.0, -2.0, 3.0, 3.0])
    slope = np.array([np.cos(angle), np.sin(angle)])
    start = 1.5 * np.arange(5.0)
    normal, rough = (-slope[1], slope[0]), contacts.Coulomb(static, kinetic)
    sleds = Scene(
        Particles(jnp.asarray(start[:, None] * slope), jnp.asarray(uphill[:, None] * slope)),
        mass=20.0,
        forces=(forces.Gravity(g),),
        contacts=(contacts.Plane((0.0, 0.0), normal, restitution=0.0, coulomb=rough),),
    )
    braking, stop, down = _solve_slides(angle, g, static, kinetic, uphill)

    def exact(t):
        t = t[:, None]
        before, after = np.minimum(t, stop), np.maximum(t - stop, 0.0)
        along = start + uphill * before + 0.5 * braking * before**2 + 0.5 * down * after**2
        speed = np.where(t < stop, uphill + braking * t, down * after)
        return Particles(along[..., None] * slope, speed[..., None] * slope)

    stopping = (uphill**2 / (2 * np.abs(braking)))[2:4]
    distance = lambda flight: np.linalg.norm(flight.position - flight.position[0], axis=-1)  # noqa: E731
    return Problem(
        sleds,
        duration=2.5,
        exact=exact,
        truths=(
            Truth("does not move below the friction angle [m]", lambda f: distance(f)[:, 0], 0.0, 1e-12),
            Truth("stops after v²/(2g(μ_k cos θ ∓ sin θ)) [m]", lambda f: distance(f)[-1, 2:4], stopping, 1e-9),
            Truth("stays at rest when it has stopped [m/s]", lambda f: f.velocity[-1, [0, 2, 3]], 0.0, 0.0),
            Truth(
                "slides back down at g(sin θ - μ_k cos θ) (t - stop) [m/s]",
                lambda f: f.velocity[-1, 4] @ slope,
                down[4] * (2.5 - stop[4]),
                1e-9,
            ),
        ),
    )


def _solve_slides(angle, g, static, kinetic, uphill):
    """Acceleration along the slope until a sled stops [m/s²], when that is [s], and the acceleration from there on [m/s²]."""
    way = np.sign(uphill)
    braking = -g * np.sin(angle) - way * kinetic * g * np.cos(angle)
    stop = np.where(way == 0, 0.0, -uphill / np.where(way == 0, 1.0, braking))
    down = np.where(static > np.tan(angle), 0.0, -g * (np.sin(angle) - kinetic * np.cos(angle)))
    return braking, stop, down


class _Downdraught(NamedTuple):
    """Vertical motion in air that moves down at `wind` [m/s], faster than any ball: v + wind = v_t tan(φ₀ - gt/v_t)."""

    g: float
    wind: float
    terminal: float

    def after(self, t, velocity):
        """Height gained [m] and velocity [m/s] at a time t [s] after a start at a velocity, upwards positive."""
        start = np.arctan((velocity + self.wind) / self.terminal)
        now = start - self.g * t / self.terminal
        height = self.terminal**2 / self.g * np.log(np.cos(now) / np.cos(start)) - self.wind * t
        return height, self.terminal * np.tan(now) - self.wind

    def climb(self, velocity):
        """Height to which a start at a velocity rises [m]."""
        turn = np.arctan((velocity + self.wind) / self.terminal) - np.arctan(self.wind / self.terminal)
        return self.after(self.terminal / self.g * turn, velocity)[0]

    def landing(self, height, velocity):
        """Time to fall to the floor from a height [s]: Newton's method from the time in a vacuum, which is later."""
        t = (velocity + np.sqrt(velocity**2 + 2 * self.g * height)) / self.g
        for _ in range(20):
            gained, speed = self.after(t, velocity)
            t = t - (height + gained) / speed
        return t


def _trace_bounces(times, air, height, restitution):
    """Height and velocity at the times (rows) of balls dropped from rest at heights (columns)."""
    t, floor = times[:, None], np.zeros_like(height)
    begun = velocity = position = speed = floor
    while begun.min() <= times.max():
        flight = air.landing(height, velocity)
        gained, now = air.after(np.clip(t - begun, 0.0, flight), velocity)
        position, speed = np.where(t < begun, position, height + gained), np.where(t < begun, speed, now)
        # infinitely many bounces end in a finite time: flights too short to see are rest
        begun = np.where(flight > SHORTEST_BOUNCE_SECONDS, begun + flight, np.inf)
        velocity, height = -restitution * air.after(flight, velocity)[1], floor
    return position, speed
