"""Contacts of solids in the plane: a dot at each point that touches, and arrows of the forces that bodies press with."""

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import lax

from physjax.physics.rigid.planar import find_planar_contacts
from physjax.physics.rigid.solids.contact import Solids
from physjax.show.frames import Frames
from physjax.show.panels import Scenery
from physjax.show.stage import build_stage
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

TOUCHING_SHARE = 1e-3
"""The widest gap across which a point is drawn as touching, as a share of the box around the run."""
ARROW_SHARE = 0.15
"""The most that the arrow of the largest force is long, as a share of that box."""
MIN_IMPULSE_SHARE = 1e-7
"""Impulses of a sub-step below this share of the largest momentum of the run are rounding."""
FORCE_COLOUR = "#D55E00"
FRAMES_PER_BATCH = 16
"""Frames of which the contacts are found at once: a bound on memory."""


class ContactMarks(NamedTuple):
    """What is drawn of contacts: of each frame points `(points, 2)` [m], and where forces `(forces, 2)` [N] begin.

    An arrow is as long as its force [N] over `newtons_per_metre`.
    """

    points: list[np.ndarray]
    starts: list[np.ndarray]
    forces: list[np.ndarray]
    newtons_per_metre: float

    def annotate(self, seen: Frames) -> Frames:
        """The frames with the scale in their titles, and the corners of a box around all arrows as two more nodes."""
        tips = np.full((len(seen.time), 2, 2), np.nan)
        for i, (start, force) in enumerate(zip(self.starts, self.forces, strict=True)):
            if len(start):
                ends = start + force / self.newtons_per_metre
                tips[i] = ends.min(axis=0), ends.max(axis=0)
        caption = f"arrows: {self.newtons_per_metre:g} N per metre" if np.isfinite(tips).any() else ""
        return seen._replace(position=np.concatenate([seen.position, tips], axis=1), caption=caption)

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes in the plane."""
        dots = ax.scatter(*self.points[frame].T, c="black", s=7, linewidths=0, zorder=6)
        look = {"angles": "xy", "scale_units": "xy", "units": "dots", "width": 1.6, "zorder": 5, "color": FORCE_COLOUR}
        ends = (*self.starts[frame].T, *self.forces[frame].T)
        return [dots, ax.quiver(*ends, scale=self.newtons_per_metre, **look)]


def find_contact_marks(who: str, film: Trajectory, seen: Frames) -> ContactMarks:
    """The contacts of all good frames of a run; a ValueError for a run without solids, or that does not know its step.

    A body pushes a surface, and a surface pushes back: of contacts with surfaces the force on the body is drawn, of those
    between bodies that on each.
    """
    scene = film.scene
    solids = [] if scene is None else [contact for contact in scene.contacts if isinstance(contact, Solids)]
    if not solids or film.dt is None:
        raise ValueError(
            f"{who}: got contacts=True for a run without rigid.Solids or without a step, expected one that simulate made of "
            "a scene with contacts=(rigid.Solids(...),). Leave contacts= out."
        )
    h = np.asarray(film.dt, float)[..., None, None, None] / solids[0].substeps
    size = build_stage(seen, range(seen.good_frames)).size or 1.0
    is_pair, points, gaps, is_point, impulses = (
        np.asarray(part)[: seen.good_frames] if part.ndim > 1 else np.asarray(part) for part in _find_over_frames(film)
    )
    forces = impulses.astype(float) / h
    fastest = float(np.abs(np.asarray(film.state.momentum)[: seen.good_frames]).max(initial=0.0))
    pressed = is_point & (np.abs(impulses).max(axis=-1) > MIN_IMPULSE_SHARE * fastest)
    touches = (is_point & (gaps <= TOUCHING_SHARE * size)) | pressed
    largest = float(np.hypot(*np.moveaxis(forces, -1, 0)).max(initial=0.0, where=pressed)) or 1.0
    pairs = pressed & is_pair[:, None]
    found = [
        (
            points[i][touches[i]],
            np.concatenate([points[i][pressed[i]], points[i][pairs[i]]]),
            np.concatenate([-forces[i][pressed[i]], forces[i][pairs[i]]]),
        )
        for i in range(len(points))
    ]
    marks, starts, drawn = ([frame[k] for frame in found] for k in range(3))
    return ContactMarks(marks, starts, drawn, _round_up(largest / (ARROW_SHARE * size)))


@jax.transfer_guard("allow")
def _find_over_frames(film: Trajectory) -> tuple[jax.Array | np.ndarray, ...]:
    """Whether contacts are of pairs; their points, gaps, which are there, and the impulses, with frames in front."""
    scene = film.scene
    assert scene is not None
    (number,) = (i for i, contact in enumerate(scene.contacts) if isinstance(contact, Solids))
    over_time = film.film
    memory = over_time.contacts[number]
    assert isinstance(memory, Solids)

    def find(frame: tuple) -> tuple:
        state, impulses, t = frame
        contacts = list(scene.contacts)
        contacts[number] = eqx.tree_at(lambda solids: solids.impulses, contacts[number], impulses)
        found = find_planar_contacts(scene.replace(state=state, contacts=tuple(contacts)), t)
        return found.points, found.gaps, found.is_point, found.impulses

    frames = over_time.state, memory.impulses, film.time
    found = jax.jit(lambda frames: lax.map(find, frames, batch_size=FRAMES_PER_BATCH))(frames)
    return find_planar_contacts(scene).second >= 0, *found


def _round_up(number: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is not below a number."""
    power = 10.0 ** np.floor(np.log10(number))
    return float(power * min(step for step in (1.0, 2.0, 5.0, 10.0) if step * power >= number * (1 - 1e-9)))
