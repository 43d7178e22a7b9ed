"""Oscillators: springs, a chain of masses, a conical pendulum, a floating ball."""

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import forces
from physjax.physics.springs.springs import Springs
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.study.energy.quantities import ENERGY
from physjax.study.problem import Problem, Truth


@scene
def oscillator(stiffness: tuple = (1.0, 10.0, 100.0, 1000.0), mass: float = 1.0) -> Problem:
    """Four masses on springs from soft to stiff: x = cos ωt; as the step grows, the stiffest fails first."""
    k = np.asarray(stiffness, float)
    omega = np.sqrt(k / mass)
    start = jnp.ones((k.size, 1))
    springs = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=mass,
        forces=(forces.Anchor(point=jnp.zeros(1), stiffness=k),),
    )

    def exact(t):
        phase = t[:, None, None] * omega[:, None]
        return Particles(np.cos(phase), -omega[:, None] * np.sin(phase))

    duration = float(2 * np.pi / omega.min())
    return Problem(
        springs,
        duration=duration,
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth(
                "at cos ωt after the period of the softest [m]",
                lambda flight: flight.position[-1, :, 0],
                np.cos(omega * duration),
                1e-8,
            ),
        ),
    )


@scene
def oscillator_chain(count: int = 50, stiffness: float = 40.0, mass: float = 0.1, spacing: float = 0.1) -> Problem:
    """Fifty masses in a row between two walls, joined by springs: the first is released, and a pulse runs to and fro.

    All modes sin(jπi/(n+1)) take part, each with its own frequency 2√(k/m) sin(jπ/(2(n+1))): short waves are slower than
    long ones (dispersion).
    """
    place = np.arange(count + 2)
    modes = np.arange(1, count + 1)
    omega = 2 * np.sqrt(stiffness / mass) * np.sin(modes * np.pi / (2 * (count + 1)))
    shape = np.sin(np.pi * np.outer(modes, place) / (count + 1))
    amount = 0.8 * spacing * shape[:, 1] * 2 / (count + 1)
    rest = spacing * place
    start = jnp.asarray((rest + amount @ shape)[:, None])
    chain = Springs(np.stack([place[:-1], place[1:]], axis=1), stiffness, spacing)
    masses = Scene(
        Particles(start, jnp.zeros_like(start)), mass=mass, forces=(chain,), pinned=(place % (count + 1)) == 0
    )

    def exact(t):
        phase = np.multiply.outer(np.asarray(t, float), omega)
        moved, speed = (amount * np.cos(phase)) @ shape, (-amount * omega * np.sin(phase)) @ shape
        return Particles((rest + moved)[..., None], speed[..., None])

    def frequencies(flight):
        """The slope of each mode's phase, followed from frame to frame."""
        share = shape.T / (amount * (count + 1) / 2)
        x, v = (np.asarray(leaf[..., 0]) for leaf in flight.state)
        phase = np.unwrap(np.arctan2(-(v @ share) / omega, (x - rest) @ share), axis=0)
        return phase[-1] / np.asarray(flight.time)[-1]

    return Problem(
        masses,
        duration=float(2 * np.pi / omega[0]),
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth(
                "every mode has its frequency 2√(k/m) sin(jπ/(2(n+1))) [relative]",
                lambda flight: frequencies(flight) / omega,
                1.0,
                1e-6,
            ),
        ),
        frames=128,
    )


@scene
def conical_pendulum(
    length: float = 1.0, angle: float = 0.6, mass: float = 0.5, stiffness: float = 2e3, g: float = 9.8
) -> Problem:
    """A mass on a string in a horizontal circle: ω² = g/(L cosθ), tension mg/cosθ, centripetal force mω²r."""
    radius, omega = length * np.sin(angle), np.sqrt(g / (length * np.cos(angle)))
    pull = mass * g / np.cos(angle)
    string = Springs([[0, 1]], stiffness=stiffness, rest_length=length - pull / stiffness)
    start = jnp.asarray([[0.0, 0.0, 0.0], [radius, -length * np.cos(angle), 0.0]])
    circling = Scene(
        Particles(start, jnp.asarray([[0.0, 0.0, 0.0], [0.0, 0.0, radius * omega]])),
        mass=mass,
        forces=(forces.Gravity(g), string),
        pinned=np.array([True, False]),
    )

    def exact(t):
        x, v = (np.zeros((len(t), 2, 3)) for _ in range(2))
        x[:, 1] = np.stack([radius * np.cos(omega * t), np.full(len(t), start[1, 1]), radius * np.sin(omega * t)], -1)
        v[:, 1, 0], v[:, 1, 2] = -omega * x[:, 1, 2], omega * x[:, 1, 0]
        return Particles(x, v)

    def tilt(flight):
        return np.arctan2(np.linalg.norm(flight.position[:, 1, ::2], axis=-1), -flight.position[:, 1, 1])

    def tension(flight):
        return stiffness * (np.linalg.norm(flight.position[:, 1], axis=-1) - float(string.rest_length))

    inward = lambda flight: tension(flight) * np.sin(tilt(flight))  # noqa: E731
    return Problem(
        circling,
        duration=float(4 * np.pi / omega),
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth("is at the angle tanθ = ω²r/g [rad]", tilt, np.arctan2(omega**2 * radius, g), 1e-8),
            Truth("the tension of the string is mg/cosθ [N]", tension, pull, 1e-5),
            Truth("its horizontal component is mω²r [N]", inward, mass * omega**2 * radius, 1e-5),
        ),
    )


@scene
def floating_ball(radius: float = 0.1, density: float = 400.0, drop: float = 0.3, g: float = 9.8) -> Problem:
    """A light ball dropped into water: it dives, bobs, and floats where it displaces its own weight of water."""
    water, mass = 1000.0, density * 4 / 3 * np.pi * radius**3
    dropped = Scene(
        Particles(jnp.asarray([drop]), jnp.zeros(1)),
        mass=mass,
        forces=(
            forces.Gravity(g, up=0),
            forces.Buoyancy(density=water, radius=radius, surface=0.0, g=g, up=0),
            forces.StokesDrag(3.0 * mass),
        ),
    )
    # πh²(3r - h)/3 = V ρ/ρ_water, between dry and drowned
    depths = np.roots([-np.pi / 3, np.pi * radius, 0.0, -mass / water])
    depth = float(next(h.real for h in depths if abs(h.imag) < 1e-12 and 0 < h.real < 2 * radius))

    def weight_displaced(flight):
        shown = Particles(flight.position[-1], flight.velocity[-1])
        return water * float(dropped.forces[1].displaced_volume(shown))

    return Problem(
        dropped,
        duration=15.0,
        truths=(
            Truth(
                "floats at the depth of Archimedes' principle [m]", lambda f: radius - f.position[-1, 0], depth, 1e-8
            ),
            Truth("displaces its own mass of water [kg]", weight_displaced, mass, 1e-6),
            Truth("is at rest at the end [m/s]", lambda f: f.velocity[-1], 0.0, 1e-8),
            Truth("its centre was under water on the way [m]", lambda f: f.position.min(), -0.15, 0.15),
        ),
        frames=128,
    )
