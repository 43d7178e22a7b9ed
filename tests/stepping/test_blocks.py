"""Many lanes in blocks: the same numbers as uncut, whatever is per lane, and nothing cut that must stay whole."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.backend import MIN_LANES_TO_CUT, MIN_STEPS_PER_FRAME
from physjax.checks import quantity
from physjax.physics.forces import independent
from physjax.stepping.blocks import Blocks
from physjax.vectors import dot

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="lanes are cut for a CPU's cache only")


def crowd(lanes, parts=None, dtype=float, **numbers):
    """Balls thrown in all directions, no two alike."""
    rng = np.random.default_rng(2)
    x, v = rng.normal(size=(2, *lanes, 2))
    parts = (forces.Gravity(), forces.QuadraticDrag(area=0.05, coefficient=0.4)) if parts is None else parts
    return Scene(Particles(jnp.asarray(x, dtype), jnp.asarray(v, dtype)), forces=parts, **numbers)


def per_lane(lanes, low, high):
    return np.random.default_rng(3).uniform(low, high, size=lanes)


def runs(scene, dt=0.01, method=methods.semi_implicit_euler):
    """The same run in blocks and uncut: too few steps between frames are not worth a cut, so both can be asked for."""
    few = MIN_STEPS_PER_FRAME // 2
    blocked = simulate(scene, method, dt=dt, steps=2 * MIN_STEPS_PER_FRAME, save_every=MIN_STEPS_PER_FRAME)
    uncut = simulate(scene, method, dt=dt, steps=2 * MIN_STEPS_PER_FRAME, save_every=few)
    return blocked, uncut


class Stretchy(eqx.Module):
    """A spring to the origin that is stiffer in some directions, with a matrix of its own for each lane."""

    couples: ClassVar[bool] = False
    stiffness: jax.Array = quantity("stiffness", "N/m", kind="tensor")

    def __call__(self, t, state, mass):
        rows = jnp.moveaxis(self.stiffness, -2, 0)
        return -jnp.stack([dot(row, state.position) for row in rows], axis=-1)


ODD = (MIN_LANES_TO_CUT + 5,)
PLANE = (401, 333)
CASES = {
    "a lane count that does not divide": lambda: (crowd(ODD), 0.01),
    "two axes of lanes": lambda: (crowd(PLANE, mass=per_lane(PLANE, 0.5, 2.0)), per_lane(PLANE, 0.005, 0.02)),
    "float32": lambda: (crowd(ODD, dtype=np.float32), 0.01),
    "a matrix per lane": lambda: (crowd(ODD, (Stretchy(jnp.asarray(per_lane((*ODD, 2, 2), 0.0, 9.0))),)), 0.01),
    "everything per lane": lambda: (
        crowd(
            ODD,
            (
                forces.Gravity(per_lane(ODD, 1.0, 20.0)),
                forces.StokesDrag(per_lane(ODD, 0.0, 1.0), wind=per_lane((*ODD, 2), -3.0, 3.0)),
                forces.Kick(impulse=per_lane((*ODD, 2), -1, 1), at=per_lane(ODD, 0.0, 0.1), duration=0.05),
            ),
            mass=per_lane(ODD, 0.5, 2.0),
            pinned=per_lane(ODD, 0.0, 1.0) < 0.3,
        ),
        per_lane(ODD, 0.005, 0.02),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_blocks_give_the_numbers_of_the_uncut_run(case):
    scene, dt = CASES[case]()
    assert Blocks.of(scene, scene.state, MIN_STEPS_PER_FRAME) is not None
    assert Blocks.of(scene, scene.state, MIN_STEPS_PER_FRAME // 2) is None
    blocked, uncut = runs(scene, dt)
    eps = float(jnp.finfo(scene.state.dtype).eps)
    for mine, theirs in zip(blocked.state, uncut.state, strict=True):
        assert mine.shape == (3, *scene.state.velocity.shape)
        np.testing.assert_allclose(mine, theirs[::2], rtol=32 * eps, atol=32 * eps)
    for mine, theirs in zip(blocked.final_scene.state, uncut.final_scene.state, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=32 * eps, atol=32 * eps)
    assert blocked.ok.shape == scene.state.lanes
    assert blocked.ok.all()


def test_one_bad_lane_is_found_in_its_place_and_harms_no_other():
    bad = MIN_LANES_TO_CUT // 2 + 17
    stiffness = np.ones(ODD)
    calm = crowd(ODD, (forces.Anchor(point=jnp.zeros(2), stiffness=stiffness),))
    stiffness[bad] = 1e60
    wild = crowd(ODD, (forces.Anchor(point=jnp.zeros(2), stiffness=stiffness),))
    calm, wild = (simulate(s, methods.euler, dt=0.01, steps=16, save_every=8) for s in (calm, wild))
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(wild.ok)), [bad])
    others = np.arange(ODD[0]) != bad
    np.testing.assert_array_equal(wild.position[:, others], calm.position[:, others])


def test_coupled_lanes_and_bare_functions_are_never_cut():
    def bare(t, state, mass):
        return -state.position

    for parts in (bare,), (independent(bare),), (forces.Gravitation(),), (forces.Gravity(), bare):
        scene = crowd((MIN_LANES_TO_CUT,), parts)
        assert Blocks.of(scene, scene.state, MIN_STEPS_PER_FRAME) is None
    few = crowd((MIN_LANES_TO_CUT - 1,))
    assert Blocks.of(few, few.state, MIN_STEPS_PER_FRAME) is None


class Fuse(eqx.Module):
    """A push that ends when the fuse has burnt down; each lane has a fuse of its own, or all share one."""

    couples: ClassVar[bool] = False
    left: jax.Array

    def __call__(self, t, state, mass):
        lit = jnp.reshape(self.left > 0, self.left.shape + (1,) * (state.velocity.ndim - self.left.ndim))
        return jnp.where(lit, 2.0, 0.0) * jnp.ones_like(state.velocity)

    def advance(self, t, dt, state):
        return Fuse(self.left - dt), state


@pytest.mark.parametrize("own", [True, False], ids=["each its own", "one for all"])
def test_what_remembers_is_cut_by_lanes_or_keeps_the_scene_whole(own):
    left = per_lane(ODD, 0.0, 0.2) if own else np.asarray(0.095)
    scene = crowd(ODD, (Fuse(jnp.asarray(left)),))
    blocked, uncut = runs(scene)
    np.testing.assert_allclose(blocked.velocity, uncut.velocity[::2], rtol=1e-13, atol=1e-13)
    assert blocked.parts[0].left.shape == (3, *left.shape)
    np.testing.assert_allclose(blocked.parts[0].left, uncut.parts[0].left[::2], rtol=1e-13, atol=1e-13)


def test_derivatives_go_through_blocks():
    start = crowd(ODD)

    def height(numbers):
        g, drag = numbers
        scene = Scene(start.state, forces=(forces.Gravity(g), forces.StokesDrag(drag)))
        film = simulate(
            scene, methods.semi_implicit_euler, dt=0.01, steps=MIN_STEPS_PER_FRAME, save_every=MIN_STEPS_PER_FRAME
        )
        return jnp.mean(film.position[-1, :, 1])

    numbers, h = jnp.asarray([9.8, 5.0]), 1e-4
    central = [(height(numbers + h * e) - height(numbers - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.grad(height)(numbers), central, rtol=1e-7)
    assert (np.abs(central) > 1e-5).all()
