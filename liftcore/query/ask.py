"""Ask a lift for words: which splats answer, and where they lie in a view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidQuery
from liftcore.query.products import LOWEST_COSINE
from liftcore.query.scores import cosines, relevancy
from liftcore.query.threshold import find_threshold

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from torch import Tensor

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene

MINIMUM_ROW_SUM = 0.5  # below it a ray mostly misses the scene: neither histogram nor mask takes it
# A splat counts in the histogram by its evidence, up to this many rays' worth of weight: what hardly a ray met
# scores by the chance of a few pixels, and such splats fill the valleys. They are still selected by their scores.
# Mean IoU of the selected splats over tabletop's 14 phrases, unweighted -> weighted: `row-sum`, noisy features
# .929 -> .925, hard ones .757 -> .819 (the best possible threshold: .931 and .874).
MOST_EVIDENCE = 20.0
_QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_NO_RELEVANCY = 0.0  # what a splat without a feature scores in relevancy


@dataclass(frozen=True)
class Answer:
    """How a scene answers a text."""

    text: str
    negatives: tuple[str, ...]  # empty for plain cosine
    scores: Tensor  # [P] f32, cosine in -1..1 or relevancy in 0..1; the minimum where not seen
    seen: Tensor  # [P] bool, whether the splat has a feature
    threshold: float  # on the scores
    threshold_method: str  # what was asked for: auto, paper, valley, otsu or fixed
    explanation: str  # one sentence on how the threshold was found
    selected: Tensor  # [P] bool, seen and at or above the threshold
    statistics: Mapping[str, float]  # min, max, mean and quantiles q01..q99 of the seen scores

    @property
    def relevancy(self) -> bool:
        """Whether the scores are LangSplat's relevancy instead of cosines."""
        return bool(self.negatives)

    @property
    def count(self) -> int:
        """How many splats were selected."""
        return int(self.selected.sum())


@dataclass(frozen=True)
class Look:
    """An answer seen from one camera."""

    view: str
    attention: Tensor  # [H, W] f32, A s: the scores rendered with the lift's rendering gain
    row_sums: Tensor  # [H, W] f32, A 1
    mask: Tensor  # [H, W] bool, at or above the threshold where the ray meets the scene
    threshold: float  # on the attention
    threshold_method: str
    explanation: str


@dataclass(frozen=True)
class TopSplat:
    """One of the best splats of an answer."""

    splat: int  # its row in the splat file
    score: float
    position: tuple[float, float, float]  # world frame, scene units


@dataclass(frozen=True)
class Found:
    """Where an answer lies in the world."""

    best: tuple[TopSplat, ...]  # descending by score
    box: tuple[tuple[float, ...], tuple[float, ...]] | None  # least and greatest corner of the selected; None = none


def ask(
    scene: QueryScene,
    text: str,
    encoder: TextEncoder,
    *,
    negatives: Sequence[str] = (),
    threshold: str | float = "auto",
) -> Answer:
    """Score every splat for a text and choose those that answer it.

    Args:
        scene: an opened lift.
        text: the words to look for.
        encoder: the text encoder whose space the lifted features live in.
        negatives: words that the text competes with; with any, scores are LangSplat's relevancy.
        threshold: ``auto``, ``valley``, ``paper``, ``otsu``, or a number on the scores.

    Raises:
        InvalidQuery: the encoder's vectors have another length than the lift's, the encoder cannot read a
            text, or the threshold is unknown.
    """
    _check_space(scene, encoder)
    similarities = cosines(scene.lift.features, scene.norms, encoder.encode([text, *negatives]))
    scores = relevancy(similarities) if negatives else similarities[:, 0]
    seen = scene.lift.seen & (scene.norms > 0)
    scores = torch.where(seen, scores, _NO_RELEVANCY if negatives else LOWEST_COSINE)
    known = scores[seen]
    found = find_threshold(known, threshold, _weights(scene, seen))
    return Answer(
        text=text,
        negatives=tuple(negatives),
        scores=scores,
        seen=seen,
        threshold=found.value,
        threshold_method=found.method,
        explanation=found.explanation,
        selected=seen & (scores >= found.value),
        statistics=_statistics(known),
    )


def look(scene: QueryScene, answer: Answer, view: str) -> Look:
    """See an answer from a camera: attention, and a mask by the view's own threshold.

    The threshold is found again on the view's map, as the paper does; a fixed one is kept.

    Raises:
        NotFound: no camera has this name.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    # A splat without a feature adds nothing to a ray; its score of -1 would count against its neighbours.
    rendered = torch.where(answer.seen, answer.scores, 0.0)
    values = torch.stack([rendered, torch.ones_like(rendered)], dim=1)
    image = scene.raster.render(scene.cameras.get(view), values, scene.walk)
    attention, row_sums = image[..., 0].contiguous(), image[..., 1].contiguous()
    met = row_sums >= MINIMUM_ROW_SUM
    fixed = answer.threshold_method == "fixed"
    found = find_threshold(attention[met], answer.threshold if fixed else answer.threshold_method)
    mask = met & (attention >= found.value)
    return Look(view, attention, row_sums, mask, found.value, found.method, found.explanation)


def top(answer: Answer, scene: QueryScene, count: int) -> Found:
    """The best splats of an answer with their places, and the box around all selected ones.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    means = scene.splats.means
    scores, order = torch.topk(torch.where(answer.seen, answer.scores, -torch.inf), min(count, len(answer.scores)))
    best = tuple(
        TopSplat(row, score, _point(means[row]))
        for row, score in zip(order.tolist(), scores.tolist(), strict=True)
        if score > -torch.inf
    )
    chosen = means[answer.selected]
    box = (_point(chosen.amin(dim=0)), _point(chosen.amax(dim=0))) if len(chosen) else None
    return Found(best, box)


def _weights(scene: QueryScene, seen: Tensor) -> Tensor | None:
    """How much each seen splat counts in the histogram; None when none has evidence."""
    weights = scene.lift.evidence[seen].clamp_max(MOST_EVIDENCE)
    return weights if bool((weights > 0).any()) else None


def _check_space(scene: QueryScene, encoder: TextEncoder) -> None:
    if encoder.channels != scene.channels:
        space = scene.lift.metadata.text_space or "none"
        raise InvalidQuery(
            "encoder",
            expected=f"{scene.channels} channels as the lift has (its text space: {space})",
            got=f"{encoder.name} with {encoder.channels}",
            hint="query with the text encoder that belongs to the features' image encoder",
        )


def _statistics(scores: Tensor) -> dict[str, float]:
    if len(scores) == 0:
        return {}
    # Selecting a few order statistics costs a fraction of sorting a million scores.
    places = [round(q * (len(scores) - 1)) for q in _QUANTILES]
    ordered = np.partition(scores.numpy(), places)
    low, high = torch.aminmax(scores)
    quantiles = {f"q{round(100 * q):02d}": float(ordered[i]) for q, i in zip(_QUANTILES, places, strict=True)}
    return {"min": float(low), "max": float(high), "mean": float(scores.mean()), **quantiles}


def _point(row: Tensor) -> tuple[float, float, float]:
    x, y, z = row.tolist()
    return x, y, z
