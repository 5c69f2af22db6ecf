"""Presence of a word's object in a scene: a comparison of the word's best splats with other words.

A score is highest where a scene is most similar to a word, even if the object is not in the scene. So the splats most
similar to the word are compared with some hundreds of **reference words** of the same encoder. If the object is in
the scene, its word is among the nearest of them; else the words of the objects that are there are nearer.

    presence = share, by total weight, of the word's best splats at which at most MOST_NEARER references are nearer

This share is computed twice: from the cosines, and about the scene's mean, which removes what all features of the
scene share. (Features of images and of words lie apart, and some words are nearer to all images than the right ones.)
The word is present if both shares are at least a half. It is absent if the first is below a half and, about the mean,
the word is the nearest of all for less than a half. Otherwise the answer is **not sure**, and the threshold selects.

- A phrase that is not among the references may have twice as many nearer words, as these are more specific.
- The best splats are the few with LEAST_SHARE of the scene's total weight: a threshold selects no less either.
- References related to the word, with at least RELATED of the similarity of its nearest reference, are left out:
  a synonym does not compete. All words of an encoder share a cone, so they are compared about their mean.

Reference words are the words of a table if it has enough of them, else the shipped ones of CLIP ViT-B/32, else
vectors that the encoder computes once for the same words, which are cached in the user's cache folder.
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

import numpy as np

from liftcore.errors import InvalidQuery, InvalidTable, Unavailable
from liftcore.query.question import Presence
from liftcore.query.scene import Scene
from liftcore.query.scores import spaced
from liftcore.query.threshold import LEAST_SHARE
from liftcore.runtime.folders import cache_folder
from liftcore.text import LVIS_TABLE, CachingEncoder, TextEncoder
from liftcore.text.table import TableEncoder
from liftcore.text.wording import base_of, normalize_text

LEAST_WORDS = 200  # of a table, to be references
WORD_STEP = 4  # an encoder without references encodes each 4th of the shipped words: 301 take seconds
MOST_NEARER = 0.0033  # share of the references that may be nearer to a splat than its own word: synonyms, wrong masks
_ITSELF = 0.9  # similarity about the mean from which a word is one of the references
LEAST_OF_SCENE = 0.9  # share of a scene, at which a word is among the nearest, from which all of it is of one thing
RELATED = 0.55  # of the similarity of a word's nearest reference, from which references are left out
_FIRST = 1_024  # splats among which the best ones are searched first
MOST_SPLATS = 256  # of the best ones that are compared, those with the largest total weight
_SAME_TEXT = 0.99  # least cosine of two vectors of one text that come from one encoder
_IN_CONE = 0.5  # cosine to the shipped words' mean direction: they have .75 to .93, other spaces' vectors about 0


@dataclass(frozen=True)
class References:
    """Words of a text space that others are compared with."""

    words: tuple[str, ...]
    vectors: np.ndarray  # [n, F] f32, unit

    @cached_property
    def mean(self) -> np.ndarray:
        """[F] f32, the mean of all words, which they share."""
        return self.vectors.mean(axis=0, dtype=np.float64).astype(np.float32)

    @cached_property
    def _about_mean(self) -> np.ndarray:
        return _unit(self.vectors - self.mean)

    @cached_property
    def plain_words(self) -> tuple[str, ...]:
        """The words in plain spelling, without the suffixes that distinguish their meanings."""
        return tuple(normalize_text(base_of(word)) for word in self.words)

    def against(self, direction: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the references to compare a unit vector [F] of the same space with.

        Returns:
            [m] i64, the words of another meaning, and how many of them may be nearer if the object is present.
        """
        similar = self._about_mean @ _unit(direction - self.mean)
        nearest = float(similar.max())
        limit = math.ceil(MOST_NEARER * len(self.words) * (1 if nearest >= _ITSELF else 2))
        return np.flatnonzero(similar < max(RELATED * nearest, np.finfo(np.float32).eps)), limit


def estimate_presence(
    scene: Scene, name: str, direction: np.ndarray, scores: np.ndarray, references: References
) -> Presence:
    """Estimate if the object of a word is in the scene.

    Args:
        scene: an opened lift. name: the word, as in the answer's explanation.
        direction: [F] f32, its unit vector. scores: [P] f32, the cosine of every splat to it.
        references: words of its text space.
    """
    best, weights = best_splats(scene, scores)
    if not len(best):
        return Presence(present=False, presence=0.0, reason=f"{name} is not there: no splat has a feature.")
    reference_rows, limit = references.against(direction)
    rows, norms, count = scene.features[best], scene.norms[best], len(references.words)
    nearer, contrast = nearer_counts(
        rows, norms, scene.rough_mean, direction[None], references.vectors[reference_rows]
    )
    shares = [float(weights[counts <= limit].sum() / weights.sum()) for counts in (nearer, contrast)]
    if (
        shares[0] >= 0.5 > shares[1]
        and _near_share(scene, direction, references.vectors[reference_rows], limit) >= LEAST_OF_SCENE
    ):
        shares[1] = shares[0]  # all is of one thing, so nothing sets its splats apart from the rest
    presence = min(shares)
    if presence >= 0.5:
        facts = f"at {presence:.0%} of its best splats at most {limit} of {count} other words are nearer"
        return Presence(present=True, presence=presence, reason=f"{name} is there: {facts}.")
    near = weights @ products(rows, norms, direction[None], references.vectors[reference_rows])[1]
    nearest = references.words[reference_rows[int(near.argmax())]].replace("_", " ")
    facts = f"its best splats are nearer to others of {count} words, first of all to {nearest!r}"
    first = float(weights[contrast == 0].sum() / weights.sum())
    if shares[0] < 0.5 and first < 0.5:
        reason = f"{name} is not there: {facts}."
        return Presence(present=False, presence=presence, reason=reason)
    if shares[0] < 0.5:
        facts += ", but to what sets them apart from the rest of the scene it is the nearest"
    else:
        facts = (
            "hardly any other word is nearer to its best splats, but many are to what sets them apart from the rest"
        )
    reason = f"Whether {name} is there is not sure: {facts}."
    return Presence(present=None, presence=presence, reason=reason)


def _near_share(scene: Scene, direction: np.ndarray, references: np.ndarray, limit: int) -> float:
    """Return the share of a scene, by a sample of its splats, at which at most ``limit`` references are nearer."""
    rows = spaced(np.flatnonzero(scene.has_feature), MOST_SPLATS)
    counts = nearer_counts(scene.features[rows], scene.norms[rows], scene.rough_mean, direction[None], references)
    return float(np.average(counts[0] <= limit, weights=scene.total_weight[rows] + np.float32(1e-30)))


def nearer_counts(
    features: np.ndarray, norms: np.ndarray, mean: np.ndarray, directions: np.ndarray, references: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Count the other words that are as near to splats as the nearest of some words: by cosine, and about a mean.

    Args:
        features: [n, F] f16 or f32. norms: [n] f32. mean: [F] f32, of unit features.
        directions: [p, F] f32, unit, the words. references: [m, F] f32, unit.

    Returns:
        [n] i64 twice.
    """
    if not len(references):
        return np.zeros(len(features), np.int64), np.zeros(len(features), np.int64)
    own_cosines, reference_cosines = products(features, norms, directions, references)
    nearer = (reference_cosines >= own_cosines.max(axis=1, keepdims=True)).sum(axis=1)
    own_cosines -= directions @ mean
    reference_cosines -= references @ mean
    return nearer, (reference_cosines >= own_cosines.max(axis=1, keepdims=True)).sum(axis=1)


def products(
    features: np.ndarray, norms: np.ndarray, directions: np.ndarray, references: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the cosines [n, p] and [n, m] f32 of splats with words and with others, by one matrix product.

    For some thousands of splats and a thousand words it takes a fifth of the time of `scores.cosines`, in which the
    bits of a row do not depend on the other rows. Arguments as of `nearer_counts`; a zero row has zeros.
    """
    unit = features.astype(np.float32)
    unit /= np.maximum(norms, np.finfo(np.float32).tiny)[:, None]
    along = unit @ np.concatenate([directions, references]).T
    return along[:, : len(directions)], along[:, len(directions) :]


NOT_IN_WORDS = Presence(
    present=None, presence=None, reason="Nothing was asked in words: what an example shows is not questioned."
)


def any_present(words: Sequence[Presence]) -> Presence:
    """Combine the presences of one or more words: present if one of them is."""
    first = max(words, key=lambda word: (word.present is not False, word.present is True, word.presence or 0.0))
    reason = " ".join(word.reason for word in words)
    return Presence(present=first.present, presence=first.presence, reason=reason)


def best_splats(
    scene: Scene, scores: np.ndarray, selected: np.ndarray | bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return the splats of the highest scores [P] that have LEAST_SHARE of the total weight, and their weights.

    Args:
        selected: [P] bool, the splats among which they are; all of them if these have less.

    Returns:
        [m] i64, at most MOST_SPLATS, descending by score; and [m] f64, their total weight.
    """
    total_weight = np.where(scene.has_feature, scene.total_weight, np.float32(0.0))
    total_weight = total_weight if total_weight.any() else scene.has_feature.astype(np.float32)
    least, count = LEAST_SHARE * float(total_weight.sum(dtype=np.float64)), min(_FIRST, len(scores))
    ranked = np.where(scene.has_feature & selected, -scores, np.float32(np.inf))
    while True:  # a quarter of the time of a complete order
        rows = np.argpartition(ranked, count - 1)[:count] if count < len(ranked) else np.arange(count)
        if count == len(ranked) or total_weight[rows].sum(dtype=np.float64) >= least:
            break
        count = min(4 * count, len(ranked))
    rows = rows[np.lexsort((rows, ranked[rows]))]
    rows = rows[: int(np.searchsorted(np.cumsum(total_weight[rows], dtype=np.float64), least)) + 1]
    rows = rows[(total_weight[rows] > 0) & (ranked[rows] < np.inf)]
    heaviest = np.sort(np.argsort(-total_weight[rows], kind="stable")[:MOST_SPLATS])
    return rows[heaviest], total_weight[rows[heaviest]].astype(np.float64)


def table_of(encoder: TextEncoder | None) -> TableEncoder | None:
    """Return the table of words of an encoder; None for any other encoder."""
    source = encoder.source if isinstance(encoder, CachingEncoder) else encoder
    return source if isinstance(source, TableEncoder) else None


def references_of(encoder: TextEncoder, text_space: str) -> References | str:
    """Return the reference words of an encoder, or the reason why there are none.

    A table with enough words is its own reference. Any other encoder encodes some hundreds of words once.

    Args:
        encoder: of the words' vectors. text_space: of the lift, "" for none.
    """
    source = table_of(encoder)
    if source is not None:
        if len(source.words) >= LEAST_WORDS:
            return _of_table(source)
        return references_of_space(source.embeddings, text_space)
    shipped, cached = _shipped(), _cached_references(encoder.name)
    try:
        for candidate, first in ((shipped, f"a {shipped.words[0]}"), (cached, shipped.words[0])):
            if candidate is not None and candidate.vectors.shape[1] == encoder.channels:
                (vector,) = encoder.encode([first])
                if float(candidate.vectors[0] @ _unit(np.asarray(vector, np.float32))) >= _SAME_TEXT:
                    return candidate
        words = shipped.words[::WORD_STEP]
        references = References(words, _unit(np.asarray(encoder.encode(words), np.float32)))
    except (InvalidQuery, Unavailable) as error:
        return f"Whether it is there is not known: {encoder.name} makes no reference words ({error})."
    _cache_references(encoder.name, references)
    return references


def references_of_space(vectors: np.ndarray, text_space: str) -> References | str:
    """Return the reference words of the space of some unit vectors [n, F] of words, or the reason why there are none.

    Without an encoder nothing is computed. The cached references of the lift's text space are taken, or the shipped
    ones if all of the vectors lie in the narrow cone of CLIP ViT-B/32's words.
    """
    cached, channels = _cached_references(text_space) if text_space else None, vectors.shape[1]
    if cached is not None and cached.vectors.shape[1] == channels:
        return cached
    if channels == _shipped().vectors.shape[1] and (vectors @ _unit(_shipped().mean) >= _IN_CONE).all():
        return _shipped()
    space = f"the text space {text_space!r}" if text_space else "a text space without a name"
    remedy = f"a text table of {LEAST_WORDS} words or more, or a text encoder, has some"
    return f"Whether it is there is not known: {space} has no reference words here; {remedy}."


def small_table_of(encoder: TextEncoder) -> np.ndarray | None:
    """Return all words of a table that has too few to be references, [n, F] f32, unit; None for another encoder.

    They compete with each other: the table's author distinguishes these words and no others.
    """
    source = table_of(encoder)
    if source is not None and 1 < len(source.words) < LEAST_WORDS:
        return _unit(np.asarray(source.embeddings, np.float32))
    return None


@lru_cache(4)
def _of_table(table: TableEncoder) -> References:
    """Return a table's words as references, cached as queries share their means."""
    return References(table.words, table.embeddings)


@cache
def _shipped() -> References:
    table = TableEncoder.open(LVIS_TABLE)
    return References(table.words, table.embeddings)


def _cache_path(name: str) -> Path:
    return cache_folder("references") / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.safetensors"


def _cached_references(name: str) -> References | None:
    """Return the cached references of an encoder's name; None if there are none, or their file is invalid."""
    with suppress(InvalidTable, OSError):
        if (path := _cache_path(name)).is_file():
            table = TableEncoder.open(path)
            return References(table.words, table.embeddings)
    return None


def _cache_references(name: str, references: References) -> None:
    """Write the references of an encoder's name to the cache; a cache that cannot be written stays as it is."""
    from safetensors.numpy import save

    from liftcore.io.files import whole_file

    metadata = {"encoder": name, "words": json.dumps(references.words)}
    with suppress(OSError), whole_file(_cache_path(name)) as file:
        vectors = np.ascontiguousarray(references.vectors, np.float16)  # `save` writes the memory in its order
        file.write(save({"embeddings": vectors}, metadata=metadata))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Scale rows [.., F] f32 to length one; zeros stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32(1e-30))
