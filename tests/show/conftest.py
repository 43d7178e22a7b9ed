"""Short runs to look at, made once."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, lattices, methods, simulate


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="session")
def drape():
    """A cloth above a ball above a floor: 16 frames in half a second."""
    sheet = lattices.cloth(
        1.0, 1.2, 6, 5, mass=0.2, structural=50.0, damping=0.05, corner=(-0.5, 0.6, -0.6), down=(0, 0, 1)
    )
    scene = Scene(
        sheet.state,
        sheet.mass,
        (forces.Gravity(), sheet.springs),
        (contacts.Sphere((0, 0.25, 0), 0.25, restitution=0.0), contacts.Plane((0, 0, 0), (0, 1, 0), restitution=0.0)),
    )
    return simulate(scene, methods.semi_implicit_euler, dt=1 / 600, steps=300, save_every=20), sheet


@pytest.fixture(scope="session")
def ruin():
    """A bridge in the plane that breaks under its own weight: 21 frames in one second."""
    sheet = lattices.bridge(4.0, 1.0, 4, mass=100.0, stiffness=2e4, damping=50.0, breaks_at=0.01)
    scene = Scene(sheet.state, sheet.mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["supports"])
    return simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=1000, save_every=50), sheet


@pytest.fixture(scope="session")
def swarm():
    """Twelve balls in a room of the plane: 31 frames in one second."""
    random = np.random.default_rng(0)
    state = Particles(jnp.asarray(random.uniform(0.2, 0.8, (12, 2))), jnp.asarray(random.normal(size=(12, 2))))
    scene = Scene(
        state, forces=(forces.Gravity(),), contacts=(contacts.Room((0.0, 0.0), (1.0, 1.0), response=contacts.project),)
    )
    return simulate(scene, methods.verlet, dt=1 / 300, steps=300, save_every=10)


@pytest.fixture(scope="session")
def burst():
    """A cloth that blows up: step too large."""
    sheet = lattices.cloth(1.0, 1.0, 3, 3, mass=0.01, structural=100.0)
    scene = Scene(sheet.state, sheet.mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["top_left"])
    film = simulate(scene, methods.rk4, dt=0.02, steps=400)
    assert not film.ok
    return film, sheet
