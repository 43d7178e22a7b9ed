"""Inertia tensors on the host, in double precision: shifted, rotated and diagonalised before anything is compiled."""

from collections.abc import Sequence

import numpy as np
from jax.typing import ArrayLike
from numpy.linalg import eigh

from physjax.checks import concrete_or_none


def read_on_host(name: str, *values: ArrayLike | Sequence) -> list[np.ndarray]:
    """The values in double precision; a TypeError where one is being traced."""
    arrays = []
    for value in values:
        array = concrete_or_none(value)
        if array is None:
            raise TypeError(
                f"{name}: is being traced, but a full tensor is diagonalised before compiling. Build it outside, or give "
                "principal moments and axes."
            )
        arrays.append(array.astype(float))
    return arrays


def shift_inertia(mass: np.ndarray, away: np.ndarray) -> np.ndarray:
    """The parallel-axis theorem, m (|d|² 1 - d dᵀ): what a mass [kg] adds at a distance d [m] from the axes."""
    square = np.sum(away * away, axis=-1)[..., None, None] * np.eye(3)
    return mass[..., None, None] * (square - away[..., :, None] * away[..., None, :])


def turn_tensor(q: np.ndarray, tensor: np.ndarray) -> np.ndarray:
    """R T Rᵀ: a tensor in the frame that the unit quaternion q rotates into."""
    matrix = rotation_matrix(q)
    half = np.sum(matrix[..., :, :, None] * tensor[..., None, :, :], axis=-2)
    return np.sum(half[..., :, None, :] * matrix[..., None, :, :], axis=-1)


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix of a unit quaternion."""
    w, (x, y, z) = q[..., 0], np.moveaxis(q[..., 1:], -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def find_quaternion(matrix: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix, as an eigenvector: accurate for every angle (I. Bar-Itzhack 2000)."""
    # the largest eigenvalue of a symmetric 4 x 4 matrix belongs to the quaternion; formulas by the trace lose digits
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
    odd = matrix - np.swapaxes(matrix, -2, -1)
    first = np.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]], axis=-1)
    lower = matrix + np.swapaxes(matrix, -2, -1) - trace * np.eye(3)
    top = np.concatenate([trace, first[..., None, :]], axis=-1)
    return eigh(np.concatenate([top, np.concatenate([first[..., None], lower], axis=-1)], axis=-2))[1][..., -1]


def demand_closed(faces: np.ndarray) -> None:
    """Raise a ValueError unless each directed edge of a face is an edge of exactly one other face, backwards."""
    sides = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    found, counts = np.unique(sides, axis=0, return_counts=True)
    backwards = {tuple(side[::-1]) for side in found.tolist()}
    bad = [
        side for side, count in zip(found.tolist(), counts, strict=True) if count > 1 or tuple(side) not in backwards
    ]
    if bad:
        raise ValueError(
            f"mesh: {len(bad)} of {len(found)} edges, first that from vertex {bad[0][0]} to {bad[0][1]}, have no face on "
            "the other side with the same orientation; expected a closed surface. Close it (meshes.weld "
            "joins coincident vertices), or orient its faces alike."
        )
