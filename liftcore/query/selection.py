"""Corrections of the automatic threshold: competing words, and objects of which a part is selected.

A histogram shows where scores separate. It does not show that the splats above are the target of the query. So the
splats above the automatic threshold are compared with other words, of two kinds:

- **Reference words** (`liftcore.query.presence`): for 90 % of the selected total weight the query's word must be
  among the nearest; else a new threshold is searched above the score from which this holds. (With 50 %, a similar and
  no larger object beside the target would pass.)
  Where the word is among the nearest for as much of the rest, too, the scene is of one thing, and is selected whole.
- **The other words of a pack** or of a short table are all that its author distinguishes: a splat to which one of
  them is nearer is not selected.

Then the objects of the region graph (`liftcore.solve.objects`) correct the selection:

- An object that is mostly selected may be **added as a whole**: its other splats had wrong masks. As it may be two
  objects by mistake, the rest of it must be nearer to its selected part than to any other object, in features; else
  only those splats of the rest are added for which this holds. A rest of many splats, though of little weight, must
  also have the query's word among its nearest, as it may be a larger thing that few rays see; else it is added splat
  by splat likewise. Where less than `MOSTLY_SELECTED` is selected, all of the rest is added or none: the word must
  be among the nearest for `NEAR` of its total weight.
- An object of which less than `PARTLY_SELECTED` is selected is **removed** where this part, too, is nearer to the
  object's own best word than to the query's: masks show that the part belongs to the object. What is visible through
  an object, or was merged with it by mistake, has its own word as the nearest and stays.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.query.presence import References, nearer_counts, products
from liftcore.query.scores import rank_rows, spaced
from liftcore.query.threshold import LEAST_SHARE

if TYPE_CHECKING:
    from liftcore.query.scene import Scene

NEAR = 0.9  # share of the selected total weight at which the word must be among the nearest; .5 lets two objects pass
SAMPLED = 256  # splats sampled from each octave of the ranking: a million splats have twelve octaves
MOSTLY_SELECTED = 2 / 3  # share of an object's total weight from which it is mostly selected
PARTLY_SELECTED = 1 / 3  # share of an object's total weight below which its mean does not represent the selected part
LEAST_FIRST = 0.1  # of the total weight at which the word is the nearest of all, that a clear answer selects
ONE_MEANING = 0.9  # cosine of parts and wholes, about the mean, from which words ask splats, not nodes; equal: .95.
# A lift separates levels below .8 (`solve.objects.SEPARATE_BELOW`): that costs a pass a level, and nodes nothing.
SAME_WORD = 1 - 1e-4  # cosine from which two words of a table are one
_BLOCK = 1 << 10  # splats that are compared with a pack's words at once: as many as fit the CPU cache


@dataclass(frozen=True)
class CompetingWords:
    """Words that compete with those of a query."""

    directions: np.ndarray  # [p, F] f32, unit, of the query's words
    vectors: np.ndarray  # [m, F] f32, unit, of words with another meaning
    nearer_limit: int  # the query's word is among the nearest if at most so many of them are nearer

    @classmethod
    def among(cls, references: References, directions: np.ndarray) -> CompetingWords:
        """Return the reference words whose meaning differs from those of all of the query's words [p, F]."""
        row_sets, limits = zip(*map(references.against, directions), strict=True)
        rows = row_sets[0]
        for row_set in row_sets[1:]:
            rows = np.intersect1d(rows, row_set)
        return cls(directions, references.vectors[rows], max(limits))

    @classmethod
    def of_small_table(cls, vectors: np.ndarray, directions: np.ndarray) -> CompetingWords:
        """Return the words [n, F] of a small table that differ from the query's words [p, F] in meaning."""
        competitors = cls.among(References(("",) * len(vectors), vectors), directions)
        is_own = (competitors.vectors @ directions.T >= SAME_WORD).any(axis=1)
        return cls(directions, competitors.vectors[~is_own], 0)

    def count_nearer(self, scene: Scene, rows: np.ndarray) -> np.ndarray:
        """Count the words that are nearer to each of some splats [n] than the query's words, [n] i64."""
        return self.count_nearer_means(scene, scene.features[rows], scene.norms[rows])

    def count_nearer_means(self, scene: Scene, means: np.ndarray, norms: np.ndarray | None = None) -> np.ndarray:
        """Count the words that are nearer to features [n, F] than the query's words, [n] i64; norms None: unit."""
        lengths = np.ones(len(means), np.float32) if norms is None else norms
        return np.minimum(*nearer_counts(means, lengths, scene.rough_mean, self.directions, self.vectors))

    def near_share(self, scene: Scene, rows: np.ndarray) -> float:
        """Return the share of the total weight of some splats, of a sample of them, that the words are near to."""
        rows = spaced(rows, _BLOCK)
        near = self.count_nearer(scene, rows) <= self.nearer_limit
        return float(np.average(near, weights=scene.total_weight[rows] + np.float32(1e-30)))


@dataclass(frozen=True)
class RankComparison:
    """A ranking of splats by score, compared with competing words."""

    lowest: float  # lowest score at or above which the word is among the nearest for NEAR of the total weight
    first: float  # share, of the total weight at which the word is the nearest of all, at or above a threshold
    rest: float  # share of the total weight below the threshold for which the word is among the nearest


def compare_ranks(scene: Scene, scores: np.ndarray, threshold: float, competitors: CompetingWords) -> RankComparison:
    """Compare the splats of a ranking with competing words, from the highest score down.

    A sample is compared, denser at higher scores: `SAMPLED` evenly spaced splats of each octave of the ranking. Where
    the word is nowhere among the nearest, as for an object that is not in the scene, the limit is the weighted median
    number of nearer words over its best splats: then only the splats most similar to it are selected.

    Args:
        scene: an opened lift. scores: [P] f32. threshold: on the scores.
    """
    rows, widths = _octaves(rank_rows(scores, np.flatnonzero(scene.has_feature)))
    counts = scene.total_weight[rows] * widths
    if not counts.any():
        counts = widths
    nearer, sums = competitors.count_nearer(scene, rows), np.cumsum(counts)
    best = max(1, int(np.searchsorted(sums, LEAST_SHARE * sums[-1])) + 1)
    ranked = np.argsort(nearer[:best], kind="stable")
    middle = nearer[ranked[np.searchsorted(np.cumsum(counts[ranked]), counts[:best].sum() / 2)]]
    near = np.cumsum(np.where(nearer <= max(competitors.nearer_limit, int(middle)), counts, 0.0))
    below = scores[rows] < np.float32(threshold)
    rest = counts[below & (nearer <= competitors.nearer_limit)].sum() / max(counts[below].sum(), 1e-30)
    passing = np.flatnonzero(near >= NEAR * sums)
    above = scores[rows] >= np.float32(threshold)
    first = np.where(nearer == 0, counts, 0.0)
    share = float(first[above].sum() / first.sum()) if first.any() else 1.0
    last = int(passing[-1]) if passing.size else 0
    lowest = scores[rows[last]]
    if passing.size and last + 1 < len(rows):
        lowest = min(lowest, np.nextafter(scores[rows[last + 1]], np.float32(np.inf)))
    return RankComparison(float(lowest), share, float(rest))


def nearest_to_query(scene: Scene, selected: np.ndarray, competitors: CompetingWords) -> np.ndarray:
    """Return the selected splats [P] bool to which no competing word is nearer than the query's words, [P] bool."""
    mask = np.zeros_like(selected)
    rows = np.flatnonzero(selected)
    for first in range(0, len(rows), _BLOCK):
        block = rows[first : first + _BLOCK]
        own_cosines, other_cosines = products(
            scene.features[block], scene.norms[block], competitors.directions, competitors.vectors
        )
        mask[block] = other_cosines.max(axis=1) <= own_cosines.max(axis=1)
    return mask


def correct_by_objects(scene: Scene, selected: np.ndarray, competitors: CompetingWords) -> tuple[np.ndarray, str]:
    """Correct a selection [P] bool by the objects of the region graph.

    Args:
        scene: an opened lift. selected: [P] bool. competitors: competing words.

    Returns:
        The corrected selection [P] bool, and a clause for the user on the changes, "" if there are none.
    """
    if scene.object is None:
        return selected, ""
    objects, totals = scene.object_numbers
    weights, rows = scene.total_weight, np.flatnonzero(selected & (objects >= 0))
    inside = np.bincount(objects[rows], weights[rows], len(totals))
    shares = inside / np.where(totals > 0, totals, 1.0)
    if not (inside > 0).any():
        return selected, ""
    means = scene.object_means
    has_mean = np.linalg.norm(means, axis=1) > 0
    near = has_mean & (competitors.count_nearer_means(scene, means) <= competitors.nearer_limit)
    other_means = means[has_mean & ~near]  # of objects that are no part of the answer
    corrected, grown_count, clauses = selected.copy(), 0, []
    for target in np.flatnonzero(near & (shares >= PARTLY_SELECTED) & (inside < totals)).tolist():
        members = objects == target
        part, rest = (scene.mean_of(np.flatnonzero(members & side)) for side in (selected, ~selected))
        rest_rows = np.flatnonzero(members & ~selected)
        is_other = len(other_means) and _about(scene, other_means, rest).max() >= _about(scene, part[None], rest)[0]
        is_large = len(rest_rows) > (1 - MOSTLY_SELECTED) * members.sum()
        is_odd = is_large and competitors.count_nearer_means(scene, rest[None])[0] > competitors.nearer_limit
        if shares[target] < MOSTLY_SELECTED:
            if is_other or competitors.near_share(scene, rest_rows) < NEAR:
                continue
        elif is_other or is_odd:
            rest_rows = _nearest_to(scene, rest_rows, means[has_mean], int(has_mean[:target].sum()))
            if is_odd:
                rest_rows = rest_rows[competitors.count_nearer(scene, rest_rows) <= competitors.nearer_limit]
        corrected[rest_rows] = True
        grown_count += bool(rest_rows.size)
    if grown_count:
        added_count = int(corrected.sum() - selected.sum())
        clauses = [
            f"{_quantity(added_count, 'more splat')} of {_quantity(grown_count, 'object')} mostly above it count too"
        ]
    partly = has_mean & (inside > 0) & (shares < PARTLY_SELECTED)
    excess = selected & np.isin(objects, _objects_of_other_words(scene, objects, selected, partly, competitors))
    if excess.any() and weights[excess].sum() < weights[selected].sum() / 2:
        corrected &= ~excess
        clauses += [f"{_quantity(int(excess.sum()), 'splat')} of objects to which another word is nearer do not"]
    return corrected, ", ".join(clauses)


def asks_nodes(scene: Scene) -> bool:
    """Return True if masks of parts and of wholes differ in meaning: then a splat's feature, their sum, has both."""
    level_agreement = (scene.metadata.diagnostics.get("objects") or {}).get("level_agreement")
    return level_agreement is not None and level_agreement < ONE_MEANING


def part_nodes(scene: Scene, queries: Iterable[CompetingWords]) -> Iterator[list[int]]:
    """Yield the parts that each query's words name, in a lift whose levels differ in meaning; [] if levels agree.

    A splat's feature is the sum over all levels, so that words of parts also match their wholes. A node has the
    features of its own masks alone. So the nearest node is taken, or the largest node above it of the same meaning,
    if the word is among the nearest there and the node is a part of a whole of another meaning. Nodes whose score is
    more than halfway from that whole to that part have the same name.
    """
    parents, features = scene.node_parents, scene.node_features
    if parents is None or features is None or not asks_nodes(scene):
        yield from ([] for _ in queries)
        return
    vectors, paths = features.astype(np.float32), scene.node_paths
    has_vector = np.linalg.norm(vectors, axis=1) > 0
    is_alike = (parents >= 0) & (_about(scene, vectors[parents], vectors) >= ONE_MEANING)
    from_the_largest = sorted(range(len(parents)), key=lambda node: len(paths[node]))
    widest = np.arange(len(parents))  # the largest node of the same meaning above each, or itself
    for node in from_the_largest:
        if is_alike[node]:
            widest[node] = widest[parents[node]]
    for competitors in queries:
        scores = np.where(has_vector, (vectors @ competitors.directions.T).max(axis=1), -1.0)
        sure = has_vector & (competitors.count_nearer_means(scene, vectors) <= competitors.nearer_limit)
        node = int(widest[scores.argmax()])
        parent, parts = int(parents[node]), list[int]()
        if parent >= 0 and has_vector[parent] and sure[node]:
            is_named = sure & (scores > (scores[node] + scores[parent]) / 2) & (parents >= 0)
            for part in [node, *(other for other in from_the_largest if is_named[other])]:
                if not any(part in paths[other] or other in paths[part] for other in parts):
                    parts.append(part)
        yield parts


def objects_within(scene: Scene, selected: np.ndarray) -> np.ndarray:
    """Return the objects [N] bool of which `PARTLY_SELECTED` or more is among the selected splats [P] bool."""
    if scene.object is None:
        return np.zeros(0, np.bool_)
    objects, totals = scene.object_numbers
    rows = np.flatnonzero(selected & (objects >= 0))
    inside = np.bincount(objects[rows], scene.total_weight[rows], len(totals))
    return (inside > 0) & (inside >= PARTLY_SELECTED * totals)


def add_objects(scene: Scene, selected: np.ndarray) -> np.ndarray:
    """Add to selected splats [P] bool the objects of which `PARTLY_SELECTED` or more is selected, with all parts."""
    objects = objects_within(scene, selected)
    return selected | (scene.has_feature & np.append(objects, False)[scene.object]) if objects.any() else selected


def _quantity(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _objects_of_other_words(
    scene: Scene, objects: np.ndarray, selected: np.ndarray, among: np.ndarray, competitors: CompetingWords
) -> list[int]:
    """Return the objects to whose selected splats the object's own best word is nearer than the query's words.

    Args:
        objects: [P] i32, the object of each splat, -1 for none. selected: [P] bool. among: [N] bool, compared ones.
    """
    numbers = []
    for number in np.flatnonzero(among).tolist() if len(competitors.vectors) else ():
        mean, part = scene.object_means[number], scene.mean_of(np.flatnonzero((objects == number) & selected))
        likeness = competitors.vectors @ (mean - scene.rough_mean)  # low for words near to all of the scene
        word = competitors.vectors[likeness.argmax()]
        pair = np.stack([mean, part])
        if ((word - competitors.directions) @ np.concatenate([pair, pair - scene.rough_mean]).T > 0).all():
            numbers.append(number)
    return numbers


def _nearest_to(scene: Scene, rows: np.ndarray, means: np.ndarray, target: int) -> np.ndarray:
    """Return those of some splats [n] that are nearer to one object than to any other, about the scene's mean.

    Args:
        rows: [n] i64, splats. means: [N, F] f32, unit, of objects. target: the object's row in them.
    """
    offsets = means - scene.rough_mean
    offsets /= np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), np.float32(1e-12))
    shift, features = offsets @ scene.rough_mean, scene.features
    table, inverse = features.distinct(rows)
    is_nearest = np.zeros(len(table), np.bool_)
    for first in range(0, len(table), _BLOCK):
        block = table[first : first + _BLOCK]
        along = products(features.rows[block], features.norms[block], offsets, offsets[:0])[0] - shift
        is_nearest[first : first + _BLOCK] = along.argmax(axis=1) == target
    return rows[is_nearest[inverse]]


def _about(scene: Scene, means: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Compute the cosines [n] f32 of unit features [n, F] and others [n, F] or [F] about the scene's mean."""
    means, others = means - scene.rough_mean, others - scene.rough_mean
    lengths = np.linalg.norm(means, axis=-1) * np.linalg.norm(others, axis=-1)
    return (means * others).sum(axis=-1) / np.maximum(lengths, np.float32(1e-12))


def _octaves(order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample a ranking [n] by octaves: return the sampled rows, and the number of rows that each represents."""
    rows, widths, first, last = [], [], 0, SAMPLED
    while first < len(order):
        octave = order[first:last]
        step = -(-len(octave) // SAMPLED)
        sample = octave[step // 2 :: step]
        rows.append(sample)
        widths.append(np.full(len(sample), len(octave) / len(sample)))
        first, last = last, 2 * last
    return np.concatenate(rows), np.concatenate(widths)
