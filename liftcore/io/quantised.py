"""What formats of quantised splats share: fields decoded in blocks, and how bytes say opacities, colours, rotations.

A reader gives the fields of `Splats` by their names: ``means`` [P, 3], ``quats`` [P, 4] (w x y z), ``log_scales``
[P, 3], ``opacity_logits`` [P] and ``sh`` [P, K, 3], all f32.
"""

from collections.abc import Callable, Mapping

import numpy as np

BLOCK_ROWS = 1 << 16  # splats decoded at a time
LEAST_ALPHA = 1e-6  # bytes say an opacity of 0 or 1 where the trained one was near: its logit stays finite
MOST_GROWTH = 100  # decoded bytes for a byte of a compressed file: real scenes have 2 to 10

Fields = dict[str, np.ndarray]


def decoded(count: int, shapes: Mapping[str, tuple[int, ...]], decode: Callable[[slice], Fields]) -> Fields:
    """Fields of ``count`` splats, decoded a block of rows at a time, so that memory stays near what they take.

    Args:
        count: P. shapes: field -> its shape behind P.
        decode: rows -> those fields of these rows.
    """
    fields = {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float32 is infinite, and refused as such
        for first in range(0, count, BLOCK_ROWS):
            rows = slice(first, min(first + BLOCK_ROWS, count))
            for name, values in decode(rows).items():
                fields[name][rows] = values
    return fields


def field_shapes(sh_rows: int) -> dict[str, tuple[int, ...]]:
    """The fields of splats with K rows of harmonics, none of which are read where K is 0."""
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": ()}
    return shapes | ({"sh": (sh_rows, 3)} if sh_rows else {})


def logits(alpha: np.ndarray) -> np.ndarray:
    """The logits of opacities in 0..1, kept LEAST_ALPHA off both ends."""
    alpha = np.clip(np.asarray(alpha, np.float64), LEAST_ALPHA, 1 - LEAST_ALPHA)
    return np.log(alpha / (1 - alpha))


def smallest_three(parts: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """[n, 4]: unit quaternions of three of their parts, the others in their order, and which one was left out.

    Args:
        parts: [n, 3]. largest: [n] of 0..3, the place of the part that is not among them; it is not negative.
    """
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    quats = np.empty((len(parts), 4))
    np.put_along_axis(quats, places, parts, axis=1)
    left = np.sqrt(np.maximum(0.0, 1 - (parts**2).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], left[:, None], axis=1)
    return quats
