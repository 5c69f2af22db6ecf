"""Ask a lift for words and examples: which splats answer, and where they lie."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.query.directions import directions
from liftcore.query.products import LOWEST_COSINE
from liftcore.query.query import Query
from liftcore.query.scores import LEAST_LIKENESS, combine, cosines, cosines_about
from liftcore.query.threshold import find_threshold

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from torch import Tensor

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene

_QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass(frozen=True)
class Question:
    """A query whose terms were found."""

    query: Query
    rows: Tensor  # [n, F] f32, the unit direction of each term


@dataclass(frozen=True)
class Answer:
    """How a scene answers a query."""

    query: Query
    scores: Tensor  # [P] f32, in -1..1 (`scores.combine`); the minimum where not seen
    seen: Tensor  # [P] bool, whether the splat has a feature
    threshold: float  # on the scores
    threshold_method: str  # what was asked for: auto, valley, paper, otsu, stability or fixed
    explanation: str  # one sentence on how the threshold was found
    selected: Tensor  # [P] bool, seen and at or above the threshold
    statistics: Mapping[str, float]  # min, max, mean and quantiles q01..q99 of the seen scores

    @property
    def count(self) -> int:
        """How many splats were selected."""
        return int(self.selected.sum())


Point = tuple[float, float, float]  # x y z, world frame, scene units


@dataclass(frozen=True)
class TopSplat:
    """One of the best splats of an answer."""

    splat: int  # its row in the splat file
    score: float
    position: Point


@dataclass(frozen=True)
class Found:
    """Where an answer lies in the world."""

    best: tuple[TopSplat, ...]  # descending by score
    box: tuple[Point, Point] | None  # least and greatest corner of the centres of all selected; None = none


def ask(scene: QueryScene, query: Query | str, encoder: TextEncoder | None = None) -> Answer:
    """Score every splat for a query and choose those that answer it.

    A splat counts in the histogram by its evidence: what hardly a ray met scores by the chance of a few pixels. It is
    still selected by its score.

    Args:
        scene: an opened lift.
        query: words and examples, or one text alone.
        encoder: the text encoder whose space the lifted features live in; examples need none.

    Raises:
        InvalidQuery: a text without an encoder of the lift's space, or a term that has no feature.
        NotFound: an example names a view or a region that is not there.
        InvalidLift: an example needs the scene's files, and they moved or changed.
    """
    query = Query((query,)) if isinstance(query, str) else query
    return answers(scene, [question(scene, query, encoder)])[0]


def question(scene: QueryScene, query: Query, encoder: TextEncoder | None) -> Question:
    """A query with the directions of its terms; what can be wrong with a query is found here (see `ask`)."""
    return Question(query, directions(scene, query, encoder))


def answers(scene: QueryScene, questions: Sequence[Question]) -> list[Answer]:
    """Answer several queries in one pass over the features; each to the same bits as alone."""
    similarities = _similarities(scene, questions)
    if len(questions) == 1:
        return [_answer(scene, questions[0], similarities[0])]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(lambda asked, similar: _answer(scene, asked, similar), questions, similarities))


def top(answer: Answer, scene: QueryScene, count: int) -> Found:
    """The best splats of an answer with their places, and the box around all selected ones.

    A single stray splat stretches the box; ``objects`` tells strays from things.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    means = scene.splats.means
    ranked = answer.scores if scene.all_seen else torch.where(answer.seen, answer.scores, -torch.inf)
    scores, order = torch.topk(ranked, min(count, len(ranked)))
    best = tuple(
        TopSplat(row, score, _point(means[row]))
        for row, score in zip(order.tolist(), scores.tolist(), strict=True)
        if score > -torch.inf
    )
    chosen = torch.from_numpy(np.flatnonzero(answer.selected.numpy()))
    if not len(chosen):
        return Found(best, None)
    low, high = torch.aminmax(scene.axes.index_select(1, chosen), dim=1)
    return Found(best, (_point(low), _point(high)))


def _similarities(scene: QueryScene, questions: Sequence[Question]) -> list[Tensor]:
    """For each query [P, n] f32, how like each of its terms every splat is."""
    words = [torch.tensor([isinstance(term, str) for term in asked.query.terms]) for asked in questions]
    of_words = torch.cat([asked.rows[spoken] for asked, spoken in zip(questions, words, strict=True)])
    features, norms = scene.lift.features, scene.norms
    # Words lie in rows from here on, so that each is read in one piece.
    columns = iter(cosines(features, norms, of_words).T.contiguous() if len(of_words) else ())
    found = []
    for asked, spoken in zip(questions, words, strict=True):
        similar = torch.empty(len(asked.rows), features.shape[0])
        if not spoken.all():
            similar[~spoken] = cosines_about(features, norms, scene.mean, asked.rows[~spoken]).T
        for row in spoken.nonzero():
            similar[row] = next(columns)
        found.append(similar.T)
    return found


def _answer(scene: QueryScene, asked: Question, similarities: Tensor) -> Answer:
    query, seen = asked.query, scene.seen
    scores = combine(similarities, len(query.positives))
    if not scene.all_seen:
        scores = torch.where(seen, scores, LOWEST_COSINE)
    known = scores if scene.all_seen else scores[seen]
    least = -math.inf if any(isinstance(term, str) for term in query.positives) else LEAST_LIKENESS
    found = find_threshold(known, query.threshold, scene.weights, query.instances, least)
    return Answer(
        query=query,
        scores=scores,
        seen=seen,
        threshold=found.value,
        threshold_method=found.method,
        explanation=found.explanation,
        selected=seen & (scores >= found.value),
        statistics=_statistics(known),
    )


def _statistics(scores: Tensor) -> dict[str, float]:
    if len(scores) == 0:
        return {}
    places = [round(q * (len(scores) - 1)) for q in _QUANTILES]
    ordered = np.sort(scores.numpy())  # in vector registers, so faster than selecting seven order statistics
    low, high = torch.aminmax(scores)
    quantiles = {f"q{round(100 * q):02d}": float(ordered[i]) for q, i in zip(_QUANTILES, places, strict=True)}
    return {"min": float(low), "max": float(high), "mean": float(scores.mean()), **quantiles}


def _point(row: Tensor) -> Point:
    x, y, z = row.tolist()
    return x, y, z
