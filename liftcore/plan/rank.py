"""How many channels really carry the codebooks: the rank of a sample of their rows, by a Gram matrix in float64."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.solve.principal_axes import one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.features.pack import FeaturePacks

ROWS = 1_024  # sampled at most, as an eigenvalue problem of this size takes a third of a second
VIEWS = 16  # that they are taken from at most
ROUNDING = {"F16": 2.0**-11, "BF16": 2.0**-8, "F32": 2.0**-24}  # relative steps: below them is what storing left
ENOUGH = 0.99  # of the squares, which the fewer channels hold


@dataclass(frozen=True)
class Rank:
    """What a sample of codebook rows spans."""

    channels: int  # F
    rows: int  # sampled
    rank: int  # directions above the rounding of the stored values; min(rows, channels) says nothing beyond
    enough: int  # principal directions that hold ENOUGH of the squares


def codebook_rank(packs: FeaturePacks, views: Sequence[str]) -> Rank:
    """The rank of what ``sample_rows`` gives of evenly spaced views, above the coarsest rounding among them."""
    places = np.linspace(0, len(views) - 1, min(VIEWS, len(views))).astype(int)
    chosen = [views[int(place)] for place in places]
    parts = [packs.sample_rows(view, ROWS // len(chosen)) for view in chosen]
    sample = np.concatenate([part.double().numpy() for part in parts])
    sample = np.nan_to_num(sample, nan=0.0, posinf=0.0, neginf=0.0)  # refused when the lift reads them
    dtypes = {spec.dtype for view in chosen for part, spec in packs.specs(view).items() if part != "labels"}
    return rank_of(sample, max(ROUNDING[dtype] for dtype in dtypes))


def rank_of(rows: np.ndarray, rounding: float) -> Rank:
    """The rank of rows [n, F] f64 whose entries were rounded by so much of their size.

    Eigenvalues of the Gram matrix are squared singular values. Independent errors of relative size ``rounding`` add
    at most about ``(sqrt(n) + sqrt(F))^2 rounding^2 mean(x^2)`` to each: what is above that is signal.
    """
    count, channels = rows.shape
    longest = float(np.abs(rows).max(initial=0.0))
    if longest == 0:
        return Rank(channels, count, 0, 0)
    scaled = rows / longest
    with one_blas_thread():
        gram = scaled @ scaled.T if count < channels else scaled.T @ scaled
        values = np.linalg.eigvalsh(gram)[::-1].clip(0.0)
    noise = (np.sqrt(count) + np.sqrt(channels)) ** 2 * rounding**2 * float((scaled**2).mean())
    noise = max(
        noise, max(count, channels) * float(np.finfo(np.float64).eps * values[0])
    )  # the solver's own rounding
    held = np.cumsum(values) / values.sum()
    return Rank(channels, count, int((values > noise).sum()), int(np.searchsorted(held, ENOUGH)) + 1)
