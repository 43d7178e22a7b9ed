"""What a run is drawn as: a surface, springs, bodies or dots, as the user says, or else as the scene is."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from physjax.physics.rigid.planar import PlanarBodies, PlanarShape
from physjax.physics.rigid.space import shapes as space
from physjax.physics.rigid.spatial import RigidBodies
from physjax.physics.springs.assembly import Lattice
from physjax.physics.springs.rods import Distances
from physjax.physics.springs.springs import Springs
from physjax.show.bodies import BodyShapes, SpaceShapes, check_shapes, find_body_shapes
from physjax.show.frames import Frames, get_faces, take_frames, take_lanes
from physjax.show.lines import Lines, are_lines, take_lines
from physjax.show.links import Links, find_links
from physjax.show.planar import build_planar_outline, check_planar_bodies, find_planar_shapes, list_shapes
from physjax.show.solids import Shape, place_shapes
from physjax.trajectory import Trajectory


class Surface(NamedTuple):
    """Nodes and the triangles between them, `(faces, 3)`: a cloth, a jelly, a mesh."""

    run: Frames
    faces: np.ndarray


class Bodies(NamedTuple):
    """Centres of mass, quaternions `(frames, bodies, 4)`, a shape for each body, and the rods and ropes between them."""

    run: Frames
    orientation: np.ndarray
    shapes: list[Shape]
    links: Links | None = None

    def surface(self) -> Surface:
        """The shapes where they are, their vertices as nodes, and behind these the ends of the links."""
        run, faces = place_shapes(self.run, self.orientation, self.shapes)
        return Surface(run if self.links is None else self.links.add_nodes(run), faces)


class PlanarFigures(NamedTuple):
    """Centres of mass in the plane, angles `(frames, bodies)` [rad], a shape for each body, and the links between them."""

    run: Frames
    angle: np.ndarray
    shapes: list[PlanarShape]
    links: Links | None = None

    def solids(self) -> Bodies:
        """The bodies as flat solids in space, in the plane z = 0, turned about z."""
        half, still = self.angle / 2, np.zeros_like(self.angle)
        place = np.pad(self.run.position, [(0, 0), (0, 0), (0, 1)])
        quaternions = np.stack([np.cos(half), still, still, np.sin(half)], axis=-1)
        ends = None if self.links is None else np.pad(self.links.ends, [(0, 0)] * 3 + [(0, 1)])
        links = None if self.links is None or ends is None else self.links._replace(ends=ends)
        shapes = [_build_sheet(shape) for shape in self.shapes]
        return Bodies(self.run._replace(position=place), quaternions, shapes, links)


class Dots(NamedTuple):
    """A dot for each lane."""

    run: Frames


Drawable = Surface | Lines | Bodies | PlanarFigures | Dots
Look = Lattice | Springs | Distances | tuple[Springs | Distances, ...] | BodyShapes
"""What a user may say that a run is drawn as."""


def choose_drawable(
    who: str,
    film: Trajectory,
    shown: Look | None,
    scene: int | Sequence[int] | None = None,
    dims: tuple[int, ...] = (3,),
) -> Drawable:
    """What a film is drawn as by `shown`: a lattice with faces, springs, rods, a lattice, a `Shape` or one for each body.

    Without it bodies are the shapes of the scene's `Solids`, else boxes of their own inertia; nodes are joined by
    all springs, rods and ropes of the scene, and all else is dots. Of a batch of scenes `scene` picks one. Raises TypeError or
    ValueError for what does not fit.
    """
    if shown is None and isinstance(film, Trajectory) and film.scene is not None and film.state is not None:
        shown = find_default_look(film)
    # a lattice is a tuple as well
    given = (
        isinstance(shown, Shape | space.Shape | PlanarShape | list | tuple)
        and not isinstance(shown, Lattice)
        and not are_lines(shown)
    )
    bodies = cast("BodyShapes | None", shown) if given else None
    if scene is not None and (shown is None or bodies is not None):
        raise ValueError(
            f"{who}: got scene={scene}, expected none: all lanes are drawn side by side. It picks one of a batch of "
            "cloths, ropes or other lattices."
        )
    if shown is None:
        return Dots(take_lanes(who, film, dims))
    if bodies is not None and isinstance(film.state, PlanarBodies) and 2 in dims:
        run, angle = check_planar_bodies(who, film)
        shapes = cast("PlanarShape | Sequence[PlanarShape]", bodies)
        return PlanarFigures(run, angle, list_shapes(who, shapes, angle.shape[1]), find_links(film))
    if bodies is not None:
        return Bodies(*check_shapes(who, film, cast("SpaceShapes", bodies)), find_links(film))
    if isinstance(shown, Lattice) and len(shown.faces):
        faces, nodes = get_faces(who, shown)
        return Surface(take_frames(who, film, scene=scene, nodes=nodes, dims=dims), faces)
    return take_lines(who, film, shown, scene, dims)


def find_default_look(film: Trajectory) -> Look | None:
    """What the scene of a film is drawn as: shapes for bodies, or boxes, all its lines not on a line, or None."""
    scene = film.scene
    if scene is None:
        return None
    if isinstance(film.state, RigidBodies):
        return find_body_shapes("find_default_look", film)
    if isinstance(film.state, PlanarBodies):
        return find_planar_shapes(film)
    if film.position.shape[-1] == 1:
        return None
    lines = tuple(force for force in scene.forces if isinstance(force, Springs | Distances))
    return lines if len(lines) > 1 else next(iter(lines), None)


def _build_sheet(shape: PlanarShape) -> Shape:
    """A shape of the plane as triangles from one of its corners to its other edges."""
    corners = build_planar_outline(shape).corners
    ends = np.arange(1, len(corners) - 1)
    faces = np.stack([np.zeros_like(ends), ends, ends + 1], axis=-1)
    return Shape(np.pad(corners, [(0, 0), (0, 1)]), faces)
