"""Rotations as quaternions."""

import numpy as np


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] f64, whose columns are turned axes, of w x y z [..., 4] of any length; 0: identity."""
    quats = np.asarray(quats, np.float64)
    largest = np.abs(quats).max(axis=-1, keepdims=True)  # first by this: squares of the largest would overflow
    quats = np.where(largest > 0, quats / np.where(largest > 0, largest, 1.0), [1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    return np.stack([np.stack(row, axis=-1) for row in rotation_rows(w, x, y, z)], axis=-2)


def rotation_rows(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[tuple[np.ndarray, ...], ...]:
    """The three rows of the rotations of unit quaternions, each number by the shape of w."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def product_matrix(rotation: np.ndarray) -> np.ndarray:
    """[4, 4] f64: what a quaternion w x y z is multiplied by to turn its splat by ``rotation`` [3, 3], too."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
