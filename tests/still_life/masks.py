"""Region maps of the still life, with the mistakes that real segmenters and encoders make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.scene.compositing import CompositingParams
from liftcore.values.views import NO_LABEL, Regions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.random import Generator

    from liftcore.raster.base import Raster
    from liftcore.text import TextEncoder
    from tests.still_life.scene import StillLife

LEAST_ROW_SUM = 0.5  # a ray below it has no true label
LEAST_REGION = 25  # pixels; SAM drops smaller masks, and so do we


@dataclass(frozen=True)
class Mistakes:
    """Frequencies and sizes of mistakes in masks. Shares are of a view's regions unless noted otherwise."""

    merged: float = 0.12  # one mask with a neighbour's, one vector between both
    split: float = 0.08  # cut in two by a line
    misnamed: float = 0.05  # another word of the scene
    unlabelled: float = 0.03  # of the pixels
    displacement: float = 1.5  # pixels, standard deviation of the boundaries' waver
    noise: float = 0.35  # length of the noise on a unit vector


def true_labels(scene: StillLife, raster: Raster, view: str) -> np.ndarray:
    """Return the labels of each ray: [2, H, W] i32, objects and parts; -1 where the ray misses the scene."""
    onehot = torch.nn.functional.one_hot(torch.from_numpy(scene.splat_parts).long(), len(scene.parts))
    sums = raster.render(scene.cameras[view], onehot.to(torch.float32), CompositingParams()).numpy()
    owner = np.array(scene.object_of_part)
    object_weights = np.zeros((*sums.shape[:2], len(scene.objects)), np.float32)
    for part, object_row in enumerate(owner):
        object_weights[:, :, object_row] += sums[:, :, part]
    labels = np.stack([object_weights.argmax(axis=2), sums.argmax(axis=2)]).astype(np.int32)
    labels[:, sums.sum(axis=2) < LEAST_ROW_SUM] = NO_LABEL
    return labels


def observe(
    scene: StillLife, raster: Raster, encoder: TextEncoder, mistakes: Mistakes, seed: int
) -> Mapping[str, Regions]:
    """Region maps of all views that are not held out: two levels, objects and parts, with mistakes.

    Args:
        scene: the still life.
        raster: A for its splats.
        encoder: gives the words their vectors.
        mistakes: how wrong the masks are.
        seed: of the mistakes.
    """
    rng = np.random.default_rng(seed)
    vectors = (encoder.encode(scene.objects), encoder.encode(scene.parts))
    observed = {}
    for camera in scene.cameras.values():
        if camera.name in scene.held_out:
            continue
        levels = true_labels(scene, raster, camera.name)
        observed[camera.name] = _stack(
            [_mistaken(level, words, mistakes, rng) for level, words in zip(levels, vectors, strict=True)]
        )
    return observed


def mistaken_regions(exact: Regions, mistakes: Mistakes, rng: Generator) -> Regions:
    """The exact masks of a view with mistakes in them; rows of the codebook are what their levels show."""
    words = exact.codebook.float().numpy()
    return _stack([_mistaken(level.numpy().astype(np.int32), words, mistakes, rng) for level in exact.labels])


def _stack(levels: Sequence[tuple[np.ndarray, np.ndarray]]) -> Regions:
    labels, codebook, rows = [], [], 0
    for level, vectors in levels:
        labels.append(np.where(level >= 0, level + rows, NO_LABEL))
        codebook.append(vectors)
        rows += len(vectors)
    return Regions(
        labels=torch.from_numpy(np.stack(labels).astype(np.int32)),
        codebook=torch.from_numpy(np.concatenate(codebook)).to(torch.float16),
    )


def _mistaken(
    level: np.ndarray, words: np.ndarray, mistakes: Mistakes, rng: Generator
) -> tuple[np.ndarray, np.ndarray]:
    """One level of one view -> labels [H, W] (rows of its own codebook) and that codebook [M, F] f32."""
    level = _waver(level, mistakes.displacement, rng)
    regions, pieces = [], np.full(level.shape, NO_LABEL, np.int32)
    present = [int(word) for word in np.unique(level) if word >= 0 and (level == word).sum() >= LEAST_REGION]
    for word in present:
        mask, vector = level == word, words[word]
        draw = rng.random()
        if draw < mistakes.merged:
            other = _neighbour(level, word, rng)
            if other is not None:
                # The mask spills over its neighbour: both areas carry the mixture, as one SAM mask would.
                mask, vector = mask | (level == other), 0.5 * (vector + words[other])
        elif draw < mistakes.merged + mistakes.split:
            mask, rest = _cut(mask, rng)
            pieces[rest] = len(regions)
            regions.append(vector)
        elif draw < mistakes.merged + mistakes.split + mistakes.misnamed:
            vector = words[int(rng.choice(present))]
        pieces[mask] = len(regions)
        regions.append(vector)
    pieces[_smooth_noise(level.shape, 8, rng) < _quantile_of_normal(mistakes.unlabelled)] = NO_LABEL
    codebook = np.stack(regions) if regions else np.zeros((1, words.shape[1]), np.float32)
    noise = rng.standard_normal(codebook.shape)
    noise *= mistakes.noise / np.linalg.norm(noise, axis=1, keepdims=True)
    noisy = codebook + noise
    return pieces, (noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).astype(np.float32)


def _waver(level: np.ndarray, deviation: float, rng: Generator) -> np.ndarray:
    """Labels read at places that a slow random field displaces: boundaries waver by a few pixels."""
    height, width = level.shape
    rows, columns = np.mgrid[:height, :width]
    down, right = (deviation * _smooth_noise(level.shape, 12, rng) for _ in range(2))
    y = np.clip(np.rint(rows + down), 0, height - 1).astype(int)
    x = np.clip(np.rint(columns + right), 0, width - 1).astype(int)
    return level[y, x]


def _smooth_noise(shape: tuple[int, ...], scale: int, rng: Generator) -> np.ndarray:
    """Unit-variance noise whose bumps are about ``scale`` pixels wide."""
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(rng.standard_normal(shape), scale, mode="wrap")
    return field / field.std()


def _quantile_of_normal(share: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(share))


def _neighbour(level: np.ndarray, word: int, rng: Generator) -> int | None:
    """A region that touches this one; small ones are likelier than the room around."""
    from scipy.ndimage import binary_dilation

    ring = binary_dilation(level == word, iterations=3) & (level != word) & (level >= 0)
    near = np.unique(level[ring])
    if len(near) == 0:
        return None
    odds = np.array([1.0 / np.sqrt((level == other).sum()) for other in near])
    return int(rng.choice(near, p=odds / odds.sum()))


def _cut(mask: np.ndarray, rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """A mask in two, by a line through its middle."""
    rows, columns = np.nonzero(mask)
    angle = rng.uniform(0, np.pi)
    side = np.zeros(mask.shape, bool)
    along = (rows - np.median(rows)) * np.sin(angle) + (columns - np.median(columns)) * np.cos(angle)
    side[rows, columns] = along > 0
    return mask & ~side, side
