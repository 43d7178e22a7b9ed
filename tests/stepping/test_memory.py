"""What a process keeps of the scenes that pass through it."""

import gc

import jax
import jax.numpy as jnp

from physjax import Particles, Scene, forces, lattices, methods, simulate


def kept():
    """How many compiled programs are alive."""
    gc.collect()
    return len(jax.local_devices()[0].client.live_executables())


def net(stiffness, width):
    rope = lattices.rope((0.0, 0.0), (width, 0.0), 5, mass=1.0, stiffness=stiffness)
    return Scene(rope.state, rope.mass, (forces.Gravity(), rope.springs), pinned=rope.nodes["ends"])


def dragged(coefficient):
    drag = forces.independent(lambda t, state, mass: -coefficient * state.velocity)
    return Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(forces.Gravity(), drag))


def test_a_scene_of_other_numbers_is_no_other_program_and_all_programs_can_be_freed():
    jax.clear_caches()
    empty = kept()
    simulate(net(10.0, 1.0), methods.euler, dt=0.01, steps=4)
    before = kept()
    for i in range(1, 4):  # springs, masks and ropes made anew, which must be equal to those before
        simulate(net(10.0 + i, 1.0 + i), methods.euler, dt=0.01 * i, steps=4)
    assert kept() == before
    simulate(dragged(0.0), methods.euler, dt=0.01, steps=4)
    before = kept()
    for i in range(1, 4):
        simulate(dragged(float(i)), methods.euler, dt=0.01, steps=4)
    assert kept() == before + 3  # a function that closes over a number is another one
    jax.clear_caches()
    assert kept() <= empty
