"""Rotating bodies: tops, a handle that flips, a physical pendulum."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import forces, rigid
from physjax.physics.rigid import inertia
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.show import solids
from physjax.study.energy.quantities import ANGULAR_MOMENTUM, ENERGY
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory
from physjax.vectors import multiply_quaternions, rotate_components, rotate_vector, rotate_vector_back

UP, BODY_AXIS = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@scene
def free_top(spin: float = 8.0, wobble: float = 1.5) -> Problem:
    """A disc thrown with a wobble, free of torque: its axis precesses about the angular momentum, and ω about its axis.

    In the world frame the axis precesses at |L|/I₁, in the body frame ω does at (I₃ - I₁)ω₃/I₁.
    """
    mass, velocity = 0.2, np.array([2.0, 3.0, 0.0])
    disc = inertia.cylinder(mass, radius=0.1, length=0.02)
    i1, _, i3 = np.asarray(disc.principal, float)
    momentum = np.array([i1 * wobble, 0.0, i3 * spin])
    size = np.linalg.norm(momentum)
    slip = (i3 - i1) * spin / i1
    thrown = Scene(rigid.bodies(disc, velocity=velocity, angular_velocity=(wobble, 0.0, spin)), disc)

    def exact(t):
        q = multiply_quaternions(
            _axis_quaternion(momentum / size, size / i1 * t), _axis_quaternion(BODY_AXIS, -slip * t)
        )
        path = np.multiply.outer(t, velocity)
        kept = (np.broadcast_to(a, path.shape) for a in (mass * velocity, momentum))
        return rigid.RigidBodies(path, np.stack(q, axis=-1), *kept)

    return Problem(
        thrown,
        duration=2 * np.pi / slip,
        looks=solids.cylinder(0.1, 0.02),
        exact=exact,
        conserved=(ENERGY, ANGULAR_MOMENTUM),
        truths=(
            Truth(
                "in the body frame ω precesses at (I₃ - I₁)ω₃/I₁ [relative]",
                lambda flight: _turn_rate(_body_angular_velocity(flight)[..., :2], flight.time) / slip,
                1.0,
                1e-8,
            ),
        ),
        frames=64,
    )


@scene
def heavy_top(spin: float = 90.0, tilt: float = 0.6, length: float = 0.05, g: float = 9.8) -> Problem:
    """Two tilted tops in steady precession about their tips, slow and fast: the two roots for one spin.

    Ω = [I₃ω₃ ± √(I₃²ω₃² - 4I₁mgl cosθ)]/(2I₁cosθ), I₁ about the tip; at exactly these rates there is no nutation.
    """
    mass = 0.2
    top = inertia.cylinder(mass, radius=0.06, length=0.02).about((0.0, 0.0, -length))
    i1, _, i3 = np.asarray(top.principal, float)
    square = (i3 * spin) ** 2 - 4 * i1 * mass * g * length * np.cos(tilt)
    if not square > 0:
        least = np.sqrt(4 * i1 * mass * g * length * np.cos(tilt)) / i3
        raise ValueError(
            f"heavy_top: got a spin of {spin:g} rad/s, too slow to hold the top up: expected more than {least:.3g} rad/s "
            "for this length and tilt."
        )
    root = np.sqrt(square)
    pace = (i3 * spin + np.array([-1.0, 1.0]) * root) / (2 * i1 * np.cos(tilt))
    own = spin - pace * np.cos(tilt)
    axis = np.array([np.sin(tilt), np.cos(tilt), 0.0])
    start = _tilt_quaternion(tilt)
    omega = np.outer(pace, UP) + np.outer(own, axis)
    place = length * axis + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.4]])
    tops = Scene(rigid.bodies(top, place, np.stack(start), angular_velocity=omega), top, (forces.Gravity(g),))

    def exact(t):
        round_about = _axis_quaternion(UP, np.multiply.outer(t, pace))
        q = multiply_quaternions(
            multiply_quaternions(round_about, start), _axis_quaternion(BODY_AXIS, np.multiply.outer(t, own))
        )
        arm = np.stack(rotate_components(round_about, list(length * axis)), axis=-1)
        momentum = mass * np.cross(np.outer(pace, UP), arm)
        first = np.outer(i3 * spin * np.ones(2), axis) + i1 * (omega - spin * axis)
        spins = np.stack(rotate_components(round_about, list(first.T)), axis=-1)
        return rigid.RigidBodies(arm + place - length * axis, np.stack(q, axis=-1), momentum, spins)

    return Problem(
        tops,
        duration=float(2 * np.pi / pace[0]),
        looks=solids.cylinder(0.06, 0.02),
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth(
                "precesses at Ω [relative]", lambda f: _turn_rate(_body_axis(f)[..., [2, 0]], f.time) / pace, 1.0, 1e-7
            ),
            Truth("keeps its tilt [1]", lambda flight: _body_axis(flight)[..., 1], np.cos(tilt), 1e-7),
        ),
        frames=256,
    )


@scene
def t_handle(spin: float = 6.0, nudge: float = 0.02) -> Problem:
    """A T-shaped handle spun about its axis of intermediate moment of inertia: it flips over and back for ever.

    Its angular velocity in the body frame has the period 4K(k)/√((I₃ - I₂)(L² - 2EI₁)/(I₁I₂I₃)), I₁ < I₂ < I₃ and k² =
    (I₂ - I₁)(2EI₃ - L²)/((I₃ - I₂)(L² - 2EI₁)), where L² > 2EI₂ (Landau and Lifshitz, Mechanics, section 37).
    """
    bar, grip = inertia.cylinder(0.15, 0.01, 0.2, axis=0), inertia.cylinder(0.1, 0.01, 0.1, axis=1)
    whole = inertia.composite([(bar, (0.0, 0.0, 0.0)), (grip, (0.0, -0.06, 0.0))])
    handle = whole.inertia
    shape = solids.cylinder(0.01, 0.2, axis=0).joined(solids.cylinder(0.01, 0.1, axis=1).at((0.0, -0.06, 0.0)))
    order = np.argsort(np.asarray(handle.principal))
    i1, i2, i3 = np.asarray(handle.principal, float)[order]
    omega = np.zeros(3)
    omega[order] = 0.0, spin, nudge
    twice, square = i2 * spin**2 + i3 * nudge**2, (i2 * spin) ** 2 + (i3 * nudge) ** 2
    above = (i3 - i2) * (square - twice * i1)
    k = np.sqrt((i2 - i1) * (twice * i3 - square) / above)
    period = 4 * complete_elliptic(k) / np.sqrt(above / (i1 * i2 * i3))
    spun = Scene(rigid.bodies(handle, angular_velocity=omega, frame="body"), handle)
    size = np.linalg.norm(np.asarray(spun.state.angular_momentum))
    return Problem(
        spun,
        duration=float(period),
        looks=shape.at(-whole.center),
        conserved=(ENERGY, ANGULAR_MOMENTUM),
        truths=(
            Truth(
                "has flipped after half a period, and back after a whole one [rad/s]",
                lambda flight: _body_angular_velocity(flight)[[32, 64]][:, order[1]],
                np.array([-spin, spin]),
                1e-6 * spin,
            ),
            Truth(
                "conserves |L| [relative]",
                lambda flight: np.linalg.norm(flight.state.angular_momentum, axis=-1) / size,
                1.0,
                1e-12,
            ),
        ),
        frames=64,
    )


@scene
def physical_pendulum(amplitude: float = 2.0, length: float = 0.6, g: float = 9.8) -> Problem:
    """A plank pivoted at one end, swinging far out: its period is 4K(sin θ₀/2)√(I/mgl), I about the pivot."""
    mass, arm = 1.5, 0.45 * length
    plank = inertia.box(mass, (0.08, length, 0.02)).about((0.0, arm, 0.0))
    swing = np.sqrt(float(plank.principal[2]) / (mass * g * arm))
    period = 4 * complete_elliptic(np.sin(amplitude / 2)) * swing
    place = arm * np.array([np.sin(amplitude), -np.cos(amplitude), 0.0])
    start = np.stack(_axis_quaternion((0.0, 0.0, 1.0), amplitude))
    return Problem(
        Scene(rigid.bodies(plank, place, start), plank, (forces.Gravity(g),)),
        duration=float(period),
        looks=solids.box((0.08, length, 0.02)),
        conserved=(ENERGY,),
        truths=(
            Truth(
                "is lowest after a quarter and after three quarters of the period [m]",
                lambda flight: flight.position[[16, 48], 0],
                0.0,
                1e-6 * arm,
            ),
            Truth("is back after a whole period [m]", lambda flight: flight.position[-1], place, 1e-6 * arm),
        ),
        frames=64,
    )


def complete_elliptic(k: float) -> float:
    """K(k) = ∫₀^(π/2) dφ/√(1 - k² sin² φ), by the arithmetic-geometric mean."""
    a, b = 1.0, np.sqrt(1 - k * k)
    for _ in range(8):  # the number of correct digits doubles each time
        a, b = (a + b) / 2, np.sqrt(a * b)
    return np.pi / (2 * a)


def _axis_quaternion(axis, angle):
    """The quaternion of a turn about a unit vector, in components."""
    half = np.asarray(angle) / 2
    return [np.cos(half), *(part * np.sin(half) for part in axis)]


def _tilt_quaternion(tilt: float) -> list:
    """The quaternion that brings the body's z axis from the world's to the tilt from up, towards x, in components."""
    return multiply_quaternions(_axis_quaternion((0.0, 0.0, 1.0), -tilt), _axis_quaternion((1.0, 0.0, 0.0), -np.pi / 2))


def _body_axis(flight: Trajectory) -> np.ndarray:
    """Direction of the body's z axis in the world frame, at every frame."""
    q = jnp.asarray(flight.state.orientation)
    return np.asarray(rotate_vector(q, jnp.broadcast_to(jnp.asarray(BODY_AXIS, q.dtype), (*q.shape[:-1], 3))))


def _body_angular_velocity(flight: Trajectory) -> np.ndarray:
    """The angular velocity in the body frame, at every frame [rad/s]."""
    states = jax.tree.map(jnp.asarray, flight.state)
    assert flight.scene is not None
    mass = flight.scene.mass
    omega = jax.vmap(lambda state: rigid.angular_velocity(state, mass))(states)
    return np.asarray(rotate_vector_back(states.orientation, omega))


def _turn_rate(plane: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Mean angular velocity of vectors in a plane [rad/s], frames along the first axis."""
    angle = np.unwrap(np.arctan2(plane[..., 1], plane[..., 0]), axis=0)
    return (angle[-1] - angle[0]) / time[-1]
