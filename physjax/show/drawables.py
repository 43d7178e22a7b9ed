"""What is seen of a run: a surface, springs, bodies or dots; chosen by what is given, or else by what the scene is."""

from typing import Any, NamedTuple

import numpy as np

from physjax.physics.springs.springs import Springs
from physjax.show.frames import Take, faces_of, springs_of, take, take_lanes
from physjax.show.solids import Shape, in_place, shapes_of, solid_of
from physjax.trajectory import Trajectory


class Surface(NamedTuple):
    """Nodes and the triangles between them, `(faces, 3)`: a cloth, a jelly, a mesh."""

    take: Take
    faces: np.ndarray


class Lines(NamedTuple):
    """Nodes and the springs between them: a rope, a bridge, a lattice without its faces."""

    take: Take
    springs: Springs


class Bodies(NamedTuple):
    """Centres of mass, quaternions `(frames, bodies, 4)`, and a shape for each body."""

    take: Take
    orientation: np.ndarray
    shapes: list[Shape]

    def surface(self) -> Surface:
        """The shapes where they are, their vertices as nodes."""
        return Surface(*in_place(self.take, self.orientation, self.shapes))


class Dots(NamedTuple):
    """All lanes side by side."""

    take: Take


def subject(who: str, film: Trajectory, shown: Any, scene: Any = None, dims: tuple[int, ...] = (3,)) -> Any:
    """What `shown` makes of a film: a lattice with faces, springs, a lattice of them, a `Shape` or one for each body.

    Without it the scene says: bodies are solids of their own inertia, nodes are joined by the springs of the scene,
    all else is dots. Of a batch of scenes `scene` picks one. Raises TypeError or ValueError for what does not fit.
    """
    if shown is None and isinstance(film, Trajectory) and film.scene is not None and film.state is not None:
        shown = own(film)
    bodies = isinstance(shown, Shape) or (isinstance(shown, list | tuple) and not hasattr(shown, "_fields"))
    if scene is not None and (shown is None or bodies):
        raise ValueError(
            f"{who}: got scene={scene}, expected none: all lanes are drawn side by side. It picks one of a batch of "
            "cloths, ropes or other lattices."
        )
    if shown is None:
        return Dots(take_lanes(who, film, dims))
    if bodies:
        return Bodies(*shapes_of(who, film, shown))
    if len(getattr(shown, "faces", ())):
        faces, nodes = faces_of(who, shown)
        return Surface(take(who, film, scene=scene, nodes=nodes, dims=dims), faces)
    given = springs_of(who, shown)
    return Lines(take(who, film, scene=scene, nodes=given.nodes, dims=dims), given)


def own(film: Trajectory) -> Any:
    """What a film's scene says of its looks: solids for bodies, its springs (not those of a line), or None."""
    if hasattr(film.state, "orientation"):
        return [solid_of(film.scene.mass, lane) for lane in np.ndindex(film.scene.state.position.shape[:-1])]
    springs = [force for force in film.scene.forces if isinstance(force, Springs)]
    return springs[0] if springs and film.position.shape[-1] > 1 else None
