"""Features from elsewhere, as NumPy files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.io.npy import open_npy
from liftcore.query.example import Vector

if TYPE_CHECKING:
    from pathlib import Path


def read_vector(path: Path) -> Vector:
    """The vector of a ``.npy`` file, [F] or [1, F] of any number type.

    Raises:
        InvalidFeatures: no such file, or no array of numbers in it; a pickle is never opened.
        InvalidQuery: the array is no vector.
    """
    values = open_npy(path)
    if values.shape not in ((values.size,), (1, values.size)):
        raise InvalidQuery(str(path), expected="one vector, [F] or [1, F]", got=f"the shape {list(values.shape)}")
    return Vector(tuple(values.reshape(-1).astype(np.float64).tolist()))
