"""How well every splat answers a query: cosine to its positives, less where a negative is as near.

Lifted rows are sums of unit vectors and not unit themselves, so their norms divide every score. The norms
belong to the lift and not to the text: they are computed once and passed in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidQuery
from liftcore.query.products import cosines_of

if TYPE_CHECKING:
    from torch import Tensor

DEFAULT_NEGATIVES = ("object", "things", "stuff", "texture")  # LangSplat's canonical phrases
_BLOCK, _BLOCK_FLOATS = 16_384, 1 << 25  # rows widened at once, and numbers in them
# An example's score is 1 for the same and 0 for what the scene is on the whole; words have no such scale.
LEAST_LIKENESS = 0.4  # of an example, below which the automatic threshold is not sought
LEAST_OFFSET = 1e-3  # from the mean, of unit features: what is nearer has no direction that float16 could tell
RELEVANCY_SHARPNESS = 10.0  # the softmax's inverse temperature in LERF and LangSplat


def cosines(features: Tensor, norms: Tensor, texts: Tensor) -> Tensor:
    """Cosine to several texts in one pass over the features.

    Args:
        features: [P, F] f16 or f32.
        norms: [P] f32, from `norms_of`.
        texts: [n, F] f32, rows of any length above zero.

    Returns:
        [P, n] f32 in [-1, 1]; a zero row scores -1.

    Raises:
        InvalidQuery: a text's vector has another length than the features, is zero or is not finite.
    """
    return cosines_of(features, norms, _unit_rows(texts, features.shape[1]))


def rows_at_a_time(channels: int) -> int:
    """How many rows of features are widened to float32 at once."""
    return max(1, min(_BLOCK, _BLOCK_FLOATS // channels))


def mean_direction(features: Tensor, norms: Tensor, weights: Tensor) -> Tensor:
    """The weighted mean of the unit rows, [F] f32; of zero rows and weights nothing but zeros.

    Args:
        features: [P, F] f16 or f32. norms: [P] f32, from `norms_of`. weights: [P] f32, at least zero.
    """
    shares = torch.where(norms > 0, weights.double() / norms.clamp_min(1e-30).double(), 0.0)
    total = torch.zeros(features.shape[1], dtype=torch.float64)
    at_a_time = rows_at_a_time(features.shape[1])
    for first in range(0, features.shape[0], at_a_time):
        block = slice(first, first + at_a_time)
        total += (features[block].to(torch.float32) * shares[block, None].to(torch.float32)).sum(dim=0).double()
    weight = float(weights[norms > 0].double().sum())
    return (total / weight if weight > 0 else total).to(torch.float32)


def cosines_about(features: Tensor, norms: Tensor, mean: Tensor, examples: Tensor) -> Tensor:
    """Cosine to examples as seen from the scene's mean feature, ``cos(x_j / |x_j| - mean, e - mean)``.

    Image features lie in a narrow cone: what they share says nothing about this thing or that, and drowns what
    tells them apart. Words lie in another cone, so they are compared by plain cosines.

    Args:
        features: [P, F] f16 or f32. norms: [P] f32, from `norms_of`.
        mean: [F] f32, the mean of the unit features, of length below one.
        examples: [n, F] f32, unit rows.

    Returns:
        [P, n] f32 in [-1, 1]; 0 for a splat or an example that is the mean.
    """
    length = float(torch.linalg.vector_norm(mean))
    offsets = examples - mean
    reaches = torch.linalg.vector_norm(offsets, dim=1)
    # One pass gives <x, e - mean> and <x, mean>, and these give all: |x - mean|^2 = 1 - 2 <x, mean> + |mean|^2.
    rows = torch.cat([offsets, mean[None]]) / torch.cat([reaches, torch.tensor([length])]).clamp_min(1e-12)[:, None]
    along = cosines_of(features, norms, rows)
    products = along[:, :-1] * reaches - offsets @ mean
    distances = (1 - 2 * length * along[:, -1:] + length**2).clamp_min(0.0).sqrt()
    known = (distances > LEAST_OFFSET) & (reaches > LEAST_OFFSET)
    scale = (distances * reaches).clamp_min(LEAST_OFFSET**2)
    return torch.where(known, (products / scale).clamp(-1.0, 1.0), 0.0)


def combine(similarities: Tensor, positives: int) -> Tensor:
    """One score a splat from its cosines to all terms of a query.

    Without negatives it is the cosine to the nearest positive, and with negatives that cosine times the relevancy:

        s_j = max_p cos(x_j, p)
        s_j = max_p cos(x_j, p) sigmoid(10 (max_p cos(x_j, p) - max_n cos(x_j, n)))

    Relevancy alone asks which of the two a splat is nearer to, and a wall may be nearer to an apple than to a table
    without being like either: negatives must take away from what is found, not add to it. The largest and not the
    mean cosine counts, so that positives may be different things; cosines to words and to examples differ in scale
    (CLIP's words lie apart from its images), so among both the examples decide.

    Args:
        similarities: [P, n] f32, cosines to the positives, then to the negatives; plain for words, and about the
            scene's mean for examples (`cosines_about`).
        positives: how many of the n are positives, at least one.

    Returns:
        [P] f32 in -1..1.
    """
    nearest = similarities[:, :positives].amax(dim=1)
    return nearest if similarities.shape[1] == positives else nearest * relevancy(similarities, positives)


def relevancy(similarities: Tensor, positives: int) -> Tensor:
    """LERF's and LangSplat's ``min_n softmax(10 [cos p, cos n])_0``, p the nearest positive: [P] f32 in 0..1.

    Above 0.5 a splat is nearer to what is wanted than to anything unwanted.

    Args:
        similarities: [P, n] f32, cosines to the positives, then to the negatives, at least one of either.
        positives: how many of the n are positives.
    """
    nearest, against = similarities[:, :positives].amax(dim=1), similarities[:, positives:].amax(dim=1)
    return torch.sigmoid(RELEVANCY_SHARPNESS * (nearest - against))


def _unit_rows(texts: Tensor, channels: int) -> Tensor:
    if texts.ndim != 2 or texts.shape[1] != channels:
        raise InvalidQuery(
            "text vector", expected=f"{channels} channels, as the lift has", got=f"{texts.shape[-1]} channels"
        )
    wide = texts.to(torch.float32)
    lengths = torch.linalg.vector_norm(wide, dim=1, keepdim=True)
    if not bool(torch.isfinite(lengths).all()) or bool((lengths == 0).any()):
        raise InvalidQuery("text vector", expected="a finite vector with a direction", got="zero, NaN or infinity")
    return wide / lengths
