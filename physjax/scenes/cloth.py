"""Ropes and cloth that hang, fly in the wind, and drape over a ball."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import contacts, forces
from physjax.physics.springs import lattices
from physjax.scene import Scene, loads
from physjax.scenes.registry import scene
from physjax.study.energy.quantities import total
from physjax.study.problem import Problem, Truth


@scene
def hanging_rope(
    nodes: int = 25, span: float = 1.0, length: float = 1.3, stiffness: float = 1e4, mass: float = 1.0, g: float = 9.8
) -> Problem:
    """A rope between two nails, released with a corner in it, that comes to rest as an elastic catenary.

    Drag of the air brings it to rest; the rope itself is undamped.
    """
    rope = lattices.rope((-span / 2, 0.0), (span / 2, 0.0), nodes, mass=mass, stiffness=stiffness, length=length)
    along = np.linspace(0.0, length, nodes)
    start = jnp.asarray(_pull_into_corner(along, span))
    hanging = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=rope.mass,
        forces=(forces.Gravity(g), rope.springs, forces.StokesDrag(10.0 * rope.mass)),
        pinned=rope.nodes["ends"],
    )
    curve = elastic_catenary(along, span, mass * g, stiffness * length / (nodes - 1))
    carried = mass * g * (nodes - 2) / (nodes - 1)
    return Problem(
        hanging,
        duration=4.0,
        truths=(
            Truth("comes to rest in a catenary [rope lengths]", lambda f: (f.position[-1] - curve) / length, 0.0, 1e-3),
            Truth("is at rest at the end [m/s]", lambda f: f.velocity[-1], 0.0, 1e-6),
            Truth("the nails carry its weight without its pinned nodes [N]", _measure_pinned_load, carried, 1e-6),
        ),
    )


def _pull_into_corner(along: np.ndarray, span: float) -> np.ndarray:
    """Points of a rope that is pulled taut into a corner off the middle, at the distances `along` it, `(points, 2)` [m]."""
    length = along[-1]
    if not span < length:
        raise ValueError(
            f"hanging_rope: got a length of {length:g} m and a span of {span:g} m, expected a rope longer than its span."
        )
    left, right = 0.65 * length, 0.35 * length
    corner = (left**2 - right**2) / (2 * span)
    depth = -np.sqrt(left**2 - (corner + span / 2) ** 2)
    x = np.interp(along, (0, left, length), (-span / 2, corner, span / 2))
    return np.stack([x, np.interp(along, (0, left, length), (0, depth, 0))], axis=-1)


def elastic_catenary(along: np.ndarray, span: float, weight: float, stiffness: float) -> np.ndarray:
    """Points of a rope that hangs between (±span/2, 0) [m], at the unstretched distances `along` it [m], `(points, 2)`.

    `weight` W [N], `stiffness` EA [N]: force per strain. H. M. Irvine, Cable Structures, 1981, section 2.3:
    with s from one end, H the horizontal pull and V = W/2,
    x = Hs/EA + (HL/W)(asinh(V/H) - asinh((V - Ws/L)/H)), y = -(Ws/EA)(V/W - s/2L) - (HL/W)(√(1 + V²/H²) - √(1 + (V - Ws/L)²/H²)).
    """
    length, rise = along[-1], weight / 2 - weight * along / along[-1]

    def points(pull):
        x = pull * along / stiffness + pull * length / weight * (np.arcsinh(rise[0] / pull) - np.arcsinh(rise / pull))
        sag = weight * along / stiffness * (0.5 - along / (2 * length))
        sag = sag + pull * length / weight * (np.hypot(1, rise[0] / pull) - np.hypot(1, rise / pull))
        return np.stack([x - span / 2, -sag], axis=-1)

    def reach(pull):
        return pull * length / stiffness + 2 * pull * length / weight * math.asinh(weight / 2 / pull)

    low, high = 1e-6 * weight, 1e6 * weight
    for _ in range(200):  # bisection of log H: the span grows with the pull
        pull = math.sqrt(low * high)
        low, high = (pull, high) if reach(pull) < span else (low, pull)
    return points(pull)


@scene
def hanging_cloth(nodes: int = 7, side: float = 0.5, mass: float = 0.1, g: float = 9.8) -> Problem:
    """A cloth on two nails, released from the horizontal: it swings down, folds and comes to rest."""
    sheet = lattices.cloth(
        side, side, nodes, nodes, mass=mass, structural=50.0, shear=20.0, bend=5.0, damping=0.05,
        corner=(-side / 2, 0.0, 0.0), down=(0.0, 0.0, 1.0),
    )  # fmt: skip
    nails = sheet.nodes["top"] & sheet.nodes["corners"]
    hanging = Scene(
        sheet.state,
        mass=sheet.mass,
        forces=(forces.Gravity(g), sheet.springs, forces.StokesDrag(8.0 * sheet.mass)),
        pinned=nails,
    )
    weight = g * float(np.sum(sheet.mass[~nails]))
    mirrored = np.arange(nodes**2).reshape(nodes, nodes)[:, ::-1].ravel()
    return Problem(
        hanging,
        duration=5.0,
        looks=sheet,
        truths=(
            Truth("is at rest at the end [m/s]", lambda f: f.velocity[-1], 0.0, 2e-6),
            Truth("the nails carry the weight of the other nodes [N]", _measure_pinned_load, weight, 1e-6),
            Truth(
                "left and right mirror each other [m]",
                lambda f: f.position - f.position[:, mirrored] * np.array([-1.0, 1.0, 1.0]),
                0.0,
                1e-9,
            ),
        ),
    )


@scene
def flag(rows: int = 6, columns: int = 9, speed: float = 6.0, g: float = 9.8) -> Problem:
    """A flag of 0.9 by 0.6 m on a pole, flapping in a wind of 6 m/s.

    The force of the air, |u·n| (u·n), is not smooth where a face turns its other side to the wind.
    """
    sheet = lattices.cloth(
        0.9, 0.6, rows, columns, mass=0.06, structural=100.0, shear=30.0, damping=0.02, corner=(0.0, 0.6, 0.0)
    )
    flying = Scene(
        sheet.state,
        mass=sheet.mass,
        forces=(forces.Gravity(g), sheet.springs, sheet.wind((speed, 0.0, 0.1 * speed))),
        pinned=sheet.nodes["left"],
    )
    pole = sheet.nodes["left"]
    return Problem(
        flying,
        duration=1.0,
        looks=sheet,
        truths=(
            Truth("stays on its pole [m]", lambda f: f.position[:, pole] - f.position[0, pole], 0.0, 0.0),
            Truth(
                "no spring is stretched by more than a tenth [1]",
                lambda f: np.maximum(_strain(f.scene.forces[1], _stack_states(f)), 0.0),
                0.0,
                0.1,
            ),
            Truth(
                "the change of momentum is the impulse of air, weight and pole [kg m/s]", _momentum_residual, 0.0, 2e-3
            ),
            Truth("the change of energy is the work of air and damping [J]", _energy_residual, 0.0, 1e-3),
            Truth(
                "flies downwind: the free edge is far from the pole [m]",
                lambda f: f.position[-1, sheet.nodes["right"], 0].mean(),
                0.9,
                0.2,
            ),
        ),
        frames=128,
    )


@scene
def cloth_over_sphere(nodes: int = 13, side: float = 0.7, radius: float = 0.25, g: float = 9.8) -> Problem:
    """A cloth that falls on a ball on the floor, slips a little, and comes to rest over it, with two folds.

    Nodes are in contact, not the faces between them: the ball and the floor are drawn a centimetre smaller and deeper.
    Contacts are resolved at the end of a step, where friction removes the velocity but not the displacement ½a dt² within
    the step: nodes on a slope creep at up to g dt.
    """
    sheet = lattices.cloth(
        side, side, nodes, nodes, mass=0.15, structural=50.0, shear=20.0, bend=10.0, damping=0.1,
        corner=(0.05 - side / 2, 2 * radius + 0.05, 0.03 - side / 2), down=(0.0, 0.0, 1.0),
    )  # fmt: skip
    grip = contacts.Coulomb(0.5, 0.4)
    ball = contacts.Sphere((0.0, radius, 0.0), radius, restitution=0.0, coulomb=grip)
    floor = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0, coulomb=grip)
    falling = Scene(
        sheet.state,
        mass=sheet.mass,
        forces=(forces.Gravity(g), sheet.springs, forces.StokesDrag(6.0 * sheet.mass)),
        contacts=(ball, floor),
    )
    into = lambda which: lambda f: np.minimum(_signed_distance(f.scene.contacts[which], f.position), 0.0)  # noqa: E731
    return Problem(
        falling,
        duration=3.0,
        looks=sheet,
        truths=(
            Truth("no node is in the ball [m]", into(0), 0.0, 1e-12),
            Truth("no node is under the floor [m]", into(1), 0.0, 1e-12),
            Truth(
                "creeps at the end by at most g dt [g dt]",
                lambda f: np.abs(f.velocity[-1]) / (g * f.dt),
                0.0,
                1.0,
            ),
            Truth(
                "lies on the ball: its highest node is on top [m]",
                lambda f: f.position[-1, :, 1].max(),
                2 * radius,
                0.01,
            ),
        ),
        frames=32,
    )


def _measure_pinned_load(flight):
    """Vertical force of the springs on the pinned nodes at the end [N], downwards positive."""
    pull = _evaluate_terms(flight)[1][-1]
    return -np.sum(pull[np.asarray(flight.scene.pinned), 1])


def _stack_states(flight):
    """All frames of a flight as one state."""
    return Particles(flight.position, flight.velocity)


# compiled once, instead of operation by operation
_strain = jax.jit(lambda springs, states: springs.strain(states))
_signed_distance = jax.jit(lambda contact, position: contact.signed_distance(0.0, position))
_loads = jax.jit(jax.vmap(lambda scene, state: loads(scene, 0.0, state, per_term=True), (None, 0)))
_energies = jax.jit(jax.vmap(lambda scene, state: total(scene, 0.0, state), (None, 0)))


def _evaluate_terms(flight, still=False):
    """The force of each term of the scene on each node at every frame [N]; with `still`, as if all nodes were at rest."""
    states = _stack_states(flight)
    states = states._replace(velocity=0.0 * states.velocity) if still else states
    return [np.asarray(term) for term in _loads(flight.scene, states)]


def _momentum_residual(flight):
    """Change of momentum from start to end, less the impulse of all forces on the free nodes [kg m/s]."""
    mass, free = np.asarray(flight.scene.mass)[:, None], ~np.asarray(flight.scene.pinned)
    change = np.sum(mass * (flight.velocity[-1] - flight.velocity[0]), axis=0)
    total = np.asarray(sum(_evaluate_terms(flight)))
    return change - _integrate(flight.time, total[:, free].sum(axis=1))


def _energy_residual(flight):
    """Change of energy from start to end, less the work of the air and of the springs' damping [J]."""
    energy = np.asarray(_energies(flight.scene, _stack_states(flight)))
    (_, pull, push), (_, elastic, _) = _evaluate_terms(flight), _evaluate_terms(flight, still=True)
    power = np.sum((push + pull - elastic) * flight.velocity, axis=(1, 2))
    return energy[-1] - energy[0] - _integrate(flight.time, power)


def _integrate(time, rate):
    """The integral over the whole time, by Simpson's rule."""
    return (time[1] - time[0]) / 3 * (rate[:-2:2] + 4 * rate[1:-1:2] + rate[2::2]).sum(axis=0)
