"""Corners of convex polygons, checked."""

import numpy as np
from jaxtyping import Array

from physjax.checks import concrete_or_none

MAX_CORNERS = 12
"""Most corners of a polygon: every edge of one body is held against every corner of the other."""
STRAIGHT_SHARE = 1e-6
"""Share of the product of two neighbouring edges below which the corner between them is none."""


def demand_convex_corners(corners: Array) -> None:
    """Raise a ValueError unless `(corners, 2)` are the corners of a convex polygon, anticlockwise."""
    if corners.ndim != 2 or corners.shape[-1] != 2 or not 3 <= len(corners) <= MAX_CORNERS:
        raise ValueError(f"corners [m]: got the shape {corners.shape}, expected (corners, 2) with 3 to {MAX_CORNERS}.")
    values = concrete_or_none(corners)
    if values is None:
        return
    edges = np.roll(values, -1, axis=0) - values
    after = np.roll(edges, -1, axis=0)
    turn = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    lengths = np.hypot(*edges.T) * np.hypot(*after.T)
    once_round = abs(np.sum(np.arctan2(turn, np.sum(edges * after, axis=-1))) - 2 * np.pi) < 1e-3
    if not (turn > STRAIGHT_SHARE * lengths).all() or not once_round:
        raise ValueError(
            f"corners [m]: got {values.tolist()}, expected those of a convex polygon, anticlockwise, without corners on "
            "straight edges. A body that is not convex is several bodies."
        )


__all__ = ["MAX_CORNERS", "demand_convex_corners"]
