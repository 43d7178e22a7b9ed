"""Scenes nobody chose: random forces, springs and contacts, the same for the same seed."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from physjax import Particles, Scene, contacts, forces
from physjax.physics.springs import Springs


def random_scene(seed: int) -> tuple[Scene, float]:
    """A scene and how long to run it [s]: balls that fly, balls that bounce, a net of springs, bodies that attract."""
    rng = np.random.default_rng(seed)
    return (_flying, _bouncing, _net, _cluster)[seed % 4](rng)


def _flying(rng):
    """One to sixteen balls through air, on springs, in a turning frame."""
    dim = int(rng.integers(2, 4))
    state = _balls(rng, int(rng.integers(1, 17)), dim)
    return Scene(state, mass=rng.uniform(0.1, 2.0), forces=_loads(rng, dim)), rng.uniform(0.5, 3.0)


def _bouncing(rng):
    """A few balls above a floor, through air."""
    state = _balls(rng, int(rng.integers(1, 9)), 2)
    floor = contacts.Plane((0.0, -0.5), (0.0, 1.0), restitution=rng.uniform(0.5, 1.0), friction=rng.uniform(0.0, 0.3))
    parts = (forces.Gravity(), forces.QuadraticDrag(area=rng.uniform(0.0, 0.05), coefficient=0.5, wind=(3.0, 20.0)))
    return Scene(state, mass=rng.uniform(0.5, 2.0), forces=parts, contacts=(floor,)), rng.uniform(0.5, 1.5)


def _net(rng):
    """Nodes on a jagged line and a few springs across, two of them held."""
    count = int(rng.integers(3, 13))
    place = np.cumsum(rng.uniform(0.1, 0.4, (count, 2)) * [1.0, 0.3], axis=0)
    pairs = [*pairwise(range(count)), *((i, i + 2) for i in range(count - 2) if rng.random() < 0.5)]
    lengths = [float(np.linalg.norm(place[i] - place[j])) * rng.uniform(0.9, 1.1) for i, j in pairs]
    damping = None if rng.random() < 0.5 else 10 ** rng.uniform(-2, 0)
    springs = Springs(pairs, stiffness=10 ** rng.uniform(1, 3.5), rest_length=lengths, damping=damping)
    held = np.zeros(count, bool)
    held[[0, -1]] = True
    state = Particles(jnp.asarray(place), jnp.zeros((count, 2)))
    parts = (forces.Gravity(), springs, forces.StokesDrag(10 ** rng.uniform(-3, -1)))
    return Scene(state, mass=rng.uniform(0.05, 0.5), forces=parts, pinned=held), rng.uniform(0.5, 2.0)


def _cluster(rng):
    """Three to six bodies that attract each other, softened, so that they may come close."""
    count = int(rng.integers(3, 7))
    place, speed = rng.normal(size=(2, count, 3))
    attraction = forces.Gravitation(G=1.0, softening=rng.uniform(0.2, 0.5))
    return Scene(
        Particles(jnp.asarray(place), jnp.asarray(0.5 * speed)), mass=rng.uniform(0.3, 1.0, count), forces=(attraction,)
    ), rng.uniform(1.0, 4.0)


def _balls(rng, count, dim):
    place, speed = rng.uniform(0.0, 1.0, (count, dim)), rng.normal(size=(count, dim)) * 10 ** rng.uniform(0, 1)
    return Particles(jnp.asarray(place), jnp.asarray(speed))


def _loads(rng, dim):
    """Gravity and one to three others."""
    wind = tuple(rng.normal(size=dim))
    others = [
        forces.QuadraticDrag(area=10 ** rng.uniform(-3, -1), coefficient=0.5, wind=wind),
        forces.StokesDrag(10 ** rng.uniform(-2, 0.5), wind=wind),
        forces.Anchor(
            tuple(rng.uniform(-1, 1, dim)), stiffness=10 ** rng.uniform(0, 3), rest_length=rng.uniform(0, 0.5)
        ),
        forces.RotatingFrame(rng.uniform(0.5, 3.0)) if dim == 2 else forces.RotatingFrame(tuple(rng.normal(size=3))),
    ]
    chosen = rng.permutation(len(others))[: rng.integers(1, 4)]
    return (forces.Gravity(), *(others[i] for i in sorted(chosen)))
