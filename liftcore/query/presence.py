"""Whether a thing is there at all: a word's best splats, asked for other words too.

A score says where a scene is most like a word, never whether it is there. So the splats that are most like the word
are compared with some hundreds of **reference words** of the same encoder. A thing that is there is among the first
of them; for one that is not, the words of what really is there come first, and many more with them.

    presence = share, by evidence, of the word's best splats at which at most MOST_AHEAD of the references are nearer

taken twice: with the words as they lie, and about the scene's mean, which takes away what all of a scene's features
share. (Images lie apart from words, and some words lie nearer to all images than the right ones.) It is present where
both shares are a half or more. It is absent where the first is less and, about the mean, not even a half has the word
as the nearest of all. Between these it is **not sure**: there is no saying, and what stands apart is shown. A phrase
that is none of the references may have twice as many ahead: they are more
to the point than it is. The best splats are the few with LEAST_SHARE of the scene's evidence: less is no
thing to a threshold either. A reference that means nearly the same takes nothing away: those related to the word,
with RELATED of the similarity of the word's nearest reference, are left out (an encoder's words share a cone, so they
are compared about their mean). ``tests.benchmarks.presence`` is where the constants are measured.

Reference words are a table's own where it has enough of them, else those that ship for CLIP ViT-B/32, else what the
encoder makes once of the same words and keeps in the user's cache.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from liftcore.errors import InvalidQuery, InvalidTable, Unavailable
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import Presence
from liftcore.query.threshold import LEAST_SHARE
from liftcore.runtime.folders import cache_folder
from liftcore.text import LVIS_TABLE, RememberingEncoder, TextEncoder
from liftcore.text.table import TableEncoder
from liftcore.text.wording import base_of, plain

LEAST_WORDS = 200  # of a table, to be references
EVERY = 4  # of the shipped words, that another encoder is asked for: 301 take it seconds
MOST_AHEAD = 0.0033  # of the references, that may be nearer to a splat than what is there: synonyms, wrong masks
_ITSELF = 0.9  # similarity about the mean from which a word is one of the references
RELATED = 0.55  # of the similarity of a word's nearest reference, from which references are left out
MOST_SPLATS = 256  # of the best ones that are looked at, those with the most evidence
_FIRST = 1_024  # splats in which the best ones are looked for at first
_SAME = 0.99  # cosine of two vectors of one text that come from one encoder
_IN_CONE = 0.5  # cosine to the shipped words' mean direction: they have .75 to .93, other spaces' vectors about 0


@dataclass(frozen=True)
class References:
    """Words of a text space that others are compared with."""

    words: tuple[str, ...]
    vectors: np.ndarray  # [n, F] f32, unit

    @classmethod
    def of(cls, vectors: Any, channels: int) -> Self:
        """Of vectors [n, F], torch or numpy, of any length above zero.

        Raises:
            InvalidQuery: too few, of another length, of zeros or not finite.
        """
        rows = np.asarray(as_numpy(vectors), np.float32)
        lengths = np.linalg.norm(rows, axis=-1)
        if (
            rows.ndim != 2
            or len(rows) < LEAST_WORDS
            or rows.shape[1] != channels
            or not (np.isfinite(lengths) & (lengths > 0)).all()
        ):
            expected = f"finite vectors of {LEAST_WORDS} words or more, [n, {channels}], each with a direction"
            raise InvalidQuery("references", expected=expected, got=f"the shape {list(rows.shape)}, or zeros or NaN")
        return cls(tuple(f"number {row}" for row in range(len(rows))), _unit(rows))

    @cached_property
    def mean(self) -> np.ndarray:
        """[F] f32, what all words share."""
        return self.vectors.mean(axis=0, dtype=np.float64).astype(np.float32)

    @cached_property
    def _about_mean(self) -> np.ndarray:
        return _unit(self.vectors - self.mean)

    @cached_property
    def plain_words(self) -> tuple[str, ...]:
        """The words as they are compared with others, without what tells their meanings apart."""
        return tuple(plain(base_of(word)) for word in self.words)

    def against(self, direction: np.ndarray) -> tuple[np.ndarray, int]:
        """What a unit vector [F] of the same space is compared with.

        Returns:
            [m] i64, the words that mean something else, and how many of them may be nearer to what is there.
        """
        similar = self._about_mean @ _unit(direction - self.mean)
        nearest = float(similar.max())
        allowed = math.ceil(MOST_AHEAD * len(self.words) * (1 if nearest >= _ITSELF else 2))
        return np.flatnonzero(similar < max(RELATED * nearest, np.finfo(np.float32).eps)), allowed


def judge(
    scene: OpenedLift, name: str, direction: np.ndarray, scores: np.ndarray, references: References
) -> Presence:
    """Say whether a word is there.

    Args:
        scene: an opened lift. name: of the word, as the answer tells it.
        direction: [F] f32, its unit vector. scores: [P] f32, every splat's cosine to it.
        references: of its text space.
    """
    best, weights = best_splats(scene, scores)
    if not len(best):
        return Presence(present=False, presence=0.0, why=f"{name} is not there: no splat has a feature.")
    others, allowed = references.against(direction)
    rows, norms, count = scene.features[best], scene.norms[best], len(references.words)
    nearer, contrast = nearer_counts(rows, norms, scene.rough_mean, direction[None], references.vectors[others])
    shares = [float(weights[ahead <= allowed].sum() / weights.sum()) for ahead in (nearer, contrast)]
    presence = min(shares)
    if presence >= 0.5:
        told = f"at {presence:.0%} of its best splats at most {allowed} of {count} reference words are nearer"
        return Presence(present=True, presence=presence, why=f"{name} is there: {told}.")
    order = np.argsort(nearer, kind="stable")
    middle = int(nearer[order[np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]])
    near = weights @ products(rows, norms, direction[None], references.vectors[others])[1]
    nearest = references.words[others[int(near.argmax())]].replace("_", " ")
    told = f"its best splats are nearer to {middle} of {count} reference words, first of all to {nearest!r}"
    first = float(weights[contrast == 0].sum() / weights.sum())
    if shares[0] < 0.5 and first < 0.5:
        return Presence(present=False, presence=presence, why=f"{name} is not there: {told}.")
    if shares[0] < 0.5:
        yet = "but to what sets them apart from the rest of the scene it is the nearest"
        return Presence(present=None, presence=presence, why=f"Whether {name} is there is not sure: {told}, {yet}.")
    told = "hardly a reference word is nearer to its best splats, but many are to what sets them apart from the rest"
    return Presence(present=None, presence=presence, why=f"Whether {name} is there is not sure: {told}.")


def nearer_counts(
    features: np.ndarray, norms: np.ndarray, mean: np.ndarray, directions: np.ndarray, others: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How many other words are as near to splats as the nearest of some words: as they lie, and about a mean.

    Args:
        features: [n, F] f16 or f32. norms: [n] f32. mean: [F] f32, of unit features.
        directions: [p, F] f32, unit, the words. others: [m, F] f32, unit.

    Returns:
        [n] i64 twice.
    """
    if not len(others):
        return np.zeros(len(features), np.int64), np.zeros(len(features), np.int64)
    own, near = products(features, norms, directions, others)
    nearer = (near >= own.max(axis=1, keepdims=True)).sum(axis=1)
    own -= directions @ mean
    near -= others @ mean
    return nearer, (near >= own.max(axis=1, keepdims=True)).sum(axis=1)


def products(
    features: np.ndarray, norms: np.ndarray, directions: np.ndarray, others: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The cosines [n, p] and [n, m] f32 of some splats with some words and with many others, by one matrix product.

    Of some thousands of splats and a thousand words it takes a fifth of what `scores.cosines` does, whose bits depend
    on no other row. Arguments as of `nearer_counts`; a zero row has zeros.
    """
    unit = features.astype(np.float32)
    unit /= np.maximum(norms, np.finfo(np.float32).tiny)[:, None]
    along = unit @ np.concatenate([directions, others]).T
    return along[:, : len(directions)], along[:, len(directions) :]


NOT_IN_WORDS = Presence(
    present=None, presence=None, why="Nothing was asked in words: what an example shows is not questioned."
)


def together(words: Sequence[Presence]) -> Presence:
    """Whether any of one or more words is there."""
    first = max(words, key=lambda one: (one.present is not False, one.present is True, one.presence or 0.0))
    return Presence(present=first.present, presence=first.presence, why=" ".join(one.why for one in words))


def best_splats(scene: OpenedLift, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The splats of the highest scores [P] that have LEAST_SHARE of the evidence, and how much each counts.

    Returns:
        [m] i64, at most MOST_SPLATS, descending by score; and [m] f64, their evidence.
    """
    evidence = np.where(scene.seen, scene.evidence, np.float32(0.0))
    evidence = evidence if evidence.any() else scene.seen.astype(np.float32)
    least, count = LEAST_SHARE * float(evidence.sum(dtype=np.float64)), min(_FIRST, len(scores))
    ranked = -scores if scene.all_seen else np.where(scene.seen, -scores, np.float32(np.inf))
    while True:
        rows = np.argpartition(ranked, count - 1)[:count] if count < len(ranked) else np.arange(count)
        if count == len(ranked) or evidence[rows].sum(dtype=np.float64) >= least:
            break
        count = min(4 * count, len(ranked))
    rows = rows[np.lexsort((rows, ranked[rows]))]
    rows = rows[: int(np.searchsorted(np.cumsum(evidence[rows], dtype=np.float64), least)) + 1]
    rows = rows[evidence[rows] > 0]
    heaviest = np.sort(np.argsort(-evidence[rows], kind="stable")[:MOST_SPLATS])
    return rows[heaviest], evidence[rows[heaviest]].astype(np.float64)


def references_of(encoder: TextEncoder, text_space: str) -> References | str:
    """The reference words of an encoder, or why there are none.

    A table with enough words has its own. Any other encoder is asked once for some hundreds of words.

    Args:
        encoder: that makes the words' vectors. text_space: that the lift names, "" for none.
    """
    source = encoder.source if isinstance(encoder, RememberingEncoder) else encoder
    if isinstance(source, TableEncoder):
        if len(source.words) >= LEAST_WORDS:
            return _of_table(source)
        return references_beside(source.embeddings, text_space)
    shipped, kept = _shipped(), _kept(encoder.name)
    try:
        for known, first in ((shipped, f"a {shipped.words[0]}"), (kept, shipped.words[0])):
            if known is not None and known.vectors.shape[1] == encoder.channels:
                (vector,) = encoder.encode([first])
                if float(known.vectors[0] @ _unit(np.asarray(vector, np.float32))) >= _SAME:
                    return known
        words = shipped.words[::EVERY]
        made = References(words, _unit(np.asarray(encoder.encode(words), np.float32)))
    except (InvalidQuery, Unavailable) as error:
        return f"Whether it is there is not known: {encoder.name} makes no reference words ({error})."
    _keep(encoder.name, made)
    return made


def references_beside(vectors: np.ndarray, text_space: str) -> References | str:
    """The reference words of the space that unit vectors [n, F] of words lie in, or why there are none.

    Without an encoder nothing is computed: references kept for the space that the lift names are taken, and the
    shipped ones where all of the vectors lie in the narrow cone of that encoder's words.
    """
    kept, channels = _kept(text_space) if text_space else None, vectors.shape[1]
    if kept is not None and kept.vectors.shape[1] == channels:
        return kept
    if channels == _shipped().vectors.shape[1] and (vectors @ _unit(_shipped().mean) >= _IN_CONE).all():
        return _shipped()
    space = f"the text space {text_space!r}" if text_space else "a text space without a name"
    needed = f"a text table of {LEAST_WORDS} words or more, or a text encoder, has some"
    return f"Whether it is there is not known: {space} has no reference words here; {needed}."


def pack_of(encoder: TextEncoder) -> np.ndarray | None:
    """All words of a table that has too few to be references, [n, F] f32, unit; None for any other encoder.

    They are the references of each other: its author distinguishes these words and no others.
    """
    source = encoder.source if isinstance(encoder, RememberingEncoder) else encoder
    if isinstance(source, TableEncoder) and 1 < len(source.words) < LEAST_WORDS:
        return _unit(np.asarray(source.embeddings, np.float32))
    return None


@lru_cache(4)
def _of_table(table: TableEncoder) -> References:
    """A table's own words, with what questions share of them."""
    return References(table.words, table.embeddings)


@cache
def _shipped() -> References:
    table = TableEncoder.open(LVIS_TABLE)
    return References(table.words, table.embeddings)


def _place(name: str) -> Path:
    return cache_folder("references") / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.safetensors"


def _kept(name: str) -> References | None:
    """What this machine keeps of an encoder's name; a broken file is none."""
    with suppress(InvalidTable, OSError):
        if (path := _place(name)).is_file():
            table = TableEncoder.open(path)
            return References(table.words, table.embeddings)
    return None


def _keep(name: str, made: References) -> None:
    """Keep them for the next time; a cache that cannot be written keeps nothing."""
    from safetensors.numpy import save

    from liftcore.io.files import whole_file

    told = {"encoder": name, "words": json.dumps(made.words)}
    with suppress(OSError), whole_file(_place(name)) as file:
        vectors = np.ascontiguousarray(made.vectors, np.float16)  # `save` writes memory as it lies
        file.write(save({"embeddings": vectors}, metadata=told))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows [.., F] f32 of length one; zeros stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32(1e-30))
