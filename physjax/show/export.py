"""Runs for Blender, engines and other programs: animated glTF, and PLY files frame by frame. `Trajectory.save` writes NPZ.

`shown` says what a run is exported as, as in `animate.view`: a lattice with faces, springs, a `solids` shape or one for
each body. Without it bodies are the shapes of the scene's `rigid.Solids` or boxes of their inertia, and nodes are joined by
the springs of the scene. Rods and ropes between bodies are lines.

Metres. glTF has y up, and its root node turns a scene with another axis up; PLY has the axes of the scene. In the plane
z is 0.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.files import write_atomically, write_folder_atomically
from physjax.name_hints import hint_at_names
from physjax.show.bodies import choose_body_colours
from physjax.show.drawables import Bodies, Dots, Look, PlanarFigures, Surface, choose_drawable
from physjax.show.films import schedule
from physjax.show.frames import Frames
from physjax.show.gltf import LINES, POINTS, TRIANGLES, Document, Json
from physjax.show.lines import Lines
from physjax.show.links import LINK_LOOK, Links
from physjax.show.page_data import number_shapes
from physjax.show.pages import check_output_path
from physjax.text import progress_bar
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

__all__ = ["gltf", "ply"]

MAX_MORPH_TARGETS = 240
"""Frames of a shape that deforms in one glTF file: each is a morph target, and programs fail beyond a few hundred."""
MAX_MORPH_BYTES = 2**30
"""Bytes of the arrays in one glTF file; the format's own limit is four times that."""
DEFAULT_COLOR = "#56B4E9"

T = TypeVar("T")


def gltf(
    film: Trajectory,
    path: str | os.PathLike,
    shown: Look | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    color: "ColorType | ArrayLike | None" = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
    progress: bool = True,
) -> Path:
    """Write a run as an animated glTF file, .glb, whole or not at all; returns its path.

    Bodies are nodes that move and turn. A cloth, springs and dots have a morph target for each frame, linear in between:
    12 bytes a node and frame, no normals, at most 240 frames and 1 GiB. The file plays `speed` seconds of the run a
    second, in `fps` frames. `color` is one for all, or a value for each body. Numbers are float32.

    Raises TypeError or ValueError for what does not fit, too many frames among them (choose a lower `fps`, a higher
    `speed`, or `export.ply`), lanes that blew up, and springs that break, since glTF cannot remove a line of a mesh. Rods
    and ropes between bodies have a node each, which shrinks to nothing where they break.

    Example:
        >>> from physjax.show import solids
        >>> export.gltf(tumble, "tumble.glb", solids.box((1.0, 2.0, 3.0)), progress=False).name
        'tumble.glb'
    """
    who = "export.gltf"
    path = check_output_path(path, (".glb",))
    seen = choose_drawable(who, film, shown, scene, dims=(2, 3))
    seen = seen.solids() if isinstance(seen, PlanarFigures) else seen
    frames, fps = schedule(who, seen.run, fps, speed)
    place = _require_finite_positions(who, seen.run, frames)
    if not isinstance(seen, Bodies):
        _check_morph_size(who, place)
    if isinstance(seen, Lines) and seen.held is not None and not seen.held[frames].all():
        raise ValueError(
            f"{who}: got springs that break, expected intact ones: glTF cannot remove a line. export.ply writes "
            "those that are intact."
        )
    document = Document(seen.run.up if seen.run.dim == 3 else 1)
    times = document.accessor(np.arange(len(frames)) / fps)
    if isinstance(seen, Bodies):
        colours = choose_body_colours(who, film, color, len(seen.shapes))
        _add_bodies(document, seen, colours, place, frames, times)
        if seen.links is not None:
            _add_links(document, seen.links, frames, times)
    else:
        material = document.material(_to_rgb(DEFAULT_COLOR if color is None else cast("ColorType", color)))
        _add_morphing(document, seen, _track_progress(place, progress), times, material)
    with write_atomically(path, "wb") as file:
        file.write(document.bytes())
    return path


def ply(
    film: Trajectory,
    folder: str | os.PathLike,
    shown: Look | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
    progress: bool = True,
) -> list[Path]:
    """Write a run as binary PLY files, `frame_0000.ply` and on, into a new folder, all or none; returns their paths.

    Surfaces and bodies have faces, intact springs are edges, dots are points. Numbers are float32 [m]; lanes that
    blew up are left out, and the time of a frame [s] is in its header. Raises TypeError or ValueError for what does not
    fit, and an OSError for a folder that cannot be made or is not empty.

    Example:
        >>> files = export.ply(wave, "frames", sheet, speed=0.1, progress=False)
        >>> files[0].name, len(files)
        ('frame_0000.ply', 11)
    """
    who = "export.ply"
    folder = Path(folder)
    seen = choose_drawable(who, film, shown, scene, dims=(2, 3))
    seen = seen.solids() if isinstance(seen, PlanarFigures) else seen
    links = seen.links if isinstance(seen, Bodies) else None
    seen = seen.surface() if isinstance(seen, Bodies) else seen
    frames, fps = schedule(who, seen.run, fps, speed)
    edges = seen.pairs if isinstance(seen, Lines) else None if links is None else links.list_pairs(seen.run)
    held = seen.held if isinstance(seen, Lines) else None if links is None else links.held
    digits = max(4, len(str(len(frames))))
    names = [f"frame_{number:0{digits}d}.ply" for number in range(len(frames))]
    with write_folder_atomically(folder) as inside:
        for name, frame in _track_progress(list(zip(names, frames, strict=True)), progress):
            intact = edges if edges is None or held is None else edges[held[frame]]
            faces = seen.faces if isinstance(seen, Surface) else None
            code = _encode_ply(_pad_to_three(seen.run.position[frame]), faces, intact, seen.run.time[frame])
            (inside / name).write_bytes(code)
    return [folder / name for name in names]


def _add_bodies(
    document: Document, seen: Bodies, colours: np.ndarray, place: np.ndarray, frames: list[int], times: int
) -> None:
    """The arrays of each shape that differs, a mesh for each of these in a colour, and a node for each body."""
    turn = np.roll(_align_quaternion_signs(seen.orientation[frames]), -1, axis=-1)
    numbers, different = number_shapes(seen.shapes)
    arrays = [
        {"attributes": {"POSITION": document.vertices(shape.vertices)}, "indices": document.indices(shape.faces)}
        for shape in different
    ]
    looks: dict[tuple[float, ...], int] = {}
    meshes: dict[tuple[int, int], int] = {}
    for body, number in enumerate(numbers):
        rgb = tuple(colours[body, :3].tolist())
        look = looks[rgb] if rgb in looks else looks.setdefault(rgb, document.material(rgb))
        if (number, look) not in meshes:
            meshes[number, look] = document.mesh(arrays[number] | {"mode": TRIANGLES, "material": look})
        stands = {"translation": place[0, body].tolist(), "rotation": turn[0, body].tolist()}
        node = document.node(name=f"body {body}", mesh=meshes[number, look], **stands)
        document.animate(node, "translation", times, document.accessor(place[:, body]))
        document.animate(node, "rotation", times, document.accessor(turn[:, body]))


def _add_links(document: Document, links: Links, frames: list[int], times: int) -> None:
    """One mesh, a line from the origin to (1, 0, 0), and a node for each link that puts, turns and stretches it."""
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    what: Json = {"attributes": {"POSITION": document.vertices(line)}, "mode": LINES}
    mesh = document.mesh(what | {"material": document.material(_to_rgb(LINK_LOOK["colors"]))})
    start, end = np.moveaxis(links.ends[frames], 2, 0)
    way = end - start
    length = np.sqrt((way * way).sum(axis=-1, keepdims=True))
    turn = np.roll(_align_quaternion_signs(_turn_from_x(way / np.where(length > 0, length, 1.0))), -1, axis=-1)
    scale = np.where(links.held[frames][..., None], length, 0.0) * [1.0, 0.0, 0.0] + [0.0, 1.0, 1.0]
    for link in range(start.shape[1]):
        moves = {"translation": start[:, link], "rotation": turn[:, link], "scale": scale[:, link]}
        node = document.node(
            name=f"link {link}", mesh=mesh, **{path: values[0].tolist() for path, values in moves.items()}
        )
        for path, values in moves.items():
            document.animate(node, path, times, document.accessor(values))


def _turn_from_x(direction: np.ndarray) -> np.ndarray:
    """Unit quaternions (w, x, y, z) that turn the x axis to unit vectors `(..., 3)`, the short way."""
    x, y, z = np.moveaxis(direction, -1, 0)
    found = np.stack([1 + x, np.zeros_like(x), -z, y], axis=-1)
    # straight back: half a turn about y
    found = np.where(1 + x[..., None] > 1e-12, found, [0.0, 0.0, 1.0, 0.0])
    return found / np.sqrt((found * found).sum(axis=-1, keepdims=True))


def _add_morphing(
    document: Document, seen: Surface | Lines | Dots, places: Iterable[np.ndarray], times: int, look: int
) -> None:
    """One mesh with the shape of the first frame, and each other frame as a morph target of weight 0 or 1."""
    first, *others = places
    what: Json = {"attributes": {"POSITION": document.vertices(first)}, "mode": POINTS, "material": look}
    if isinstance(seen, Surface):
        what |= {"mode": TRIANGLES, "indices": document.indices(seen.faces)}
    elif isinstance(seen, Lines):
        what |= {"mode": LINES, "indices": document.indices(seen.pairs)}
    what["targets"] = [{"POSITION": document.vertices(place - first)} for place in others]
    node = document.node(name="run", mesh=document.mesh(what, weights=[0.0] * len(others)))
    weights = np.eye(len(others) + 1)[:, 1:]
    document.animate(node, "weights", times, document.accessor(weights.ravel()))


def _encode_ply(place: np.ndarray, faces: np.ndarray | None, edges: np.ndarray | None, time: float) -> bytes:
    """The bytes of a file with one frame; without faces and edges, of the places that are finite."""
    vertices = place.astype("<f4")
    if faces is None and edges is None:
        vertices = vertices[np.isfinite(vertices).all(axis=-1)]
    header = ["ply", "format binary_little_endian 1.0", f"comment t = {time:.9g} s"]
    header += [f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in "xyz")]
    body = vertices.tobytes()
    if faces is not None:
        table = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", (3,))])
        table["count"], table["corners"] = 3, faces
        header += [f"element face {len(table)}", "property list uchar int vertex_indices"]
        body += table.tobytes()
    if edges is not None:
        header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
        body += np.asarray(edges, "<i4").tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + body


def _require_finite_positions(who: str, run: Frames, frames: list[int]) -> np.ndarray:
    """Positions at the frames `(frames, nodes, 3)`, all finite; a ValueError otherwise."""
    place = _pad_to_three(run.position[frames])
    non_finite = ~np.isfinite(place).all(axis=(0, 2))
    if non_finite.any():
        raise ValueError(
            f"{who}: got {non_finite.sum()} of {non_finite.size} lanes that blew up, first "
            f"{int(np.argmax(non_finite))}; expected finite positions. Leave them out, or write export.ply, which does."
        )
    return place


def _pad_to_three(position: np.ndarray) -> np.ndarray:
    """Positions `(..., dim)` with zeros for the components that are missing to three."""
    return np.pad(position.astype(float), [(0, 0)] * (position.ndim - 1) + [(0, 3 - position.shape[-1])])


def _check_morph_size(who: str, place: np.ndarray) -> None:
    """Raise a ValueError for more frames or bytes than a file of morph targets may have."""
    frames, nodes, _ = place.shape
    if frames > MAX_MORPH_TARGETS or 12 * frames * nodes > MAX_MORPH_BYTES:
        raise ValueError(
            f"{who}: got {frames} frames of {nodes} nodes, {12e-6 * frames * nodes:.3g} MB, expected at most {MAX_MORPH_TARGETS} "
            f"frames and {MAX_MORPH_BYTES / 1e6:.0f} MB of morph targets. Choose a lower fps=, a higher speed=, or export.ply."
        )


def _align_quaternion_signs(q: np.ndarray) -> np.ndarray:
    """Quaternions along the first axis, each with the sign that is closer to the one before it.

    q and -q are the same rotation, but between them a player would turn the long way round.
    """
    turned_back = np.sum(q[1:] * q[:-1], axis=-1) < 0
    sign = np.cumprod(np.where(turned_back, -1.0, 1.0), axis=0)
    return np.concatenate([q[:1], q[1:] * sign[..., None]])


def _to_rgb(color: "ColorType") -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(color)


def _track_progress(items: Iterable[T], progress: bool) -> Iterable[T]:
    return progress_bar(items, progress=progress, desc="writing", unit="frame", leave=False)


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
