"""Rigid bodies as joints read and move them: in the plane by x, y and an angle, in space by a place and a quaternion."""

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from physjax.constraints.coordinates import Moves, Places, put_worlds_first, put_worlds_last
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.mobility import Mobility
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar_inertia import PlanarInertia
from physjax.physics.rigid.spatial import RigidBodies, angular_velocity
from physjax.vectors import conjugate_quaternion, multiply_quaternions, rotate_components, scale

OPPOSITE_COSINE = -1 + 1e-6
"""The cosine of the angle [1] from which on two vectors count as opposite."""


class PlanarCoordinates:
    """Bodies in the plane: x, y [m] and the angle [rad]."""

    dim = 2
    freedoms = 3

    def read_places(self, state: PlanarBodies) -> Places:
        """Positions and angles."""
        return _join(put_worlds_last(state.position, state.lanes), put_worlds_last(state.angle, state.lanes)[None])

    def read_rates(self, state: PlanarBodies, mass: PlanarInertia) -> Moves:
        """Velocities [m/s] and angular velocities [rad/s]."""
        velocity = put_worlds_last(scale(1 / mass.mass, state.momentum), state.lanes)
        return _join(velocity, put_worlds_last(state.angular_momentum / mass.moment, state.lanes)[None])

    def displace(self, places: Places, moves: Moves) -> Places:
        """The sum."""
        return places + moves

    def carry_on(self, places: Places, before: Places, after: Places) -> Places:
        """The difference added."""
        return places + (after - before)

    def read_mobility(self, state: PlanarBodies, mass: PlanarInertia) -> Array:
        """1/m, twice, and 1/I."""
        straight, turning = (put_worlds_last(1 / number, state.lanes)[None] for number in (mass.mass, mass.moment))
        return jnp.concatenate([straight, straight, turning])

    def measure_bodies(self, mobility: Array) -> Array:
        """The radius of gyration √(I/m) [m]."""
        return jnp.sqrt(mobility[0] / mobility[2])

    def apply_mobility(self, mobility: Array, impulses: Moves) -> Moves:
        """Δv = P/m and Δω = ΔL/I."""
        return mobility * impulses

    def put_places(self, state: PlanarBodies, other: PlanarBodies) -> PlanarBodies:
        """The momenta of one, the positions and angles of the other."""
        return state._replace(position=other.position, angle=other.angle)

    def push(self, state: PlanarBodies, mass: PlanarInertia, impulses: Moves) -> PlanarBodies:
        """p += P and L += ΔL."""
        change = put_worlds_first(impulses, state.lanes)
        return state._replace(
            momentum=state.momentum + change[..., :2], angular_momentum=state.angular_momentum + change[..., 2]
        )

    def world_place(self, dtype: jnp.dtype) -> Places:
        """The world as a body that is not turned, at the origin, `(numbers, 1)`."""
        return jnp.zeros((3, 1), dtype)

    def place_points(self, places: Places, points: Array) -> list[Array]:
        """Where points `(2, joints, 1)` of bodies are, in components."""
        x, y = self.turn(places, points)
        return [places[0] + x, places[1] + y]

    def turn(self, places: Places, vectors: Array) -> list[Array]:
        """Vectors of bodies in the world frame, in components."""
        c, s = jnp.cos(places[2]), jnp.sin(places[2])
        return [c * vectors[0] - s * vectors[1], s * vectors[0] + c * vectors[1]]

    def compare(self, first: Places, second: Places) -> Array:
        """How the second bodies are turned relative to the first [rad], `(1, joints, worlds)`."""
        return second[2:] - first[2:]

    def measure_turn(self, turn: Array, reference: Array) -> list[Array]:
        """By which angle one turn differs from another [rad], a row."""
        return [turn[0] - reference[0]]

    def find_normals(self, axis: Array) -> list[Array]:
        """The direction across an axis `(2, joints, 1)`."""
        return [_normalise(jnp.stack([-axis[1], axis[0]]))]


class SpatialCoordinates:
    """Bodies in space: x, y, z [m] and the quaternion of their orientation."""

    dim = 3
    freedoms = 6

    def read_places(self, state: RigidBodies) -> Places:
        """Positions and quaternions."""
        return _join(*(put_worlds_last(part, state.lanes) for part in (state.position, state.orientation)))

    def read_rates(self, state: RigidBodies, mass: Inertia) -> Moves:
        """Velocities [m/s] and angular velocities [rad/s], in the world frame."""
        velocities = scale(1 / mass.mass, state.momentum), angular_velocity(state, mass)
        return _join(*(put_worlds_last(part, state.lanes) for part in velocities))

    def displace(self, places: Places, moves: Moves) -> Places:
        """x + d and q + ½(0, ω)q."""
        half = [jnp.zeros_like(moves[3]), *(0.5 * moves[3:])]
        turned = multiply_quaternions(half, list(places[3:]))
        return _join(places[:3] + moves[:3], places[3:] + jnp.stack(turned))

    def carry_on(self, places: Places, before: Places, after: Places) -> Places:
        """Moved by the difference, and turned by what turns one into the other."""
        turn = multiply_quaternions(list(after[3:]), conjugate_quaternion(list(before[3:])))
        return _join(places[:3] + (after[:3] - before[:3]), jnp.stack(multiply_quaternions(turn, list(places[3:]))))

    def read_mobility(self, state: RigidBodies, mass: Inertia) -> Array:
        """1/m and the columns of R I⁻¹ Rᵀ."""
        inverse, columns = Mobility.of(state, mass)
        parts = [put_worlds_last(inverse, state.lanes)[None], *(put_worlds_last(c, state.lanes) for c in columns)]
        return jnp.concatenate(parts)

    def measure_bodies(self, mobility: Array) -> Array:
        """The radius of gyration [m] about an axis of mean mobility."""
        return jnp.sqrt(3.0 * mobility[0] / (mobility[1] + mobility[5] + mobility[9]))

    def apply_mobility(self, mobility: Array, impulses: Moves) -> Moves:
        """Δv = P/m and Δω = R I⁻¹ Rᵀ ΔL."""
        turning = mobility[1:4] * impulses[3:4] + mobility[4:7] * impulses[4:5] + mobility[7:] * impulses[5:]
        return _join(mobility[:1] * impulses[:3], turning)

    def put_places(self, state: RigidBodies, other: RigidBodies) -> RigidBodies:
        """The momenta of one, the positions and orientations of the other."""
        return state._replace(position=other.position, orientation=other.orientation)

    def push(self, state: RigidBodies, mass: Inertia, impulses: Moves) -> RigidBodies:
        """p += P and L += ΔL."""
        change = put_worlds_first(impulses, state.lanes)
        return state._replace(
            momentum=state.momentum + change[..., :3], angular_momentum=state.angular_momentum + change[..., 3:]
        )

    def world_place(self, dtype: jnp.dtype) -> Places:
        """The world as a body that is not turned, at the origin, `(numbers, 1)`."""
        return jnp.asarray([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype)[:, None]

    def place_points(self, places: Places, points: Array) -> list[Array]:
        """Where points `(3, joints, 1)` of bodies are, in components."""
        return [x + r for x, r in zip(places[:3], self.turn(places, points), strict=True)]

    def turn(self, places: Places, vectors: Array) -> list[Array]:
        """Vectors of bodies in the world frame, in components."""
        return rotate_components(list(places[3:]), list(vectors))

    def compare(self, first: Places, second: Places) -> Array:
        """How the second bodies are turned relative to the first, as quaternions `(4, joints, worlds)`."""
        return jnp.stack(multiply_quaternions(conjugate_quaternion(list(first[3:])), list(second[3:])))

    def measure_turn(self, turn: Array, reference: Array) -> list[Array]:
        """By which small rotation vector one turn differs from another [rad], three rows."""
        w, *u = multiply_quaternions(list(turn), conjugate_quaternion(list(reference)))
        # a quaternion and its opposite are one rotation
        twice = jnp.where(w < 0, -2.0, 2.0)
        return [twice * part for part in u]

    def measure_twist(self, turn: Array, first: Array, second: Array) -> Array:
        """By which angle a turn is about an axis [rad], from -π to π, given as a vector `(3, joints, 1)` in both frames.

        It is zero where the shortest turn leads one frame to the other that leads one vector to the other.
        """
        a, b = _normalise(first), _normalise(second)
        cosine, sine = _dot(a, b), list(_cross(b, a))
        # opposite vectors have many shortest turns, of which one about any direction across them is taken
        across = self.find_normals(first)[0]
        opposite = cosine < OPPOSITE_COSINE
        shortest = [
            jnp.where(opposite, 0.0, 1.0 + cosine),
            *(jnp.where(opposite, n, s) for n, s in zip(across, sine, strict=True)),
        ]
        w, *u = multiply_quaternions(list(turn), conjugate_quaternion(shortest))
        s = _dot(u, a)
        return jnp.arctan2(2.0 * s * w, w * w - s * s)

    def find_normals(self, axis: Array) -> list[Array]:
        """Two directions across an axis `(3, joints, 1)` and each other."""
        a = _normalise(axis)
        smallest = jnp.argmin(jnp.abs(a), axis=0)
        other = jnp.stack([(smallest == i).astype(a.dtype) for i in range(3)])
        first = _normalise(_cross(a, other))
        return [first, _cross(a, first)]


BodyCoordinates = PlanarCoordinates | SpatialCoordinates
"""How bodies in the plane or in space are read."""


def choose_coordinates(name: str, state: PyTree) -> BodyCoordinates:
    """How the bodies of a state are read; a TypeError for a state of another kind."""
    if isinstance(state, PlanarBodies):
        return PlanarCoordinates()
    if isinstance(state, RigidBodies):
        return SpatialCoordinates()
    raise TypeError(
        f"{name}: got a state of type {type(state).__name__}, expected RigidBodies or PlanarBodies. "
        "What joins particles is springs.Rods."
    )


def _dot(a: Array | list[Array], b: Array | list[Array]) -> Array:
    """The scalar product of vectors in space, in components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Array, b: Array) -> Array:
    """Their vector product."""
    return jnp.stack([a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)])


def _normalise(vectors: Array) -> Array:
    """Vectors `(dim, joints, 1)` of length 1."""
    return vectors / jnp.sqrt(jnp.sum(vectors * vectors, axis=0, keepdims=True))


def _join(*parts: Array) -> Array:
    """Parts `(numbers, *rest)` as one, which broadcast in what follows."""
    rest = jnp.broadcast_shapes(*(part.shape[1:] for part in parts))
    return jnp.concatenate([jnp.broadcast_to(part, (part.shape[0], *rest)) for part in parts])


__all__ = ["BodyCoordinates", "PlanarCoordinates", "SpatialCoordinates", "choose_coordinates"]
