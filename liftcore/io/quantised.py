"""Shared parts of quantised splat formats: fields decoded in blocks, and opacities, colours and rotations as bytes.

A reader returns the fields of `Splats` by their names: ``means`` [P, 3], f64 if they are decoded so, and f32
``quats`` [P, 4] (w x y z), ``log_scales`` [P, 3], ``opacity_logits`` [P] and ``sh`` [P, K, 3]. A writer takes any
splats as 3D Gaussians (`gaussian_rows`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.scene.harmonics import SH_C0, constant_terms, rotate_bands
from liftcore.scene.origin import LARGEST_SCALE
from liftcore.scene.quaternions import product_matrix

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

BLOCK_ROWS = 1 << 16  # splats decoded at a time
LEAST_ALPHA = 1e-6  # a byte of 0 or 255 stands for an opacity near 0 or 1: its logit stays finite
MOST_GROWTH = 100  # decoded bytes for a byte of a compressed file: real scenes have 2 to 10
GREY = 0.6  # of splats that have no colours
THIN = 0.01  # of a disc's smaller scale: the thickness that it is shown with
REST_INDICES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # indices of a quaternion without each one
MOST_SH_ROWS = 16  # of what other formats hold: degree 3

Fields = dict[str, Any]  # arguments of `Splats` by their names


def decoded(count: int, decode: Callable[[slice], Fields]) -> Fields:
    """Decode the fields of P = ``count`` splats a block of rows at a time: memory stays near their size."""
    fields: Fields = {}
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 are infinite, and refused as such
        for first in range(0, count, BLOCK_ROWS):
            rows = slice(first, min(first + BLOCK_ROWS, count))
            for name, values in decode(rows).items():
                if name not in fields:
                    dtype = np.float64 if name == "means" and values.dtype == np.float64 else np.float32
                    fields[name] = np.empty((count, *values.shape[1:]), dtype)
                fields[name][rows] = values
    return fields


def logits(alpha: np.ndarray) -> np.ndarray:
    """Return the logits of opacities in 0..1, clipped to LEAST_ALPHA from both ends."""
    alpha = np.clip(np.asarray(alpha, np.float64), LEAST_ALPHA, 1 - LEAST_ALPHA)
    return np.log(alpha / (1 - alpha))


def smallest_three(parts: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Complete unit quaternions [n, 4] from parts [n, 3], in order, and the index [n] of the largest, positive."""
    places = REST_INDICES[largest]
    quats = np.empty((len(parts), 4))
    np.put_along_axis(quats, places, parts, axis=1)
    remaining = np.sqrt(np.maximum(0.0, 1 - (parts**2).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], remaining[:, None], axis=1)
    return quats


@dataclass(frozen=True)
class GaussianRows:
    """A block of splats after activation."""

    means: np.ndarray  # [n, 3] f32, about the splats' origin
    scales: np.ndarray  # [n, 3] f32, above zero or zero
    quats: np.ndarray  # [n, 4] f64, unit, w x y z
    opacities: np.ndarray  # [n] f32 in 0..1
    colours: np.ndarray  # [n, 3] f32, the constant ones, mostly in 0..1
    sh: np.ndarray  # [n, K - 1, 3] f32, the higher harmonics


def gaussian_rows(splats: Splats) -> Iterator[GaussianRows]:
    """Yield the splats as 3D Gaussians, in their order, a block at a time.

    A disc (2DGS) becomes a thin one, and a DBS kernel ``(1 - r^2)^beta`` the one of its variance in the image,
    ``1 / (2 (beta + 2))``. Splats without colours are grey; lobes of DBS are left out.
    """

    def array(values: Any) -> Any:
        return None if values is None else values.detach().cpu().numpy()

    fields = (splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.beta, splats.sh)
    means, scales, quats, logits, betas, sh = map(array, fields)
    for first in range(0, len(means), BLOCK_ROWS):
        block = slice(first, first + BLOCK_ROWS)
        size = np.exp(scales[block].clip(-LARGEST_SCALE, LARGEST_SCALE))
        if size.shape[1] == 2:
            size = np.concatenate([size, THIN * size.min(axis=1, keepdims=True)], axis=1)
        if betas is not None:
            beta = 4 * np.exp(betas[block].clip(-LARGEST_SCALE, LARGEST_SCALE))
            size = size / np.sqrt(2 * (beta + 2))[:, None]
        length = np.linalg.norm(quats[block].astype(np.float64), axis=1, keepdims=True)
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-logits[block]))
        yield GaussianRows(
            means=means[block],
            scales=size,
            quats=np.where(length > 0, quats[block] / np.where(length > 0, length, 1.0), (1.0, 0.0, 0.0, 0.0)),
            opacities=opacities,
            colours=np.full((len(size), 3), GREY, "f4") if sh is None else 0.5 + SH_C0 * sh[block, 0],
            sh=np.zeros((len(size), 0, 3), "f4") if sh is None else sh[block, 1:],
        )


def gaussians_in(splats: Splats, axes: np.ndarray) -> GaussianRows:
    """Return all splats as 3D Gaussians in another frame, with x y z w and harmonics of degree 0 to 3 in ``sh``.

    ``axes`` [3, 3] f64, 1 and -1 on its diagonal, lead from the frame of PLYs and cameras to that one.
    """
    blocks = list(gaussian_rows(splats))
    means, scales, quats, opacities, colours = (
        np.concatenate([getattr(block, name) for block in blocks])
        for name in ("means", "scales", "quats", "opacities", "colours")
    )
    sh = constant_terms(colours)[:, None] if splats.sh is None else splats.sh.cpu().numpy()[:, :MOST_SH_ROWS]
    return GaussianRows(
        means=(means * np.diag(axes)).astype("<f4"),
        scales=scales.astype("<f4"),
        quats=np.roll(quats @ product_matrix(axes).T, -1, axis=1).astype("<f4"),
        opacities=opacities.astype("<f4"),
        colours=colours,
        sh=rotate_bands(np.array(sh), axes).astype("<f4"),
    )
