"""Automatic smoothness: the strength of the smoothness term (`liftcore.solve.smooth`), chosen from two half lifts.

Every second view gives one lift, the other views another, both from the existing W. Each splat of each lift is named
by the nearest of 32 prototypes, which are clusters of all views' features. The names of lift a, smoothed with lambda,
are compared with the names of lift b, not smoothed, by their mutual information in bits per splat, where each splat
counts by the margin of its name in b::

    I(lambda) = sum_kl p_kl log2 (p_kl / (p_k p_l)),   p_kl ~ sum_j m_j^2 [k(x^a_j(lambda)) = k] [k(x^b_j) = l]
    m_j = (d'_j - d_j) / d'_j,   the distances of x^b_j from its nearest and its second prototype

averaged over both directions. Lambda grows from zero as long as the information does; the smallest lambda is chosen
whose information is within one standard error of the maximum. The standard error is that of the difference per splat,
as both are of the same splats. The reasons:

- **Names, not distances.** Most splats lie inside objects, where a mean over neighbours only removes noise. That
  moves them nearer to the other half while the few at edges move to another object, which a mean of distances does
  not show. A name changes at an edge; and in features that vary within objects names change everywhere, so smoothing
  loses there.
- **Information, not agreement.** The number of objects is unknown. If several prototypes lie in one object, the
  nearest of them is noise without information, and smoothing may change it freely.
- **Margins.** At edges rays mix the features of objects, in both halves alike. Without margins, corrections by
  smoothing would count as errors there.
- **Equal weight of splats.** Weighted by total weight, large objects in front would dominate small ones.

Lambda grows by factors of about 3, as results change little in between. Patches of the scene, SPLATS in all, are
used: the effect of lambda on a splat depends on its neighbourhood only.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.cores import cores
from liftcore.runtime.device import CPU
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.directions import region_totals
from liftcore.solve.reweight import scale_weights
from liftcore.solve.smooth import smooth_channels, smoothing_weights
from liftcore.solve.sums import sum_pieces
from liftcore.values.region_weights import RegionWeights

if TYPE_CHECKING:
    from liftcore.scene.neighbours import SplatGraph

STRENGTHS = (0.1, 0.3, 1.0, 4.0)  # candidates of lambda, ascending
CHANNELS = 16  # principal channels in which halves are compared
PROTOTYPES = 32
SPLATS = 1 << 16  # compared
SAMPLE = 1 << 14  # splats for prototypes, and regions for principal channels
ROUNDS = 10  # of Lloyd's algorithm
ROWS = 1 << 14  # of a table at a time


@dataclass(frozen=True)
class SmoothnessChoice:
    """The chosen strength, and the mutual information of the halves for each candidate."""

    smoothness: float  # lambda; zero if none improves, or it cannot be estimated
    information: dict[float, float]  # bits per splat by lambda, from zero on; empty without two halves

    def facts(self) -> list[dict[str, float]]:
        """Return a row of numbers for each lambda, for the diagnostics."""
        return [{"smoothness": strength, "information": bits} for strength, bits in self.information.items()]


@one_thread()
def choose_smoothness(
    W: RegionWeights,
    codebook: Codebook,
    graph: SplatGraph,
    confidence: Tensor | None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    threads: int | None = None,
) -> SmoothnessChoice:
    """Choose the lambda with the largest mutual information of two halves of the views.

    Args:
        W: of all views, as used by the solve, a row for each of the P splats, on the CPU. codebook: E, of its
            regions.
        graph: of the P splats. confidence: [P] f32, as for `liftcore.solve.smooth.smooth`.
        seed: of samples.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
    """
    graph = graph.patches(SPLATS)
    W = _rows_of(W, torch.from_numpy(graph.order).long())
    confidence = None if confidence is None else confidence[torch.from_numpy(graph.order).long()]
    rows = principal_channels(codebook, sum_pieces(region_totals(W, threads), (1, codebook.regions))[0])
    view = torch.repeat_interleave(W.offsets.diff())
    halves = [_Half.of(W, rows, view % 2 == half, threads) for half in (0, 1)]
    in_both = (halves[0].sums > 0) & (halves[1].sums > 0)
    if rows.shape[1] == 0 or not in_both.any():
        return SmoothnessChoice(0.0, {})
    mean = (
        sum(half.features * half.sums[:, None] for half in halves)
        / np.maximum(sum(half.sums for half in halves), np.finfo(np.float64).tiny)[:, None]
    )
    weights = np.where(in_both, halves[0].sums + halves[1].sums, 0.0)
    centres = prototypes(mean, weights, np.random.default_rng(seed))
    names = [nearest_prototypes(half.features, centres) for half in halves]
    names = [(nearest, np.where(in_both, margins**2, 0.0)) for nearest, margins in names]
    if not all(squares.any() for _, squares in names):  # also with a single prototype
        return SmoothnessChoice(0.0, {})

    def compare(features: Sequence[np.ndarray]) -> tuple[float, list[np.ndarray]]:
        pairs = zip(features, reversed(names), strict=True)
        results = [
            information(nearest_prototypes(smoothed_half, centres)[0], *other) for smoothed_half, other in pairs
        ]
        return float(np.mean([bits for bits, _ in results])), [splats for _, splats in results]

    smoothed = [half.features for half in halves]
    tries = {0.0: compare(smoothed)}
    supports = [smoothing_weights(torch.from_numpy(half.sums), confidence) for half in halves]
    with ThreadPoolExecutor(threads or cores()) as pool:
        for number, strength in enumerate(STRENGTHS):
            best = max(bits for bits, _ in tries.values())
            smoothed = [
                smooth_channels(graph, half.features, support, strength, pool)
                for half, support in zip(halves, supports, strict=True)
            ]
            progress("halves", number + 1, len(STRENGTHS), "lambdas")
            tries[strength] = compare(smoothed)
            if tries[strength][0] <= best:
                break
    progress("halves", len(STRENGTHS), len(STRENGTHS), "lambdas")
    highest, splats = max(tries.values(), key=lambda trial: trial[0])

    def is_as_good(bits: float, half_bits: list[np.ndarray]) -> bool:
        triples = zip(splats, half_bits, reversed(names), strict=True)
        errors = [standard_error(a - b, squares) for a, b, (_, squares) in triples]
        return highest - bits <= sum(errors) / len(errors)

    return SmoothnessChoice(
        min(strength for strength, trial in tries.items() if is_as_good(*trial)),
        {strength: bits for strength, (bits, _) in tries.items()},
    )


def _rows_of(W: RegionWeights, rows: Tensor) -> RegionWeights:
    """Return W of some splats [n] i64, a row each in their order, without total weight."""
    starts, entries = W.take(rows)
    none = W.total_weight_splats[:0], W.total_weight[:0]
    splats = torch.arange(len(rows), dtype=torch.int32)
    return RegionWeights(splats, starts, W.region[entries], W.weight[entries], *none, W.offsets)


@dataclass(frozen=True)
class _Half:
    """The lift of one half of the views, in a few channels."""

    features: np.ndarray  # [P, C] f32
    sums: np.ndarray  # [P] f64, of the rows of its W

    @classmethod
    def of(cls, W: RegionWeights, rows: Tensor, mask: Tensor, threads: int | None) -> _Half:
        """Solve from W's regions in the mask [M] bool, with the codebook rows [M, C] f32."""
        half = scale_weights(W, mask.float()[W.region.long()])
        features = solve(half, Codebook((ViewCodebook(rows),)), torch.float32, threads=threads).features
        return cls(features.numpy(), half.row_sums().numpy())


def principal_channels(codebook: Codebook, totals: np.ndarray) -> Tensor:
    """Project the regions' vectors on their CHANNELS principal axes, each region by its weight [M] f64.

    Returns:
        [M, C] f32, minus the mean, scaled to a largest deviation of one; C is zero if nothing varies.
    """
    step = -(-codebook.regions // SAMPLE)
    sample = torch.cat(
        [codebook.values(channels, CPU.place)[::step] for channels in codebook.slices()], dim=1
    ).double()
    shares = torch.from_numpy(totals[::step])
    shares = shares / shares.sum().clamp_min(1e-300)
    mean = shares @ sample
    sample -= mean
    values, axes = torch.linalg.eigh((sample * shares[:, None]).T @ sample)
    count = int((values > 1e-12 * values[-1].clamp_min(1e-300)).sum())
    count = min(CHANNELS, count) if bool(torch.isfinite(values).all()) else 0
    axes = axes[:, axes.shape[1] - count :] / values[-1].clamp_min(1e-300).sqrt()
    table = torch.zeros(codebook.regions, count, dtype=torch.float64)
    for channels in codebook.slices():
        part = codebook.values(channels, CPU.place)
        for begin in range(0, codebook.regions, ROWS):
            table[begin : begin + ROWS] += (part[begin : begin + ROWS].double() - mean[channels]) @ axes[channels]
    return table.float()


def prototypes(features: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return at most PROTOTYPES prototypes [K, C] f32, by k-means of a sample of features [P, C].

    Args:
        weights: [P] f64, odds of splats to be sampled; their sum is positive.
    """
    cumulative = np.cumsum(weights)
    draws = np.searchsorted(cumulative, rng.random(SAMPLE) * cumulative[-1], side="right")
    sample = features[np.minimum(draws, len(features) - 1)].astype(np.float64)
    centres = sample[:1]
    nearest = ((sample - centres[0]) ** 2).sum(axis=1)
    for _ in range(PROTOTYPES - 1):  # k-means++: odds by the distance to existing centres
        cumulative = np.cumsum(nearest)
        if cumulative[-1] <= 0:  # the sample has fewer distinct rows
            break
        next_one = min(int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right")), SAMPLE - 1)
        centres = np.concatenate([centres, sample[next_one : next_one + 1]])
        nearest = np.minimum(nearest, ((sample - sample[next_one]) ** 2).sum(axis=1))
    for _ in range(ROUNDS):
        labels = (np.square(centres).sum(axis=1) - 2 * sample @ centres.T).argmin(axis=1)
        counts = np.bincount(labels, minlength=len(centres))
        sums = np.stack([np.bincount(labels, channel, minlength=len(centres)) for channel in sample.T], axis=1)
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centres)
    return centres.astype(np.float32)


def nearest_prototypes(features: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest centre [P] i64 of each row of features [P, C], of centres [K, C], and margins m [P] f32 in
    0..1.
    """
    names, margins = np.empty(len(features), np.int64), np.zeros(len(features), np.float32)
    for begin in range(0, len(features), ROWS):
        rows = features[begin : begin + ROWS]
        squares = np.square(centres).sum(axis=1) - 2 * rows @ centres.T + np.square(rows).sum(axis=1)[:, None]
        names[begin : begin + ROWS] = squares.argmin(axis=1)
        if len(centres) == 1:
            continue
        first, second = np.sqrt(np.partition(squares, 1, axis=1)[:, :2].clip(0.0)).T
        np.divide(second - first, second, out=margins[begin : begin + ROWS], where=second > 0)
    return names, margins


def information(names: np.ndarray, other_names: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the mutual information of two names of each splat [P] i64, by weights [P] f64 with a positive sum.

    The bias of few splats in many pairs of names is corrected (Miller and Madow, 1955).

    Returns:
        Bits per splat, and those of each splat [P] f64, whose mean is the result before the correction.
    """
    pairs = names * PROTOTYPES + other_names
    joint = np.bincount(pairs, weights, minlength=PROTOTYPES**2).reshape(PROTOTYPES, -1) / weights.sum()
    splats = weights.sum() ** 2 / np.square(weights).sum()
    rows, columns, occurs = joint.sum(axis=1), joint.sum(axis=0), joint > 0
    bits = np.log2(np.divide(joint, np.outer(rows, columns), out=np.ones_like(joint), where=occurs))
    spare = np.count_nonzero(rows) + np.count_nonzero(columns) - np.count_nonzero(occurs) - 1
    return float((joint * bits).sum() + spare / (2 * splats * np.log(2))), bits.ravel()[pairs]


def standard_error(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the standard error of the mean of values [P] by weights [P], which are not counts."""
    shares = weights / weights.sum()
    return float(np.sqrt(np.square(shares * (values - shares @ values)).sum()))
