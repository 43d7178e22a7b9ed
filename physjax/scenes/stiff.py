"""Stiff things that move slowly: a flag and a block that swing, whose springs vibrate thousands of times as fast.

Explicit methods must follow every vibration. Implicit ones take steps a hundred times as long; their truths say what
becomes of the swing.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import forces
from physjax.physics.springs import Springs, lattices
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.stepping import methods
from physjax.stepping.simulate import simulate
from physjax.study.energy.quantities import total
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory

CHAIN_MODE = 2.404825557695773 / 2
"""ω√(L/g) of the slowest swing of a hanging chain or sheet, half of the first zero of the Bessel function J₀."""


@scene
def stiff_flag(
    rows: int = 6, columns: int = 9, angle: float = 0.3, stiffness: float = 5e3, mass: float = 0.06, g: float = 9.8
) -> Problem:
    """A flag of stiff cloth, hung by its upper edge and let go at 0.3 rad: it swings, and its threads hardly stretch."""
    height = 0.6
    sheet = lattices.cloth(
        0.9, height, rows, columns, mass=mass, structural=stiffness, shear=0.3 * stiffness,
        down=(0.0, -np.cos(angle), np.sin(angle)),
    )  # fmt: skip
    swinging = Scene(sheet.state, mass=sheet.mass, forces=(forces.Gravity(g), sheet.springs), pinned=sheet.nodes["top"])
    half_period = float(np.pi / (CHAIN_MODE * np.sqrt(g / height)))
    step = 100 * _find_longest_explicit_step(sheet, sheet.nodes["top"])
    hanging = np.asarray(sheet.state.position) @ np.diag([1.0, 1 / np.cos(angle), 0.0])
    lost = lambda method: lambda f: 1 - _measure_kept_share(swinging, method, step, half_period, hanging)  # noqa: E731
    return Problem(
        swinging,
        duration=half_period,
        looks=sheet,
        truths=(
            Truth("keeps its energy [J]", _energy_change, 0.0, 1e-9),
            Truth("no thread is stretched by more than a thousandth [1]", _measure_strain(sheet.springs), 0.0, 1e-3),
            Truth(
                "it is on the other side after half the period of a hanging chain [of where it was]",
                lambda f: f.position[-1, :, 2].mean() / f.position[0, :, 2].mean(),
                -1.0,
                0.1,
            ),
            Truth(
                "TR-BDF2 in steps 100 times the stable ones loses at most a hundredth of the swing [share]",
                lost(methods.TrBdf2(newton=20)),
                0.0,
                0.01,
            ),
            Truth(
                "implicit Euler loses a third of it there [share]", lost(methods.ImplicitEuler(newton=20)), 0.35, 0.15
            ),
        ),
    )


@scene
def stiff_jelly(
    nodes: int = 3, side: float = 0.2, angle: float = 0.3, stiffness: float = 1e5, mass: float = 1.0, g: float = 9.8
) -> Problem:
    """A block of stiff jelly that hangs by one edge and swings, as near to a rigid pendulum as its springs are stiff."""
    block = lattices.jelly(
        (side,) * 3, (nodes,) * 3, mass=mass, structural=stiffness, shear=0.5 * stiffness, corner=(0.0, -side, 0.0)
    )
    edge = block.nodes["left"] & block.nodes["top"]
    turn = angle - np.pi / 4  # the diagonal of the block hangs at -45°
    (c, s), x = (np.cos(turn), np.sin(turn)), np.asarray(block.state.position)
    start = jnp.asarray(x @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    swinging = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=block.mass,
        forces=(forces.Gravity(g), block.springs),
        pinned=edge,
    )
    share = np.asarray(block.mass) / mass
    inertia = share @ (x[:, 0] ** 2 + x[:, 1] ** 2)
    rate = np.sqrt(g * np.hypot(share @ x[:, 0], share @ x[:, 1]) / inertia)
    duration = float(np.pi / rate)
    step = _find_longest_explicit_step(block._replace(state=swinging.state), edge)
    tilt = lambda f: np.arctan2(f.position[..., 0] @ share, -(f.position[..., 1] @ share))  # noqa: E731
    swing = _swing_pendulum(angle, float(rate), np.linspace(0.0, duration, 33))

    def tilt_by(method, times):
        return lambda f: tilt(_simulate_end(swinging, method, times * step, duration))

    return Problem(
        swinging,
        duration=duration,
        looks=block,
        truths=(
            Truth("swings as the rigid pendulum of its points [rad]", tilt, swing, 2e-3),
            Truth("keeps its energy [J]", _energy_change, 0.0, 1e-9),
            Truth("no spring is strained by more than a thousandth [1]", _measure_strain(block.springs), 0.0, 1e-3),
            Truth(
                "TR-BDF2 in steps 100 times the stable ones is where the pendulum is [rad]",
                tilt_by(methods.tr_bdf2, 100),
                swing[-1],
                0.03,
            ),
            Truth(
                "the implicit midpoint rule in steps 20 times the stable ones is, too [rad]",
                tilt_by(methods.implicit_midpoint, 20),
                swing[-1],
                0.01,
            ),
        ),
    )


def _swing_pendulum(angle: float, rate: float, times: np.ndarray) -> np.ndarray:
    """The angle of a pendulum let go at an angle [rad], θ'' = -rate² sin θ, at equally spaced times, by fine steps of rk4."""
    y, angles, fine = np.array([angle, 0.0]), [angle], 200
    h = (times[1] - times[0]) / fine
    slope = lambda y: np.array([y[1], -(rate**2) * np.sin(y[0])])  # noqa: E731
    for _ in times[1:]:
        for _ in range(fine):
            k = slope(y)
            l = slope(y + h / 2 * k)  # noqa: E741
            m = slope(y + h / 2 * l)
            y = y + h / 6 * (k + 2 * l + 2 * m + slope(y + h * m))
        angles.append(y[0])
    return np.array(angles)


def _find_longest_explicit_step(lattice: lattices.Lattice, pinned: np.ndarray) -> float:
    """The longest stable step of verlet [s], 2/ω of the fastest vibration about the start, where no spring is strained."""
    x, mass = np.asarray(lattice.state.position), np.asarray(lattice.mass)
    a, b = np.asarray(lattice.springs.pairs).T
    way = (x[b] - x[a]) / np.linalg.norm(x[b] - x[a], axis=1, keepdims=True)
    rows = np.zeros((len(a), *x.shape))  # how each spring is stretched by each node
    spring = np.arange(len(a))
    rows[spring, a], rows[spring, b] = -way, way
    rows = (rows * np.where(pinned, 0.0, 1 / np.sqrt(mass))[:, None]).reshape(len(a), -1)
    stiffness = np.broadcast_to(np.asarray(lattice.springs.stiffness), len(a))
    return float(2 / np.sqrt(np.linalg.eigvalsh(rows.T * stiffness @ rows)[-1]))


def _simulate_end(swinging: Scene, method: Callable, step: float, duration: float) -> Particles:
    """The state of a scene after a time [s], by a method in steps of about this length [s]."""
    steps = int(np.ceil(duration / step))
    flight = simulate(swinging, method, dt=duration / steps, steps=steps, save_every=steps)
    return Particles(flight.position[-1], flight.velocity[-1])


def _measure_kept_share(swinging: Scene, method: Callable, step: float, duration: float, hanging: np.ndarray) -> float:
    """The share of the energy above that at rest which is left after a run by a method."""
    energy = lambda state: float(np.sum(_energy(swinging, state)))  # noqa: E731
    rest = energy(Particles(jnp.asarray(hanging), jnp.zeros_like(swinging.state.velocity)))
    end = _simulate_end(swinging, method, step, duration)
    return (energy(end) - rest) / (energy(swinging.state) - rest)


_energy = jax.jit(lambda scene, state: total(scene, 0.0, state))
_strain = jax.jit(lambda springs, states: springs.strain(states))


def _energy_change(flight: Trajectory) -> np.ndarray:
    """The energy at each frame less that at the start [J]."""
    states = Particles(flight.position, flight.velocity)
    energy = np.asarray(jax.vmap(_energy, (None, 0))(flight.scene, states))
    return energy - energy[0]


def _measure_strain(springs: Springs) -> Callable[[Trajectory], float]:
    """What measures the largest strain of a spring, stretched or compressed [1]."""
    return lambda flight: float(np.abs(_strain(springs, Particles(flight.position, flight.velocity))).max())
