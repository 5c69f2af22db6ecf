"""Segmentation by many words: the most similar word of every splat, or none; and the best words for an example.

Each word has an automatic threshold, as a query has. A splat gets the nearest of the words whose threshold it
reaches, or none. The threshold of an absent word selects the splats most similar to it, but most of these are nearer
to their own words. So a word is present if it is the nearest of all words for at least a quarter of its selection,
by total weight, and if reference words do not show that it is absent (`liftcore.query.presence`; many words are their
own references). Absent words get no splats.

The lift's tree corrects this: a word that names parts, where levels differ in meaning, gets their nodes
(`liftcore.query.selection.part_nodes`); and splats of a node without a word get the word of most of the node.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.colours import cluster_colours
from liftcore.query.objects import trimmed_box
from liftcore.query.presence import LEAST_WORDS, References, estimate_presence, references_of_space
from liftcore.query.question import LabelSummary, NamedSplats
from liftcore.query.scene import Scene, as_numpy
from liftcore.query.scores import cosines
from liftcore.query.selection import CompetingWords, asks_nodes, part_nodes
from liftcore.query.threshold import find_threshold
from liftcore.runtime.one_line import one_line
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.text import check_texts

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera

NO_WORD = -1
LEAST_OWN = 0.25  # of a word's selection, by total weight, to which no other word is nearer
MOST_WORDS = 4_096
AT_ONCE = 16  # words whose cosines are in memory at once: [P, AT_ONCE] f32
LEGEND_WORDS = 20  # words of a drawn legend


@dataclass(frozen=True)
class Segmentation:
    """Word of every splat, of some words."""

    words: tuple[str, ...]
    """as passed"""
    rows: np.ndarray
    """[P] i32, the row of each splat's word in ``words``; -1 for none"""
    score: np.ndarray
    """[P] f32, the cosine of a splat to its word; 0 without a word"""
    margin: np.ndarray
    """[P] f32, the cosine of a splat to its word minus that to the nearest other; 0 without a word"""
    named_words: tuple[NamedSplats, ...]
    """the present words, those with the largest total weight first"""

    def __repr__(self) -> str:
        text = ", ".join(f"{label.word!r}: {label.splats}" for label in self.named_words)
        return one_line(
            self, f"{len(self.rows)} splats", f"{len(self.named_words)} of {len(self.words)} words: {text}"
        )

    @property
    def labels(self) -> np.ndarray:
        """[P] i32, the place of each splat's word in ``named_words``, from 1; 0 for none."""
        places = np.zeros(len(self.words) + 1, np.int32)  # the last is of -1
        places[[label.row for label in self.named_words]] = np.arange(1, len(self.named_words) + 1)
        return places[self.rows]

    @property
    def colours(self) -> np.ndarray:
        """[len(named_words) + 1, 3] u8 sRGB, by ``labels``: grey, then a colour a word."""
        return np.roll(cluster_colours(len(self.named_words)), 1, axis=0)

    @property
    def summary(self) -> LabelSummary:
        """Present words, and the number of splats without a word."""
        none = int((self.rows < 0).sum())
        return LabelSummary(
            word_count=len(self.words), splats=len(self.rows), none=none, named_words=self.named_words
        )


@one_thread()
def segment(
    scene: Scene,
    words: Sequence[str],
    vectors: Any,
    progress: Progress = silent,
    references: References | str | None = None,
) -> Segmentation:
    """Label every splat with the most similar word, or none.

    Args:
        scene: an opened lift.
        words: n different ones. vectors: [n, F], torch or numpy, their text vectors, of any length above zero.
        progress: called with the stage "words".
        references: of the words' encoder (`liftcore.query.presence.references_of`); None = the words themselves if
            they are many, else those of the lift's text space.

    Raises:
        InvalidQuery: no words, one word twice, too many, or vectors that are no directions of the lift's space.
        InvalidLift: the splats moved or changed since the lift.
    """
    check_texts(words, "words")
    words, vectors = tuple(words), np.atleast_2d(np.asarray(as_numpy(vectors), np.float32))
    if not 1 <= len(words) <= MOST_WORDS or len(vectors) != len(words):
        got = f"{len(words)} words and {len(vectors)} vectors"
        raise InvalidQuery("words", expected=f"1 to {MOST_WORDS} words, a vector each", got=got)
    if len(set(words)) < len(words):
        twice = next(word for place, word in enumerate(words) if word in words[:place])
        raise InvalidQuery("words", expected="every word once", got=f"{twice!r} twice")
    weights = np.where(scene.has_feature, scene.total_weight, 0.0).astype(np.float64)
    weights = weights if weights.any() else scene.has_feature.astype(np.float64)
    table = scene.distinct
    row_weights = scene.features.of_rows(weights)
    thresholds, answer_weights = np.empty(len(words)), np.empty(len(words))
    nearest = _Nearest(len(row_weights))
    for row, scores in _scores(table, vectors, range(len(words))):
        threshold = find_threshold(scores[table.has_feature], "auto", table.weights)
        thresholds[row] = threshold.value if threshold.clear else np.inf
        answer_weights[row] = row_weights[scores >= thresholds[row]].sum()
        nearest.take(row, scores)
        progress("words", row + 1, len(words), "words")
    is_answer = nearest.score >= thresholds[nearest.row]
    sums = np.bincount(nearest.row[is_answer], row_weights[is_answer], len(words))
    shares = sums / np.maximum(answer_weights, 1e-30)
    winners = _Nearest(len(row_weights))
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    if references is None:
        suffices = len(words) >= LEAST_WORDS
        references = References(words, unit) if suffices else references_of_space(unit, scene.metadata.text_space)
    parts = _parts(scene, unit, references)
    for row, scores in _scores(table, vectors, np.flatnonzero((shares >= LEAST_OWN) | parts.any(axis=1)).tolist()):
        if (
            isinstance(references, References)
            and estimate_presence(table, words[row], unit[row], scores, references).present is False
        ):
            parts[row] = False
            continue
        if shares[row] >= LEAST_OWN and not parts[row].any():
            winners.take(row, np.where(table.has_feature & (scores >= thresholds[row]), scores, -np.inf))
    of_splats = scene.features.of_splats
    rows = of_splats(np.where(winners.score > -np.inf, winners.row, NO_WORD).astype(np.int32))
    rows = np.where(scene.has_feature, rows, np.int32(NO_WORD))
    rows = _by_nodes(scene, rows, weights, parts)
    score = np.zeros(len(rows), np.float32)
    for row, scores in _scores(table, vectors, np.unique(rows[rows != NO_WORD]).tolist()):
        score = np.where(rows == row, of_splats(scores), score)
    other = np.where(rows == of_splats(nearest.row), of_splats(nearest.second), of_splats(nearest.score))
    has_margin = (rows != NO_WORD) & (other > -np.inf)
    margin = np.subtract(score, other, out=np.zeros_like(score), where=has_margin)
    groups = [
        (float(weights[members].sum() / weights.sum()), row, members)
        for row in np.unique(rows[rows != NO_WORD]).tolist()
        if weights[members := np.flatnonzero(rows == row)].any()
    ]
    groups.sort(key=lambda group: -group[0])
    colours = cluster_colours(len(groups)).tolist()
    summaries = tuple(
        NamedSplats(
            word=words[row],
            row=row,
            value=value,
            colour=colours[value - 1],
            splats=len(members),
            share=share,
            score=float(np.average(score[members], weights=weights[members])),
            margin=float(np.average(margin[members], weights=weights[members])),
            threshold=float(thresholds[row]),
            box=trimmed_box(scene.splats.positions(members), weights[members]),
        )
        for value, (share, row, members) in enumerate(groups, 1)
    )
    return Segmentation(words, rows, score, margin, summaries)


def _parts(scene: Scene, unit: np.ndarray, references: References | str | None) -> np.ndarray:
    """Return the nodes of parts that each of some words [n, F] f32 names, [n, N] bool."""
    mask = np.zeros((len(unit), 0 if scene.node_parents is None else len(scene.node_parents)), np.bool_)
    if isinstance(references, References) and asks_nodes(scene):
        queries = (CompetingWords.among(references, word[None]) for word in unit)
        for row, nodes in enumerate(part_nodes(scene, queries)):
            mask[row, nodes] = True
    return mask


def _by_nodes(scene: Scene, rows: np.ndarray, weights: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Correct rows of words by the lift's nodes: parts that a word names, and splats without a word; [P] i32.

    Args:
        rows: [P] i32, NO_WORD for none. weights: [P] f64. parts: [n, N] bool, the nodes that words name.
    """
    if scene.node is None or scene.node_parents is None or not len(scene.node_parents):  # no ray met a region
        return rows
    output = rows.copy()
    for node in sorted(np.flatnonzero(parts.any(axis=0)).tolist(), key=lambda n: len(scene.node_paths[n])):
        output[scene.has_feature & scene.members(node)] = int(parts[:, node].argmax())
    nodes, word_count = np.where(scene.has_feature, scene.node, -1), len(parts)
    within = nodes >= 0
    shape = len(scene.node_parents), word_count + 1
    places = nodes[within].astype(np.int64) * shape[1] + np.where(output < 0, word_count, output)[within]
    table = np.bincount(places, weights[within], shape[0] * shape[1]).reshape(shape)
    word = table[:, :word_count].argmax(axis=1)
    is_majority = 2 * table[np.arange(len(table)), word] >= np.maximum(table.sum(axis=1), 1e-30)
    empty = within & (output == NO_WORD) & is_majority[nodes]
    output[empty] = word[nodes[empty]]
    return output


class _Nearest:
    """The nearest word of every splat so far, its cosine, and that of the second nearest."""

    def __init__(self, count: int) -> None:
        self.row = np.zeros(count, np.int32)
        self.score = np.full(count, -np.inf, np.float32)
        self.second = np.full(count, -np.inf, np.float32)

    def take(self, row: int, scores: np.ndarray) -> None:
        nearer = scores > self.score  # the first of equal ones stays
        self.second = np.where(nearer, self.score, np.maximum(self.second, scores))
        self.score = np.where(nearer, scores, self.score)
        self.row[nearer] = row


def _scores(scene: Scene, vectors: np.ndarray, rows: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each row with the cosines [K] f32 of its vector; AT_ONCE rows in one pass over the features."""
    for first in range(0, len(rows), AT_ONCE):
        block = rows[first : first + AT_ONCE]
        scores = cosines(scene.features.rows, scene.features.norms, vectors[block])
        yield from zip(block, np.ascontiguousarray(scores.T), strict=True)


def label_map(scene: Scene, labels: np.ndarray, view: str | Camera) -> np.ndarray:
    """Render the splats' label [P] i32 with the most weight on each ray, [H, W] i32; 0 where it misses the scene."""
    strongest, sums = scene.strongest_labels(labels, view)
    return np.where(sums >= MINIMUM_ROW_SUM, np.maximum(strongest, 0), 0)


def map_png(labels: np.ndarray, segmentation: Segmentation) -> bytes:
    """Write labels [H, W] as a PNG with a palette, 0 black; its text ``legend`` is JSON from labels to words.

    Above 255 words it is a grey image of 16 bits.
    """
    from liftcore.query.render import png

    words = [label.word for label in segmentation.named_words]
    text = {"legend": json.dumps(dict(enumerate(words, 1)))}
    if len(words) > 255:
        return png(labels.astype(np.uint16), text)
    colours = segmentation.colours.copy()
    colours[0] = 0
    return png(labels.astype(np.uint8), text, colours)


def picture_png(image: np.ndarray, labels: np.ndarray, segmentation: Segmentation) -> bytes:
    """Tint a view [H, W, 3] u8 with the colours of its words, and list them below it, as a PNG."""
    from liftcore.query.render import captioned_png

    colours = segmentation.colours
    tinted = np.where(labels[..., None] > 0, (0.4 * image + 0.6 * colours[labels]).astype(np.uint8), image // 2)
    pixels = np.bincount(labels.ravel(), minlength=len(colours))
    visible = [place for place in np.argsort(-pixels, kind="stable").tolist() if place and pixels[place]]
    lines = [(segmentation.named_words[place - 1].word, colours[place]) for place in visible[:LEGEND_WORDS]]
    return captioned_png(tinted, lines or [("no word is here", colours[0])])
