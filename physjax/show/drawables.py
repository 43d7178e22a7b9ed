"""What a run is drawn as: a surface, springs, bodies or dots, as the user says, or else as the scene is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physjax.physics.rigid.spatial import RigidBodies
from physjax.physics.springs.assembly import Lattice
from physjax.physics.springs.springs import Springs
from physjax.show.frames import Frames, get_faces, get_springs, take_frames, take_lanes
from physjax.show.solids import Shape, build_inertia_box, check_shapes, place_shapes
from physjax.trajectory import Trajectory


class Surface(NamedTuple):
    """Nodes and the triangles between them, `(faces, 3)`: a cloth, a jelly, a mesh."""

    run: Frames
    faces: np.ndarray


class Lines(NamedTuple):
    """Nodes and the springs between them: a rope, a bridge, a lattice without its faces."""

    run: Frames
    springs: Springs


class Bodies(NamedTuple):
    """Centres of mass, quaternions `(frames, bodies, 4)`, and a shape for each body."""

    run: Frames
    orientation: np.ndarray
    shapes: list[Shape]

    def surface(self) -> Surface:
        """The shapes where they are, their vertices as nodes."""
        return Surface(*place_shapes(self.run, self.orientation, self.shapes))


class Dots(NamedTuple):
    """A dot for each lane."""

    run: Frames


Drawable = Surface | Lines | Bodies | Dots
Look = Lattice | Springs | Shape | Sequence[Shape]
"""What a user may say that a run is drawn as."""


def choose_drawable(
    who: str,
    film: Trajectory,
    shown: Look | None,
    scene: int | Sequence[int] | None = None,
    dims: tuple[int, ...] = (3,),
) -> Drawable:
    """What a film is drawn as by `shown`: a lattice with faces, springs, a lattice of them, a `Shape` or one for each body.

    Without it bodies are boxes of their own inertia, nodes are joined by the springs of the scene, and all else is dots.
    Of a batch of scenes `scene` picks one. Raises TypeError or ValueError for what does not fit.
    """
    if shown is None and isinstance(film, Trajectory) and film.scene is not None and film.state is not None:
        shown = find_default_look(film)
    # a lattice is a tuple as well
    bodies = shown if isinstance(shown, Shape | list | tuple) and not isinstance(shown, Lattice) else None
    if scene is not None and (shown is None or bodies is not None):
        raise ValueError(
            f"{who}: got scene={scene}, expected none: all lanes are drawn side by side. It picks one of a batch of "
            "cloths, ropes or other lattices."
        )
    if shown is None:
        return Dots(take_lanes(who, film, dims))
    if bodies is not None:
        return Bodies(*check_shapes(who, film, bodies))
    if isinstance(shown, Lattice) and len(shown.faces):
        faces, nodes = get_faces(who, shown)
        return Surface(take_frames(who, film, scene=scene, nodes=nodes, dims=dims), faces)
    given = get_springs(who, shown)
    return Lines(take_frames(who, film, scene=scene, nodes=given.nodes, dims=dims), given)


def find_default_look(film: Trajectory) -> Look | None:
    """What the scene of a film is drawn as: boxes for bodies, its springs (not those of a line), or None."""
    scene = film.scene
    if scene is None:
        return None
    if isinstance(film.state, RigidBodies):
        return [build_inertia_box(scene.mass, lane) for lane in np.ndindex(scene.state.position.shape[:-1])]
    springs = [force for force in scene.forces if isinstance(force, Springs)]
    return springs[0] if springs and film.position.shape[-1] > 1 else None
