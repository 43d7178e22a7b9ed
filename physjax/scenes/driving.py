"""Cars on four springs, in metres: x forward, y up, z to their right."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, quantity
from physjax.physics import contacts, forces, rigid
from physjax.physics.rigid import inertia
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import to_world_frame_each
from physjax.scene import Scene
from physjax.scenes.registry import scene
from physjax.show import solids
from physjax.study.problem import Problem, Truth
from physjax.trajectory import Trajectory
from physjax.vectors import axis_vector, cross, dot, join_components, norm, scale, split_components, square_root, unit

BODY_SIZE = np.array([3.0, 1.0, 1.7])
BODY_PARTS = [
    # size and centre [m] of the boxes that the body is made of
    (np.array([3.0, 0.55, 1.7]), np.array([0.0, -0.225, 0.0])),
    (np.array([1.6, 0.45, 1.5]), np.array([0.0, 0.275, 0.0])),
]
WHEEL_MOUNTS = np.array([[x, -0.3, z] for x in (-1.3, 1.3) for z in (-0.7, 0.7)])
WHEEL_RADIUS = 0.35
AHEAD, UP = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
BRAKE_FADE_SPEED = 0.1
"""Speed below which brakes fade [m/s], so that their force has no jump where a car stands still."""
MIN_UP_COSINE = 0.2
"""Cosine of the tilt [1] below which a car has no wheel under it, and its springs do not act."""


class Suspension(rigid.Load):
    """Four damped springs with tyres on flat ground at y = 0: N = k s - c v_y >= 0 each, for a compression s [m].

    Until `brakes_at` the tyres together drive with the force `throttle`, then they `brake` against the motion; laterally
    each resists slip with `grip`. The horizontal force of a tyre is limited to μN.
    """

    stiffness: Numbers = quantity("stiffness k of each spring", "N/m", above=0)
    damping: Numbers = quantity("damping c of each spring", "kg/s", at_least=0)
    length: Numbers = quantity("unloaded length of a spring with its wheel", "m", above=0)
    throttle: Numbers = quantity("driving force", "N")
    brake: Numbers = quantity("braking force", "N", at_least=0)
    brakes_at: Numbers = quantity("time at which the brakes are applied", "s")
    grip: Numbers = quantity("lateral resistance of a tyre to slip", "kg/s", at_least=0)
    friction: Numbers = quantity("friction μ of the tyres", "1", at_least=0)

    def wrench(self, t: ArrayLike, bodies: rigid.RigidBodies, inertia: Inertia) -> rigid.Wrench:
        """The sum of the tyres' forces and torques, each at its point of contact."""
        turned = to_world_frame_each(bodies, np.concatenate([[AHEAD, UP], WHEEL_MOUNTS]))
        ahead, up = turned[0], turned[1]
        velocity, omega = scale(1 / inertia.mass, bodies.momentum), rigid.angular_velocity(bodies, inertia)

        def press(mount: Array) -> tuple[Array, Array]:
            reach = (bodies.position[..., 1] + mount[..., 1]) / jnp.maximum(up[..., 1], MIN_UP_COSINE)
            low = mount - scale(reach, up)
            pressed = jnp.where(up[..., 1] > MIN_UP_COSINE, jnp.maximum(self.length - reach, 0.0), 0.0)
            force = self._tyre_force(t, pressed, velocity + cross(omega, low), ahead)
            return force, cross(low, force)

        # the wheels along an axis in front: one evaluation for all
        force, torque = jax.vmap(press)(turned[2:])
        return rigid.Wrench(jnp.sum(force, axis=0), jnp.sum(torque, axis=0))

    def _tyre_force(self, t: ArrayLike, pressed: Array, speed: Array, ahead: Array) -> Array:
        """Normal and horizontal force of a tyre [N], for a compression [m] and a velocity of its contact point [m/s]."""
        push = jnp.where(pressed > 0, self.stiffness * pressed - self.damping * speed[..., 1], 0.0)
        push = jnp.maximum(push, 0.0)
        x, _, z = split_components(ahead)
        none = jnp.zeros_like(x)
        ahead = unit(join_components([x, none, z]))
        x, _, z = split_components(ahead)
        aside = join_components([-z, none, x])
        stops = -self.brake * jnp.tanh(dot(speed, ahead) / BRAKE_FADE_SPEED)
        drive = jnp.where(t < self.brakes_at, self.throttle, stops) / len(WHEEL_MOUNTS)
        pull = scale(drive, ahead) - scale(self.grip * dot(speed, aside), aside)
        size, most = norm(pull), self.friction * push
        pull = scale(jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0), pull)
        return pull + axis_vector(push, 1, pull)


class Kerb(contacts.Surface):
    """Flat ground at y = 0 and a step up at x = `at` to y = `height`, with a sharp edge."""

    at: Numbers = quantity("place of the face", "m")
    height: Numbers = quantity("height", "m", above=0)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes"]:
        """Distance to the nearest of ground, face, top and edge [m]."""
        _, kerb, height = self._measure_distances(position)
        return jnp.minimum(height, kerb)[..., 0]

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Away from the nearest of them."""
        (before, above), kerb, height = self._measure_distances(position)
        out, face = (before > 0) & (above > 0), before > above
        x = jnp.where(out, before, face.astype(before.dtype))
        y = jnp.where(out, above, 1 - face.astype(before.dtype))
        low = height <= kerb
        return unit(join_components([jnp.where(low, 0.0, -x), jnp.where(low, 1.0, y), jnp.zeros_like(x)]))

    def outline(self, t: float, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
        """Ground, face and top from side to side of the box: they stay sharp, whatever grid the box is drawn with."""
        at, height = float(self.at), float(self.height)
        line = np.array([[low[0], height * (at <= low[0])], [high[0], height * (at < high[0])]])
        if low[0] < at < high[0]:
            line = np.array([line[0], [at, 0.0], [at, height], line[1]])
        near, far = (np.column_stack([line, np.full(len(line), side)]) for side in (low[2], high[2]))
        return list(np.stack([near[:-1], near[1:], far[1:], far[:-1]], axis=1))

    def _measure_distances(self, position: Array) -> tuple[tuple[Array, Array], Array, Array]:
        """In front of the face and above the top; to the kerb; above the ground [m], each with an axis of length 1."""
        x, height, _ = split_components(jnp.asarray(position))
        before, above = self.at - x, height - self.height
        edge = square_root(before * before + above * above)
        kerb = jnp.where((before > 0) & (above > 0), edge, jnp.maximum(before, above))
        return (before, above), kerb, height


@scene
def car(speed: float = 5.0, friction: float = 0.9, g: float = 9.8) -> Problem:
    """Cars on springs: one stands, one drives and brakes, one rebounds from a kerb, one slides into it and flips.

    Wheels turn freely, so a kerb has no friction: v' = v (1 - (1 + K_r)/(1 + m h²/I)), with h from the hubs to the centre
    of mass and I about the pitch axis. The moments of inertia are those of the box around the body.
    """
    mass, stiffness, length, restitution = 1200.0, 6e4, 0.55, 0.4
    body = inertia.box(mass, BODY_SIZE)
    sag = mass * g / (4 * stiffness)
    height = length - sag - WHEEL_MOUNTS[0, 1]
    low = height - WHEEL_RADIUS
    start = rigid.bodies(
        body,
        [[0.0, height + 0.1, -7.0], [0.0, height, -3.5], [6.0, height, 0.5], [8.0, height, 5.0]],
        [[1.0, 0.0, 0.0, 0.0]] * 3 + [[1.0, 0.0, 1.0, 0.0]],
        velocity=np.outer([0.0, 0.0, speed, 2 * speed], AHEAD),
    )
    drives, throttle, brakes_at = np.array([0.0, 1.0, 0.0, 0.0]), 3600.0, 2.0
    springs = Suspension(
        stiffness=stiffness,
        damping=5e3,
        length=length,
        throttle=throttle * drives,
        brake=2 * friction * mass * g * drives,
        brakes_at=brakes_at,
        grip=1e4,
        friction=friction,
    )
    hubs = WHEEL_MOUNTS * [1.0, 0.0, 1.0] - low * np.array(UP)
    corners = np.concatenate([_corners(size) + place for size, place in BODY_PARTS])
    outer = np.isclose(np.abs(corners[:, 1]), BODY_SIZE[1] / 2)
    step, rough = (13.0, 0.4), contacts.Coulomb(0.5, 0.5)
    kerbs = (
        rigid.SurfaceContact(rigid.ContactPoints(corners[outer]), Kerb(*step, restitution=0.2, coulomb=rough)),
        rigid.SurfaceContact(rigid.ContactPoints(hubs, 0.3), Kerb(*step, restitution=restitution)),
    )
    parts = [solids.box(size).at(place) for size, place in BODY_PARTS]
    parts += [solids.cylinder(WHEEL_RADIUS, 0.25).at(hub) for hub in hubs]
    duration, frames = 5.0, 100
    brakes = round(frames * brakes_at / duration)
    gained = throttle / mass * duration / frames * (brakes - 1)
    lever = mass * low**2 / float(body.principal[2])

    def pace(flight, frame, lane):
        return flight.state.momentum[frame, lane, 0] / mass

    def way(flight):
        ends = flight.position[[brakes, -1], 1, 0]
        return np.diff(ends)[0] * 2 * friction * g / pace(flight, brakes, 1) ** 2

    return Problem(
        Scene(start, body, (forces.Gravity(g), springs), kerbs),
        duration,
        truths=(
            Truth(
                "the first rests at the sag mg/(4k) [m]",
                lambda f: length - WHEEL_MOUNTS[0, 1] - f.position[-1, 0, 1],
                sag,
                1e-9,
            ),
            Truth("the second drives at Ft/m [relative]", lambda f: pace(f, brakes - 1, 1) / gained, 1.0, 1e-6),
            Truth("and brakes within v²/(2μg) [relative]", way, 1.0, 0.02),
            Truth(
                "the third rebounds from the kerb at v' [relative]",
                lambda f: pace(f, -1, 2) / speed,
                1 - (1 + restitution) / (1 + lever),
                1e-6,
            ),
            Truth(
                "the fourth flips: its own up points down at the end [1]", lambda f: _up_component(f)[-1, 3], -1.0, 0.01
            ),
            Truth("the others never tilt far [1]", lambda f: _up_component(f)[:, :3], 1.0, 0.05),
        ),
        looks=parts[0].joined(*parts[1:]),
        frames=frames,
    )


def _corners(size: np.ndarray) -> np.ndarray:
    """Corners of a box around the origin, `(8, 3)` [m]."""
    return np.array(list(product((-0.5, 0.5), repeat=3))) * size


def _up_component(flight: Trajectory) -> np.ndarray:
    """Cosine of each car's tilt, at every frame: 1 - 2(x² + z²) of its quaternion."""
    _, x, _, z = np.moveaxis(flight.state.orientation, -1, 0)
    return 1 - 2 * (x * x + z * z)
