"""How smooth a scene is: the strength of the smoothness term (`liftcore.solve.smooth`), chosen from two lifts.

Every second view gives one lift, the views between them another, both from the W that is there. Each splat of each
lift is named by the nearest of 32 prototypes, which are clusters of all views' features. The names of one lift a,
smoothed with a lambda, tell something of the names of the other, b, which is not smoothed: their mutual information,
in bits a splat, where each splat counts once, by how clearly b names it::

    I(lambda) = sum_kl p_kl log2 (p_kl / (p_k p_l)),   p_kl ~ sum_j m_j^2 [k(x^a_j(lambda)) = k] [k(x^b_j) = l]
    m_j = (d'_j - d_j) / d'_j,   the distances of x^b_j from its nearest and its second prototype

and the mean of both directions. From zero on, lambda grows as long as the information does; of these lambdas the
least is taken whose information is less than the most by no more than a standard error of their difference. Both are
of the same splats, so it is the difference splat by splat that says how sure it is. The reasons:

- **Names, not distances.** Most splats lie inside things, where a mean over neighbours only takes noise away. That
  moves them nearer to the other half while the few at edges go over to another thing, and a mean of distances does
  not see those. A name changes at an edge; and in a field that varies within things names change everywhere, so that
  smoothing loses there.
- **Information, not agreement.** How many things there are is not known. Where several prototypes lie in one thing,
  which of them is the nearest is noise, and tells nothing: smoothing may change it freely.
- **By how clearly.** At edges rays mix what they meet, in both halves alike. What smoothing puts right there would
  count against it.
- **Each splat once.** By total weight, large things in front would decide for small ones.

Lambda grows by steps of about 3, between which figures change little. Patches of the scene, SPLATS in all, stand for
it: what a lambda does to a splat, its neighbourhood decides.
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
from liftcore.solve.reweight import reweighted
from liftcore.solve.smooth import smooth_channels, smoothing_weights
from liftcore.solve.sums import added
from liftcore.values.region_weights import RegionWeights

if TYPE_CHECKING:
    from liftcore.scene.neighbours import SplatGraph

STRENGTHS = (0.1, 0.3, 1.0, 4.0)  # lambdas that are tried, ascending
CHANNELS = 16  # principal ones, in which halves are compared
PROTOTYPES = 32
SPLATS = 1 << 16  # that are compared
SAMPLE = 1 << 14  # splats that make prototypes, and regions that say which channels are principal
ROUNDS = 10  # of Lloyd's algorithm
ROWS = 1 << 14  # of a table at a time


@dataclass(frozen=True)
class SmoothnessChoice:
    """The strength that a scene asks for, and what one half of the views tells of the other with each."""

    smoothness: float  # lambda; zero where none gains, or there is nothing to tell it by
    information: dict[float, float]  # bits a splat by lambda, from zero on; empty where there are no two halves

    def facts(self) -> list[dict[str, float]]:
        """Plain numbers for the diagnostics, a row for each lambda."""
        return [{"smoothness": one, "information": bits} for one, bits in self.information.items()]


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
    """Find the lambda with which one half of the views tells most of the other.

    Args:
        W: of all views as it is solved, a row for each of the P splats, on the CPU. codebook: E, of its regions.
        graph: of the P splats. confidence: [P] f32, as `liftcore.solve.smooth.smooth` has it.
        seed: of samples.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    graph = graph.patches(SPLATS)
    W = _rows_of(W, torch.from_numpy(graph.order).long())
    confidence = None if confidence is None else confidence[torch.from_numpy(graph.order).long()]
    rows = principal_channels(codebook, added(region_totals(W, threads), (1, codebook.regions))[0])
    view = torch.repeat_interleave(W.offsets.diff())
    halves = [_Half.of(W, rows, view % 2 == half, threads) for half in (0, 1)]
    judged = (halves[0].sums > 0) & (halves[1].sums > 0)
    if rows.shape[1] == 0 or not judged.any():
        return SmoothnessChoice(0.0, {})
    whole = (
        sum(half.features * half.sums[:, None] for half in halves)
        / np.maximum(sum(half.sums for half in halves), np.finfo(np.float64).tiny)[:, None]
    )
    weights = np.where(judged, halves[0].sums + halves[1].sums, 0.0)
    centres = prototypes(whole, weights, np.random.default_rng(seed))
    names = [nearest_prototypes(half.features, centres) for half in halves]
    names = [(nearest, np.where(judged, margins**2, 0.0)) for nearest, margins in names]
    if not all(squares.any() for _, squares in names):  # of one prototype alone, too
        return SmoothnessChoice(0.0, {})

    def compare(features: Sequence[np.ndarray]) -> tuple[float, list[np.ndarray]]:
        others = zip(features, reversed(names), strict=True)
        both = [information(nearest_prototypes(own, centres)[0], *other) for own, other in others]
        return float(np.mean([bits for bits, _ in both])), [splats for _, splats in both]

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
    most, splats = max(tries.values(), key=lambda one: one[0])

    def is_as_good(bits: float, own: list[np.ndarray]) -> bool:
        others = zip(splats, own, reversed(names), strict=True)
        errors = [standard_error(one - other, squares) for one, other, (_, squares) in others]
        return most - bits <= sum(errors) / len(errors)

    return SmoothnessChoice(
        min(strength for strength, one in tries.items() if is_as_good(*one)),
        {strength: bits for strength, (bits, _) in tries.items()},
    )


def _rows_of(W: RegionWeights, rows: Tensor) -> RegionWeights:
    """W of some splats [n] i64, a row each in their order; without weight."""
    starts, entries = W.take(rows)
    none = W.total_weight_splats[:0], W.total_weight[:0]
    every = torch.arange(len(rows), dtype=torch.int32)
    return RegionWeights(every, starts, W.region[entries], W.weight[entries], *none, W.offsets)


@dataclass(frozen=True)
class _Half:
    """The lift of every second view, in a few channels."""

    features: np.ndarray  # [P, C] f32
    sums: np.ndarray  # [P] f64, of the rows of its W

    @classmethod
    def of(cls, W: RegionWeights, rows: Tensor, own: Tensor, threads: int | None) -> _Half:
        """Of W's regions that are its own [M] bool, which read rows [M, C] f32."""
        half = reweighted(W, own.float()[W.region.long()])
        features = solve(half, Codebook((ViewCodebook(rows),)), torch.float32, threads=threads).features
        return cls(features.numpy(), half.row_sums().numpy())


def principal_channels(codebook: Codebook, totals: np.ndarray) -> Tensor:
    """What regions read in the CHANNELS directions in which it varies most, each region by its weight [M] f64.

    Returns:
        [M, C] f32, less the mean, the largest deviation one; C is zero where nothing varies.
    """
    step = -(-codebook.regions // SAMPLE)
    sample = torch.cat([codebook.values(own, CPU.place)[::step] for own in codebook.slices()], dim=1).double()
    shares = torch.from_numpy(totals[::step])
    shares = shares / shares.sum().clamp_min(1e-300)
    mean = shares @ sample
    sample -= mean
    values, axes = torch.linalg.eigh((sample * shares[:, None]).T @ sample)
    count = int((values > 1e-12 * values[-1].clamp_min(1e-300)).sum())
    count = min(CHANNELS, count) if bool(torch.isfinite(values).all()) else 0
    axes = axes[:, axes.shape[1] - count :] / values[-1].clamp_min(1e-300).sqrt()
    table = torch.zeros(codebook.regions, count, dtype=torch.float64)
    for own in codebook.slices():
        part = codebook.values(own, CPU.place)
        for begin in range(0, codebook.regions, ROWS):
            table[begin : begin + ROWS] += (part[begin : begin + ROWS].double() - mean[own]) @ axes[own]
    return table.float()


def prototypes(features: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """At most PROTOTYPES [K, C] f32, by k-means of a sample of features [P, C].

    Args:
        weights: [P] f64, by which splats are drawn; their sum is above zero.
    """
    cumulative = np.cumsum(weights)
    drawn = np.searchsorted(cumulative, rng.random(SAMPLE) * cumulative[-1], side="right")
    sample = features[np.minimum(drawn, len(features) - 1)].astype(np.float64)
    centres = sample[:1]
    nearest = ((sample - centres[0]) ** 2).sum(axis=1)
    for _ in range(PROTOTYPES - 1):  # k-means++: far from those that are there
        cumulative = np.cumsum(nearest)
        if cumulative[-1] <= 0:  # the sample has fewer distinct rows
            break
        next_one = min(int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right")), SAMPLE - 1)
        centres = np.concatenate([centres, sample[next_one : next_one + 1]])
        nearest = np.minimum(nearest, ((sample - sample[next_one]) ** 2).sum(axis=1))
    for _ in range(ROUNDS):
        own = (np.square(centres).sum(axis=1) - 2 * sample @ centres.T).argmin(axis=1)
        counts = np.bincount(own, minlength=len(centres))
        sums = np.stack([np.bincount(own, channel, minlength=len(centres)) for channel in sample.T], axis=1)
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centres)
    return centres.astype(np.float32)


def nearest_prototypes(features: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of centres [K, C] of each row of features [P, C], [P] i64, and by how much, m [P] f32 in 0..1."""
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


def information(names: np.ndarray, others: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """The mutual information of two names of each splat [P] i64, by weights [P] f64 with a positive sum.

    Few splats in many pairs of names seem to tell more than they do: that is corrected for (Miller and Madow, 1955).

    Returns:
        Bits a splat, and those of each splat [P] f64, whose mean they are before the correction.
    """
    pairs = names * PROTOTYPES + others
    joint = np.bincount(pairs, weights, minlength=PROTOTYPES**2).reshape(PROTOTYPES, -1) / weights.sum()
    splats = weights.sum() ** 2 / np.square(weights).sum()
    rows, columns, both = joint.sum(axis=1), joint.sum(axis=0), joint > 0
    bits = np.log2(np.divide(joint, np.outer(rows, columns), out=np.ones_like(joint), where=both))
    spare = np.count_nonzero(rows) + np.count_nonzero(columns) - np.count_nonzero(both) - 1
    return float((joint * bits).sum() + spare / (2 * splats * np.log(2))), bits.ravel()[pairs]


def standard_error(values: np.ndarray, weights: np.ndarray) -> float:
    """Of the mean of values [P] by weights [P], which are no counts."""
    shares = weights / weights.sum()
    return float(np.sqrt(np.square(shares * (values - shares @ values)).sum()))
