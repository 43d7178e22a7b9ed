"""Rigid bodies drawn as their shapes, in the plane and in space, with the rods and ropes between them."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.meshes import check_mesh
from physjax.physics.rigid.planar import PlanarBodies, PlanarShape
from physjax.physics.rigid.solids.contact import Solids
from physjax.physics.rigid.space import shapes as space
from physjax.physics.rigid.spatial import RigidBodies
from physjax.show.frames import Frames, pick_frames, take_lanes
from physjax.show.links import LinkPicture, find_links
from physjax.show.panels import Scenery, build_scenery, draw_panels
from physjax.show.planar import choose_colours, take_planar_bodies
from physjax.show.planar_contacts import find_contact_marks
from physjax.show.solids import Shape, build_inertia_box, place_shapes, triangulate_shape
from physjax.show.surfaces import draw_surface
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import ColorType

ONE_COLOUR = "#56B4E9"
"""Of bodies of which the scene says no shapes."""

SpaceShapes = Shape | space.Shape | Sequence[Shape] | Sequence[space.Shape]
"""A shape for all bodies in space or one for each, to be drawn or as the scene keeps them apart."""
BodyShapes = SpaceShapes | PlanarShape | Sequence[PlanarShape]
"""A shape for all bodies or one for each, in space or in the plane."""


class BodyLayers(NamedTuple):
    """Draws frames of bodies, and what belongs to them: the lines between them, and the marks of their contacts."""

    layers: tuple[Callable, ...]

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes in the plane or in space."""
        return [artist for layer in self.layers for artist in layer(ax, scenery, frame)]


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
    `Shape(*meshes.read_mesh(file)).at(-center)`, or a `rigid.Shape`; in the plane a `rigid.PlanarShape`. Without it bodies
    are the shapes of the scene's `rigid.Solids`, else boxes of their inertia. Rods and ropes between them are lines, dashed
    where they are broken. `color` may be a number for each, and in the plane discs have a line that shows how they turn.
    With `contacts`, in the plane, there is a dot wherever they touch, and an arrow for each steady force, of which the title
    says the scale. The other arguments are as in `plot.cloth`. Returns the figure.

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
    flat = isinstance(film, Trajectory) and isinstance(film.state, PlanarBodies)
    if contacts and not flat:
        raise ValueError(f"{who}: got contacts=True for a run in space, expected one of PlanarBodies. Leave it out.")
    if flat:
        seen, draw = take_planar_bodies(who, film, cast("PlanarShape | Sequence[PlanarShape] | None", shapes), color)
        faces = np.zeros((0, 3), int)
    else:
        whole, orientation, found = check_shapes(who, film, cast("SpaceShapes | None", shapes))
        seen, faces = place_shapes(whole, orientation, found)
        colours = choose_body_colours(who, film, color, len(found))
        each = np.repeat(colours[:, :3], [len(shape.faces) for shape in found], axis=0)
        draw = partial(draw_surface, faces=faces, color=each, closed=True)
    layers: list[Callable] = [draw]
    if (links := find_links(film)) is not None:
        seen = links.add_nodes(seen)
        layers.append(LinkPicture(links, faces))
    if contacts:
        layers.append(find_contact_marks(who, film, seen))
        seen = layers[-1].annotate(seen)
    return seen, BodyLayers(tuple(layers))


def check_shapes(who: str, film: Trajectory, shapes: SpaceShapes | None) -> tuple[Frames, np.ndarray, list[Shape]]:
    """Centres of mass of a run's bodies, their quaternions `(frames, bodies, 4)`, and a checked shape for each."""
    seen = take_lanes(who, film, dims=(3,))
    if not isinstance(film.state, RigidBodies):
        raise TypeError(
            f"{who}: got a film of {type(film.state).__name__}, expected RigidBodies. plot.paths draws others."
        )
    lanes = seen.position.shape[1]
    given = find_body_shapes(who, film) if shapes is None else shapes
    several = [given] * lanes if isinstance(given, Shape | space.Shape) else list(given)
    found = [triangulate_shape(shape) if isinstance(shape, space.Shape) else shape for shape in several]
    if len(found) != lanes or not all(isinstance(shape, Shape) for shape in found):
        raise ValueError(f"{who}: got {len(found)} shapes, expected a Shape for all {lanes} bodies or one for each.")
    checked = [Shape(*check_mesh(*shape, name=f"{who}: shape {i}")) for i, shape in enumerate(found)]
    return seen, np.asarray(film.state.orientation, float).reshape(len(seen.time), lanes, 4), checked


def find_body_shapes(who: str, film: Trajectory) -> list[Shape]:
    """The shape of each body of a run in space: that of the scene's `Solids`, else the box of its inertia.

    Raises ValueError for a run without its scene.
    """
    scene = film.scene
    if scene is None:
        raise ValueError(f"{who}: got a run without its scene, expected a shape for each body. Load it with scene=.")
    if (solids := find_solids(film)) is None:
        return [build_inertia_box(scene.mass, lane) for lane in np.ndindex(scene.state.lanes)]
    *worlds, bodies = scene.state.lanes
    shapes = [triangulate_shape(shape) for shape in solids.shapes if isinstance(shape, space.Shape)]
    return (shapes * bodies if len(shapes) == 1 else shapes) * int(np.prod(worlds, dtype=int))


def choose_body_colours(who: str, film: Trajectory, color: "ColorType | ArrayLike | None", bodies: int) -> np.ndarray:
    """A colour for each body: without `color` many where the scene's `Solids` keep them apart, in space else one for all."""
    many = isinstance(film.state, PlanarBodies) or find_solids(film) is not None
    return choose_colours(who, color if color is not None or many else ONE_COLOUR, bodies)


def find_solids(film: Trajectory) -> Solids | None:
    """The solids of a run's scene, if there are some."""
    contacts = () if film.scene is None else film.scene.contacts
    return next((contact for contact in contacts if isinstance(contact, Solids)), None)


__all__ = [
    "BodyLayers",
    "BodyShapes",
    "SpaceShapes",
    "bodies",
    "check_shapes",
    "choose_body_colours",
    "find_body_shapes",
    "prepare_bodies",
]
