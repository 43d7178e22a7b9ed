"""Things that swing."""

import jax.numpy as jnp
import numpy as np

from physjax.physics import forces
from physjax.physics.springs import Springs
from physjax.scene import Particles, Scene
from physjax.scenes.gallery import scene
from physjax.study.energy import ENERGY
from physjax.study.problem import Problem, Truth


@scene
def oscillator(stiffness: tuple = (1.0, 10.0, 100.0, 1000.0), mass: float = 1.0) -> Problem:
    """Four masses on springs from light to stiff: x = cos ωt, at one step size the stiffest fails first."""
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
                "back at cos ωt after the period of the lightest [m]",
                lambda flight: flight.position[-1, :, 0],
                np.cos(omega * duration),
                1e-8,
            ),
        ),
    )


@scene
def oscillator_chain(count: int = 50, stiffness: float = 40.0, mass: float = 0.1, spacing: float = 0.1) -> Problem:
    """Fifty masses in a row between two walls, tied by springs: the first is let go, and a pulse runs to and fro.

    All modes sin(jπi/(n+1)) take part, each with its own frequency 2√(k/m) sin(jπ/(2(n+1))): the short waves are slower
    than the long ones and stay behind.
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
