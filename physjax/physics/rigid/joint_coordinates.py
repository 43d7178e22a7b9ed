"""Rigid bodies as joints read and move them: in the plane by x, y and an angle, in space by a place and a quaternion."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from physjax.constraints.coordinates import Moves, Places, put_worlds_first, put_worlds_last
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar_inertia import PlanarInertia
from physjax.physics.rigid.spatial import RigidBodies, angular_velocity
from physjax.vectors import broadcast_vector, conjugate_quaternion, multiply_quaternions, rotate_components, scale

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
        return [normalise(jnp.stack([-axis[1], axis[0]]))]


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
        read = lambda vector, like: put_worlds_last(broadcast_vector(vector, like), state.lanes)  # noqa: E731
        frame = put_worlds_last(state.orientation, state.lanes)
        if mass.axes is not None:
            frame = jnp.stack(multiply_quaternions(list(frame), list(read(mass.axes, state.orientation))))
        matrix, inverse = _find_rotation(frame), read(mass.inverse, state.position)
        turning = jnp.sum((matrix * inverse[None])[:, None] * matrix[None], axis=2)
        return _join(put_worlds_last(1 / mass.mass, state.lanes)[None], turning.reshape(9, *frame.shape[1:]))

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

    def turn_each(self, places: Places, vectors: Array) -> Array:
        """Vectors of bodies `(3, *rest)` in the world frame, where the places have as many axes."""
        # a sum over an axis: what it returns is stored, where its readers would compute components anew
        return jnp.sum(_find_rotation(places[3:]) * vectors[None], axis=1)

    def compare(self, first: Places, second: Places) -> Array:
        """How the second bodies are turned relative to the first, as quaternions `(4, joints, worlds)`."""
        return jnp.stack(multiply_quaternions(conjugate_quaternion(list(first[3:])), list(second[3:])))

    def measure_turn(self, turn: Array, reference: Array) -> list[Array]:
        """By which small rotation vector one turn differs from another [rad], three rows."""
        w, *u = multiply_quaternions(list(turn), conjugate_quaternion(list(reference)))
        # a quaternion and its opposite are one rotation
        twice = jnp.where(w < 0, -2.0, 2.0)
        return [twice * part for part in u]

    def measure_twist(self, first: Places, second: Places, axes: Array) -> Array:
        """By which angle the second bodies are turned relative to the first about an axis [rad], from -π to π.

        It is given as unit vectors in both frames, `(3, 2, joints, 1)`. The angle is zero where the shortest turn leads one
        frame to the other that leads one vector to the other.
        """
        a, b = axes[:, 0], axes[:, 1]
        cosine = jnp.sum(a * b, axis=0, keepdims=True)
        # the shortest turn s and (0, a) s; opposite vectors have many, of which one about any direction across is taken
        shortest = jnp.stack(
            [jnp.concatenate([1.0 + cosine, cross_rows(b, a)]), jnp.pad(a + b, [(1, 0), (0, 0), (0, 0)])], 1
        )
        about = jnp.pad(jnp.stack(self.find_normals(a), axis=1), [(1, 0), (0, 0), (0, 0), (0, 0)])
        reference = jnp.where((cosine < OPPOSITE_COSINE)[:, None], about, shortest)
        # of f⁻¹ g s⁻¹ the real part is g · f s, and that along a is g · f (0, a) s
        there = multiply_quaternions(list(first[3:, None]), list(reference))
        w, s = dot_components(list(second[3:, None]), there)
        return jnp.arctan2(2.0 * s * w, w * w - s * s)

    def find_normals(self, axis: Array) -> list[Array]:
        """Two directions across unit vectors `(3, joints, 1)`, and across each other."""
        places = jnp.arange(3).reshape(3, *[1] * (axis.ndim - 1))
        e = (jnp.argmin(jnp.abs(axis), axis=0, keepdims=True) == places).astype(axis.dtype)
        # a × e of length √(1 - (a·e)²), and a × (a × e) = (a·e) a - e
        along = jnp.sum(axis * e, axis=0, keepdims=True)
        inverse = 1.0 / jnp.sqrt(1.0 - along * along)
        return [cross_rows(axis, e) * inverse, (along * axis - e) * inverse]


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


def _find_rotation(turn: Array) -> Array:
    """The rotation matrices of quaternions `(4, *rest)`: rows and columns in front."""
    axes = jnp.eye(3, dtype=turn.dtype).reshape(3, 3, *[1] * (turn.ndim - 1))
    return jnp.stack(rotate_components(list(turn[:, None]), list(axes)))


def dot_components(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """The scalar product of vectors in components."""
    total = a[0] * b[0]
    for p, q in zip(a[1:], b[1:], strict=True):
        total = total + p * q
    return total


def normalise(vectors: Array) -> Array:
    """Vectors `(dim, *rest)` of length 1."""
    return vectors / jnp.sqrt(jnp.sum(vectors * vectors, axis=0, keepdims=True))


def cross_rows(a: Array, b: Array) -> Array:
    """The vector product of vectors in space `(3, *rest)`."""
    p, q = jnp.split(a, 3), jnp.split(b, 3)
    return jnp.concatenate([p[i - 2] * q[i - 1] - p[i - 1] * q[i - 2] for i in range(3)])


def _join(*parts: Array) -> Array:
    """Parts `(numbers, *rest)` as one, which broadcast in what follows."""
    rest = jnp.broadcast_shapes(*(part.shape[1:] for part in parts))
    return jnp.concatenate([jnp.broadcast_to(part, (part.shape[0], *rest)) for part in parts])


__all__ = [
    "BodyCoordinates",
    "PlanarCoordinates",
    "SpatialCoordinates",
    "choose_coordinates",
    "cross_rows",
    "dot_components",
    "normalise",
]
