"""Rigid bodies as solids: triangles that are fixed to each body and turn with it."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.checks import NestedArrayLike, as_real_quantity
from physjax.meshes import check_mesh
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.planar import PlanarBodies, PlanarShape
from physjax.physics.rigid.spatial import RigidBodies
from physjax.show.frames import Frames, pick_frames, take_lanes
from physjax.show.panels import build_scenery, draw_panels
from physjax.show.planar import take_planar_bodies
from physjax.show.planar_contacts import MarkedBodies, find_contact_marks
from physjax.show.surfaces import draw_surface
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.typing import ColorType

__all__ = ["Shape", "box", "capsule", "cylinder", "sphere"]

CIRCLE_CORNERS = 24
"""Corners of the polygon that is drawn for a circle."""
MIN_EDGE_SHARE = 0.02
"""The thinnest edge that is drawn of a body without extent in that direction, as a share of its longest."""
MIN_AREA_SHARE = 1e-12
"""A triangle with an area below this share of the square of the shape's size has collapsed to a line, as at a pole."""
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""The corners of a cube of edge 1 about the origin."""
_CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
"""The twelve triangles of that cube, counterclockwise seen from outside."""


class Shape(NamedTuple):
    """The surface of a body in its own frame, from its centre of mass: vertices `(n, 3)` [m], triangles `(m, 3)`."""

    vertices: np.ndarray
    faces: np.ndarray

    def at(self, place: NestedArrayLike) -> "Shape":
        """The shape moved by a vector [m] in the frame of the body."""
        return self._replace(vertices=self.vertices + np.asarray(place, float))

    def joined(self, *others: "Shape") -> "Shape":
        """This shape and others as one."""
        vertices, faces = zip(self, *others, strict=True)
        starts = np.cumsum([0, *(len(part) for part in vertices[:-1])])
        return Shape(np.concatenate(vertices), np.concatenate([f + s for f, s in zip(faces, starts, strict=True)]))


BodyShapes = Shape | Sequence[Shape] | PlanarShape | Sequence[PlanarShape]
"""A shape for all bodies or one for each, in space or in the plane."""


def box(size: NestedArrayLike) -> Shape:
    """A box with edges along the axes [m], `(3,)`."""
    return Shape(_CUBE * np.asarray(as_real_quantity("size [m]", size, above=0.0), float), _CUBE_FACES)


def cylinder(radius: float, length: float, *, axis: int = 2) -> Shape:
    """A cylinder along an axis of the body (2: z), radius and length [m]."""
    return _revolve_outline(
        [(0.0, -0.5 * length), (radius, -0.5 * length), (radius, 0.5 * length), (0.0, 0.5 * length)], axis
    )


def capsule(radius: float, length: float, *, axis: int = 2) -> Shape:
    """A cylinder of a `length` between two hemispheres [m]."""
    angle = np.linspace(0, np.pi / 2, CIRCLE_CORNERS // 4 + 1)
    cap = np.stack([radius * np.sin(angle), 0.5 * length + radius * np.cos(angle)], axis=1)
    return _revolve_outline([*(cap * [1, -1]), *cap[::-1]], axis)


def sphere(radius: float) -> Shape:
    """A ball [m]."""
    return capsule(radius, 0.0)


def bodies(
    film: Trajectory,
    shapes: BodyShapes | None = None,
    frames: int | Iterable[int] | None = None,
    *,
    color: "ColorType | ArrayLike | None" = None,
    contacts: bool = False,
    figure: "Figure | None" = None,
) -> "Figure":
    """Draw rigid bodies at chosen frames, side by side, each as its shape; in space shaded by Lambert's law.

    `shapes` is a `Shape` for all bodies or one for each: `solids.box`, `cylinder`, `capsule`, `sphere`, or
    `Shape(*meshes.read_mesh(file)).at(-center)`; without it bodies are boxes of their inertia. In the plane it is a
    `rigid.PlanarShape` or one for each, without it those of the scene's `rigid.Solids`; `color` may be a number for each,
    and discs have a line that shows how they turn. With `contacts` there is a dot wherever they touch, and an arrow for
    each steady force, of which the title says the scale. The other arguments are as in `plot.cloth`. Returns the
    figure.

    Example:
        >>> from physjax.show import solids
        >>> figure = plot.bodies(tumble, solids.box((1.0, 2.0, 3.0)), frames=[0, -1])
        >>> len(figure.axes)
        2
    """
    who = "plot.bodies"
    seen, draw = prepare_bodies(who, film, shapes, color, contacts)
    chosen = pick_frames(who, seen, frames)
    return draw_panels(build_scenery(seen, chosen), chosen, draw, figure)


def prepare_bodies(
    who: str,
    film: Trajectory,
    shapes: BodyShapes | None,
    color: "ColorType | ArrayLike | None",
    contacts: bool = False,
) -> tuple[Frames, Callable]:
    """The frames of a run with the corners of all shapes in place of the bodies, and what draws them."""
    if isinstance(film, Trajectory) and isinstance(film.state, PlanarBodies):
        planar = cast("PlanarShape | Sequence[PlanarShape] | None", shapes)
        seen, draw = take_planar_bodies(who, film, planar, color)
        if not contacts:
            return seen, draw
        marks = find_contact_marks(who, film, seen)
        return marks.annotate(seen), MarkedBodies(draw, marks)
    if contacts:
        raise ValueError(f"{who}: got contacts=True for a run in space, expected one of PlanarBodies. Leave it out.")
    seen, faces = take_bodies(who, film, cast("Shape | Sequence[Shape] | None", shapes))
    color = cast("ColorType", "#56B4E9" if color is None else color)
    return seen, partial(draw_surface, faces=faces, color=color, closed=True)


def take_bodies(who: str, film: Trajectory, shapes: Shape | Sequence[Shape] | None) -> tuple[Frames, np.ndarray]:
    """The frames of a run with the vertices of all shapes in place of the bodies, and the triangles between them."""
    return place_shapes(*check_shapes(who, film, shapes))


def check_shapes(
    who: str, film: Trajectory, shapes: Shape | Sequence[Shape] | None
) -> tuple[Frames, np.ndarray, list[Shape]]:
    """Centres of mass of a run's bodies, their quaternions `(frames, bodies, 4)`, and a checked shape for each."""
    seen = take_lanes(who, film, dims=(3,))
    if not isinstance(film.state, RigidBodies):
        raise TypeError(
            f"{who}: got a film of {type(film.state).__name__}, expected RigidBodies. plot.paths draws others."
        )
    lanes = seen.position.shape[1]
    given = build_inertia_boxes(who, film) if shapes is None else shapes
    found = [given] * lanes if isinstance(given, Shape) else list(given)
    if len(found) != lanes or not all(isinstance(shape, Shape) for shape in found):
        raise ValueError(f"{who}: got {len(found)} shapes, expected a Shape for all {lanes} bodies or one for each.")
    checked = [Shape(*check_mesh(*shape, name=f"{who}: shape {i}")) for i, shape in enumerate(found)]
    return seen, np.asarray(film.state.orientation, float).reshape(len(seen.time), lanes, 4), checked


def place_shapes(seen: Frames, orientation: np.ndarray, shapes: list[Shape]) -> tuple[Frames, np.ndarray]:
    """The shapes of bodies moved and turned with them: frames of all their vertices, and the triangles between them."""
    corners = [
        seen.position[:, i, None] + _rotate(orientation[:, i, None], shape.vertices[None])
        for i, shape in enumerate(shapes)
    ]
    whole = shapes[0].joined(*shapes[1:])
    return seen._replace(position=np.concatenate(corners, axis=1)), whole.faces


def build_inertia_boxes(who: str, film: Trajectory) -> list[Shape]:
    """The box of each body of a run; a ValueError for a run without its scene."""
    if film.scene is None:
        raise ValueError(f"{who}: got a run without its scene, expected a shape for each body. Load it with scene=.")
    return [build_inertia_box(film.scene.mass, lane) for lane in np.ndindex(film.scene.state.lanes)]


def build_inertia_box(inertia: Inertia, lane: tuple[int, ...] = ()) -> Shape:
    """The uniform box with a body's mass and principal moments: edges a² = 6 (I₂ + I₃ - I₁)/m, and so on.

    Of a body with a pivot the moments about its centre of mass are taken, I - m (|r|² 1 - r rᵀ). An edge of length zero is
    drawn thin. `lane` is the index of the body in a batch.
    """
    own = lambda leaf, axes: np.asarray(leaf, float)[lane if np.ndim(leaf) > axes else ()]  # noqa: E731
    mass, tensor = own(inertia.mass, 0), own(inertia.tensor, 2)
    if inertia.arm is not None:
        arm = own(inertia.arm, 1)
        tensor = tensor - mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = np.linalg.eigh(tensor)
    edges = np.sqrt(np.maximum(6 / mass * (moments.sum() - 2 * moments), 0.0))
    edges = np.maximum(edges, MIN_EDGE_SHARE * edges.max())
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a mirror: faces keep their outer side
    solid = box(edges)
    return solid._replace(vertices=solid.vertices @ axes.T)


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors turned by unit quaternions (w, x, y, z): v + 2w (u × v) + 2u × (u × v)."""
    twice = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * twice + np.cross(q[..., 1:], twice)


def _revolve_outline(outline: Sequence[Sequence[float] | np.ndarray], axis: int) -> Shape:
    """The solid of revolution of an outline of points (distance from the axis, place along it)."""
    angle = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(CIRCLE_CORNERS, z)], axis=1) for r, z in outline]
    here, there = np.arange(CIRCLE_CORNERS), np.roll(np.arange(CIRCLE_CORNERS), -1)
    faces = []
    for start in range(0, CIRCLE_CORNERS * (len(outline) - 1), CIRCLE_CORNERS):
        low, high = start, start + CIRCLE_CORNERS
        faces += [
            np.stack([low + here, low + there, high + there], 1),
            np.stack([low + here, high + there, high + here], 1),
        ]
    vertices, faces = np.roll(np.concatenate(rings), axis - 2, axis=1), np.concatenate(faces)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    has_area = np.abs(np.cross(b - a, c - a)).max(axis=1) > MIN_AREA_SHARE * np.abs(vertices).max() ** 2
    return Shape(vertices, faces[has_area])


def __dir__() -> list[str]:
    return __all__
