"""What a question selects answers it: other words compete for what lies above the automatic threshold.

A histogram says where scores part, not whether what lies above is what was asked for. So the automatic threshold is
held to other words. Two kinds of them compete:

- **Reference words** (`liftcore.query.presence`) say of each splat whether the word is among the nearest. Of the
  splats at or above the threshold, by evidence, the word must be among the nearest for nine tenths at least; else
  the threshold is sought again from the score on where that holds. (A thing beside it that is alike and no larger
  would pass for it with a half.)
- **The other words of a pack** or of a short table are all that its author distinguishes: where one of them is
  nearer, a splat is not selected.

Then the things of the region graph (`liftcore.solve.objects`) are asked, which know of each splat what masks keep it
with:

- A thing that is mostly selected may be **taken whole**: its other splats got wrong masks. It may hold two things,
  though. So the rest of it must be nearer to the part that is selected than to any other thing, in features; else
  only those splats of the rest are taken that are, one by one. Where less than `MOST` is selected, the whole rest is
  taken or none, and no other thing's best word may be nearer to it, as words lie and about the scene's mean.
- Of a thing of which less than `SOME` is selected **none is taken** where that part, too, is nearer to the best word
  of the thing than to the query's: masks say that it is of the thing, and hardly that it is what was asked for. What
  shines through a thing, or was merged with it, has its own word as the nearest and stays.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.query.presence import References, nearer_counts, products
from liftcore.query.threshold import LEAST_SHARE
from liftcore.runtime.cores import cores

if TYPE_CHECKING:
    from liftcore.query.opened import OpenedLift

NEAR = 0.9  # of the selected evidence, at which the word must be among the nearest; with .5 two things pass for one
SAMPLED = 256  # splats of each octave of the ranking that are looked at: a million splats have twelve octaves
MOST = 2 / 3  # of a thing: it is mostly selected
SOME = 1 / 3  # of a thing, below which its mean says nothing of what was asked
LEAST_FIRST = 0.1  # of the evidence at which the word is the nearest of all, that a clear answer selects
LEVELS_AGREE = 0.9  # cosine of parts and wholes, about the mean, from which splats say it all: alike, they have .95
SAME_WORD = 1 - 1e-4  # cosine from which two words of a table are one
_AT_ONCE = 1 << 10  # splats that are compared with a pack's words at once: what stays in a cache


@dataclass(frozen=True)
class Rivals:
    """Words that compete with those of a query."""

    directions: np.ndarray  # [p, F] f32, unit, of the query's own words
    vectors: np.ndarray  # [m, F] f32, unit, of words that mean something else
    allowed: int  # how many of them may be nearer where a word is among the nearest

    @classmethod
    def among(cls, references: References, directions: np.ndarray) -> Rivals:
        """Those of the reference words that mean something else than any of the query's words [p, F]."""
        others, allowed = zip(*map(references.against, directions), strict=True)
        rows = others[0]
        for more in others[1:]:
            rows = np.intersect1d(rows, more)
        return cls(directions, references.vectors[rows], max(allowed))

    @classmethod
    def of_pack(cls, vectors: np.ndarray, directions: np.ndarray) -> Rivals:
        """The words [n, F] of a pack that are none of the query's [p, F], and mean something else than they do."""
        rivals = cls.among(References(("",) * len(vectors), vectors), directions)
        same = (rivals.vectors @ directions.T >= SAME_WORD).any(axis=1)
        return cls(directions, rivals.vectors[~same], 0)

    def ahead(self, scene: OpenedLift, rows: np.ndarray) -> np.ndarray:
        """[n] i64, how many of them are nearer to these splats [n] than the query's words (`nearer_counts`)."""
        return np.minimum(*nearer_counts(scene.features[rows], scene.norms[rows], scene.rough_mean, *self._pair))

    def ahead_of_means(self, scene: OpenedLift, means: np.ndarray) -> np.ndarray:
        """The same for unit features [n, F]."""
        ones = np.ones(len(means), np.float32)
        return np.minimum(*nearer_counts(means, ones, scene.rough_mean, *self._pair))

    @property
    def _pair(self) -> tuple[np.ndarray, np.ndarray]:
        return self.directions, self.vectors


@dataclass(frozen=True)
class Contest:
    """How a ranking of splats stands beside other words."""

    lowest: float  # at or above it the word is among the nearest for NEAR of the evidence, at the next less it is not
    first: float  # share, of the evidence at which the word is the nearest of all, at or above a threshold


def contest(scene: OpenedLift, scores: np.ndarray, weights: np.ndarray, threshold: float, rivals: Rivals) -> Contest:
    """Compare the splats of a ranking with rivals, from the best down.

    A sample is looked at, denser where scores are higher: `SAMPLED` of each octave of the ranking, evenly. Where the
    word is nowhere among the nearest, as for what is not there, it counts as among them where no more rivals are
    nearer than at the middle one of its best splats: what is most like it is selected, and no more.

    Args:
        scene: an opened lift. scores, weights: [P] f32, how much each splat counts. threshold: on the scores.
    """
    rows, widths = _octaves(_from_the_best(scores, np.flatnonzero(scene.seen)))
    counts = weights[rows] * widths
    if not counts.any():
        counts = widths
    ahead, sums = rivals.ahead(scene, rows), np.cumsum(counts)
    best = max(1, int(np.searchsorted(sums, LEAST_SHARE * sums[-1])) + 1)
    ranked = np.argsort(ahead[:best], kind="stable")
    middle = ahead[ranked[np.searchsorted(np.cumsum(counts[ranked]), counts[:best].sum() / 2)]]
    near = np.cumsum(np.where(ahead <= max(rivals.allowed, int(middle)), counts, 0.0))
    held = np.flatnonzero(near >= NEAR * sums)
    above = scores[rows] >= np.float32(threshold)
    first = np.where(ahead == 0, counts, 0.0)
    share = float(first[above].sum() / first.sum()) if first.any() else 1.0
    last = int(held[-1]) if held.size else 0
    lowest = scores[rows[last]]
    if held.size and last + 1 < len(rows):
        lowest = min(lowest, np.nextafter(scores[rows[last + 1]], np.float32(np.inf)))
    return Contest(float(lowest), share)


def nearer_than_rivals(scene: OpenedLift, selected: np.ndarray, rivals: Rivals) -> np.ndarray:
    """[P] bool: the selected splats [P] bool to which no rival is nearer than the query's words."""
    kept = np.zeros_like(selected)
    rows = np.flatnonzero(selected)

    def compare(first: int) -> None:
        some = rows[first : first + _AT_ONCE]
        own, others = products(scene.features[some], scene.norms[some], rivals.directions, rivals.vectors)
        kept[some] = others.max(axis=1) <= own.max(axis=1)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(compare, range(0, len(rows), _AT_ONCE)))
    return kept


def with_things(
    scene: OpenedLift, selected: np.ndarray, weights: np.ndarray, rivals: Rivals
) -> tuple[np.ndarray, str]:
    """A selection [P] bool after what the things of the region graph say of it, and a clause on that; "" for nothing.

    Args:
        scene: an opened lift. weights: [P] f32, how much each splat counts.
    """
    if scene.object is None or scene.object_views is None or len(scene.object) != len(selected):
        return selected, ""
    number, own = len(scene.object_views), np.where(scene.seen, scene.object, -1)
    of_thing = own >= 0
    whole = np.bincount(own[of_thing], weights[of_thing], number)
    inside = np.bincount(own[of_thing & selected], weights[of_thing & selected], number)
    shares = inside / np.where(whole > 0, whole, 1.0)
    if not (inside > 0).any():
        return selected, ""
    means = scene.thing_means
    known = np.linalg.norm(means, axis=1) > 0
    near = known & (rivals.ahead_of_means(scene, means) <= rivals.allowed)
    others = means[known & ~near]  # what has no part in the answer
    words = rivals.vectors[np.unique((others @ rivals.vectors.T).argmax(axis=1))] if len(rivals.vectors) else others
    changed, grown, told = selected.copy(), 0, []
    for thing in np.flatnonzero(near & (shares >= SOME) & (inside < whole)).tolist():
        mine = own == thing
        part, rest = (scene.mean_of(np.flatnonzero(mine & side)) for side in (selected, ~selected))
        more = np.flatnonzero(mine & ~selected)
        if len(others) and _about(scene, others, rest).max() >= _about(scene, part[None], rest)[0]:
            if shares[thing] < MOST:
                continue
            more = _nearest_to(scene, more, means[known], int(known[:thing].sum()))
        elif shares[thing] < MOST and _nearer_both_ways(scene, words, rivals.directions, rest):
            continue
        changed[more] = True
        grown += bool(more.size)
    if grown:
        added = int(changed.sum() - selected.sum())
        told = [f"{_counted(added, 'more splat')} of {_counted(grown, 'thing')} mostly above it count too"]
    some = known & (inside > 0) & (shares < SOME)
    left = selected & np.isin(own, _other_things(scene, own, selected, some, rivals))
    if left.any() and weights[left].sum() < weights[selected].sum() / 2:
        changed &= ~left
        told += [f"{_counted(int(left.sum()), 'splat')} of things to which another word is nearer do not"]
    return changed, ", ".join(told)


def levels_disagree(scene: OpenedLift) -> bool:
    """Tell whether masks of parts say something else than masks of their wholes: a splat's feature is their sum."""
    agreement = (scene.metadata.certificate.get("objects") or {}).get("level_agreement")
    return agreement is not None and agreement < LEVELS_AGREE


def part_nodes(scene: OpenedLift, rivals: Rivals) -> list[int]:
    """The parts that a query's words name in a lift whose levels say different things; none where splats know better.

    A splat's feature is the sum of what all levels say, which the words of parts answer with their wholes. A node
    keeps what its own masks say. So the node that is nearest of all is taken, or the largest node above it that says
    the same, if the word is among the nearest there, and if it is a part of what says something else. Nodes that are
    nearer to the words than halfway from that whole to that part are parts of the same name.
    """
    nodes = _NodeMeanings.of(scene)
    if nodes is None:
        return []
    scores = (nodes.vectors @ rivals.directions.T).max(axis=1)
    return nodes.named(scores, rivals.ahead_of_means(scene, nodes.vectors) <= rivals.allowed)


def parts_of_words(scene: OpenedLift, references: References, words: np.ndarray) -> list[list[int]]:
    """The same for each of n words [n, F] f32, unit, alone; nodes are compared with the references once for all."""
    nodes = _NodeMeanings.of(scene)
    if nodes is None:
        return [[] for _ in words]
    plain = products(nodes.vectors, np.ones(len(nodes.vectors), np.float32), words, references.vectors)
    means = words @ scene.rough_mean, references.vectors @ scene.rough_mean
    centred = tuple(table - mean for table, mean in zip(plain, means, strict=True))
    found = []
    for row, word in enumerate(words):
        others, allowed = references.against(word)
        ahead = [(near[:, others] >= own[:, row, None]).sum(axis=1) for own, near in (plain, centred)]
        found.append(nodes.named(plain[0][:, row], np.minimum(*ahead) <= allowed))
    return found


@dataclass(frozen=True)
class _NodeMeanings:
    """What the nodes of a lift's tree say, where levels say different things."""

    scene: OpenedLift
    parents: np.ndarray  # [N] i32
    vectors: np.ndarray  # [N, F] f32, unit; zeros for none
    widest: np.ndarray  # [N] i64, the largest node above each, or itself, that says the same

    @classmethod
    def of(cls, scene: OpenedLift) -> _NodeMeanings | None:
        """None where levels say the same, or the lift has no tree."""
        parents = scene.node_parents
        if parents is None or scene.node_features is None or not levels_disagree(scene):
            return None
        vectors = scene.node_features.astype(np.float32)
        widest = np.arange(len(parents))
        for node in sorted(range(len(parents)), key=lambda one: len(scene.node_path(one))):
            whole = int(parents[node])
            if whole >= 0 and _about(scene, vectors[whole][None], vectors[node])[0] >= LEVELS_AGREE:
                widest[node] = widest[whole]
        return cls(scene, parents, vectors, widest)

    def named(self, scores: np.ndarray, sure: np.ndarray) -> list[int]:
        """The parts that a word names (`part_nodes`).

        Args:
            scores: [N] f32, how near it is to each node. sure: [N] bool, where it is among the nearest words.
        """
        known = np.linalg.norm(self.vectors, axis=1) > 0
        scores = np.where(known, scores, -1.0)
        node = int(self.widest[scores.argmax()])
        whole = int(self.parents[node])
        if whole < 0 or not known[whole] or not (known & sure)[node]:
            return []
        halfway = (scores[node] + scores[whole]) / 2
        others = np.flatnonzero(known & sure & (scores > halfway) & (self.parents >= 0))
        found, path = [node], self.scene.node_path
        for other in sorted(others.tolist(), key=lambda one: len(path(one))):
            if not any(one in path(other) or other in path(one) for one in found):
                found.append(other)
        return found


def things_within(scene: OpenedLift, selected: np.ndarray) -> np.ndarray:
    """[N] bool: the things of which `SOME` or more is among the selected splats [P] bool."""
    if scene.object is None or scene.object_views is None or len(scene.object) != len(selected):
        return np.zeros(0, np.bool_)
    of_thing, number = scene.seen & (scene.object >= 0), len(scene.object_views)
    whole, inside = (
        np.bincount(scene.object[rows], scene.evidence[rows], number) for rows in (of_thing, of_thing & selected)
    )
    return (inside > 0) & (inside >= SOME * whole)


def with_parts(scene: OpenedLift, selected: np.ndarray) -> np.ndarray:
    """[P] bool: the selected splats and the things of which `SOME` or more is, with parts that other words name."""
    things = things_within(scene, selected)
    return selected | (scene.seen & np.append(things, False)[scene.object]) if things.any() else selected


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def _other_things(
    scene: OpenedLift, own: np.ndarray, selected: np.ndarray, among: np.ndarray, rivals: Rivals
) -> list[int]:
    """The things to whose selected splats the word of the thing itself is nearer than the query's.

    Args:
        own: [P] i32, the thing of each splat, -1 for none. selected: [P] bool. among: [N] bool, the things looked at.
    """
    found = []
    for thing in np.flatnonzero(among).tolist() if len(rivals.vectors) else ():
        mean, part = scene.thing_means[thing], scene.mean_of(np.flatnonzero((own == thing) & selected))
        word = rivals.vectors[(rivals.vectors @ (mean - scene.rough_mean)).argmax()]  # words near to all are none
        pair = np.stack([mean, part])
        if ((word - rivals.directions) @ np.concatenate([pair, pair - scene.rough_mean]).T > 0).all():
            found.append(thing)
    return found


def _nearer_both_ways(scene: OpenedLift, words: np.ndarray, directions: np.ndarray, mean: np.ndarray) -> bool:
    """Tell whether a word of some [m, F] is nearer to a mean [F] than directions [p, F], also about the scene's mean.

    Words lie in a cone: one that is near to all of a scene is nearer to much that it does not mean.
    """
    sides = np.stack([mean, mean - scene.rough_mean])
    return bool(len(words)) and bool(((words @ sides.T) > (directions @ sides.T).max(axis=0)).all(axis=1).any())


def _nearest_to(scene: OpenedLift, rows: np.ndarray, means: np.ndarray, thing: int) -> np.ndarray:
    """Those of some splats [n] that are nearer to one of the things than to any other, about the scene's mean.

    Args:
        means: [N, F] f32, unit, of things. thing: its row.
    """
    offsets = means - scene.rough_mean
    offsets /= np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), np.float32(1e-12))
    shift, kept = offsets @ scene.rough_mean, []
    for first in range(0, len(rows), _AT_ONCE):
        some = rows[first : first + _AT_ONCE]
        along = products(scene.features[some], scene.norms[some], offsets, offsets[:0])[0] - shift
        kept.append(some[along.argmax(axis=1) == thing])
    return np.concatenate([rows[:0], *kept])


def _about(scene: OpenedLift, means: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """[n] f32, the cosines of unit features [n, F] and [F] about the scene's mean."""
    offsets, offset = means - scene.rough_mean, mean - scene.rough_mean
    lengths = np.linalg.norm(offsets, axis=1) * np.linalg.norm(offset)
    return (offsets @ offset) / np.maximum(lengths, np.float32(1e-12))


def _from_the_best(scores: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows [n] by their scores [P] f32, the highest first and equal ones in order.

    A score and its row are sorted as one integer, which takes a quarter of what a sort of indices does.
    """
    bits = (-scores[rows] + np.float32(0.0)).view(np.int32)  # no zero is negative, so that all zeros are equal
    keys = (bits ^ ((bits >> 31) & np.int32(0x7FFFFFFF))).astype(np.int64)  # in the order of the floats
    keys = (keys << 32) | rows
    keys.sort()
    return keys & 0xFFFFFFFF


def _octaves(order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a ranking [n], all of the first and ever fewer of the later ones, and how many each stands for."""
    rows, widths, first, last = [], [], 0, SAMPLED
    while first < len(order):
        some = order[first:last]
        step = -(-len(some) // SAMPLED)
        chosen = some[step // 2 :: step]
        rows.append(chosen)
        widths.append(np.full(len(chosen), len(some) / len(chosen)))
        first, last = last, 2 * last
    return np.concatenate(rows), np.concatenate(widths)
