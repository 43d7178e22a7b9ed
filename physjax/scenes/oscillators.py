"""Things that swing."""

import jax.numpy as jnp
import numpy as np

from physjax.physics import forces
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
