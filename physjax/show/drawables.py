"""What is seen of a run: a surface, springs, bodies or dots; chosen by what is given, or else by what the scene is."""

from typing import Any, NamedTuple

import numpy as np

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
    """All lanes side by side."""

    run: Frames


def choose_drawable(who: str, film: Trajectory, shown: Any, scene: Any = None, dims: tuple[int, ...] = (3,)) -> Any:
    """What `shown` makes of a film: a lattice with faces, springs, a lattice of them, a `Shape` or one for each body.

    Without it the scene says: bodies are solids of their own inertia, nodes are joined by the springs of the scene,
    all else is dots. Of a batch of scenes `scene` picks one. Raises TypeError or ValueError for what does not fit.
    """
    if shown is None and isinstance(film, Trajectory) and film.scene is not None and film.state is not None:
        shown = find_default_look(film)
    bodies = isinstance(shown, Shape) or (isinstance(shown, list | tuple) and not hasattr(shown, "_fields"))
    if scene is not None and (shown is None or bodies):
        raise ValueError(
            f"{who}: got scene={scene}, expected none: all lanes are drawn side by side. It picks one of a batch of "
            "cloths, ropes or other lattices."
        )
    if shown is None:
        return Dots(take_lanes(who, film, dims))
    if bodies:
        return Bodies(*check_shapes(who, film, shown))
    if len(getattr(shown, "faces", ())):
        faces, nodes = get_faces(who, shown)
        return Surface(take_frames(who, film, scene=scene, nodes=nodes, dims=dims), faces)
    given = get_springs(who, shown)
    return Lines(take_frames(who, film, scene=scene, nodes=given.nodes, dims=dims), given)


def find_default_look(film: Trajectory) -> Any:
    """What a film's scene says of its looks: solids for bodies, its springs (not those of a line), or None."""
    if hasattr(film.state, "orientation"):
        return [build_inertia_box(film.scene.mass, lane) for lane in np.ndindex(film.scene.state.position.shape[:-1])]
    springs = [force for force in film.scene.forces if isinstance(force, Springs)]
    return springs[0] if springs and film.position.shape[-1] > 1 else None
