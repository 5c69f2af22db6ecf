"""The objects of a lift, one by one: where each lies, how large it is, what shows it best, and its name.

Objects are found at lift time by masks alone (`liftcore.solve.objects`); the lift keeps one number a splat. They are
numbered from 0, the one with the most evidence first, the same for the same lift. An object's feature is the mean of
its splats' unit features by evidence. Its name is the nearest word, however far that is; the cosine says how far.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.objects import largest_box
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import ListedObjects, SceneObject
from liftcore.query.scores import cosines, norms_of
from liftcore.runtime.one_line import one_line
from liftcore.scene.origin import MAP_REACH
from liftcore.text import check_texts

MOST_WORDS = 65_536  # of a vocabulary: their vectors take 130 MB at 512 channels
NOT_LOOKED_FOR = (
    "this lift holds no objects: they are found by lifts of masks, by the preset default or the setting objects; "
    "grids have no masks"
)
NONE_FOUND = "no object: masks of three views never keep the same splats together"
_BLOCK = 1 << 14  # rows of features widened at once


@dataclass(frozen=True)
class Catalogue:
    """All objects of a lift."""

    objects: tuple[SceneObject, ...]
    explanation: str
    """why there are as many as there are"""
    features: np.ndarray
    """[N, F] f32, unit means; zero where no splat has a feature"""

    def __repr__(self) -> str:
        some = ", ".join(f"{one.name or one.id}: {one.splats}" for one in self.objects)
        return one_line(self, f"{len(self.objects)} objects", f"features={list(self.features.shape)}", some or "none")

    def listed(self, first: int = 0, last: int | None = None, *, features: bool = False) -> Iterator[SceneObject]:
        """The objects from a place to another; with ``features`` each has its mean feature."""
        rows = zip(self.objects[first:last], self.features[first:last], strict=True)
        return (one.model_copy(update={"feature": tuple(row.tolist())}) if features else one for one, row in rows)

    def summary(self, *, features: bool = False) -> ListedObjects:
        """All of them, as JSON has them."""
        things = tuple(self.listed(features=features))
        return ListedObjects(explanation=self.explanation, count=len(things), objects=things)


def catalogue(scene: OpenedLift, words: Sequence[str] = (), vectors: Any = None) -> Catalogue:
    """The objects of a lift, named by the nearest of some words.

    Args:
        scene: an opened lift. words: n. vectors: [n, F], torch or numpy, their text vectors.

    Raises:
        InvalidQuery: words without vectors, too many, or vectors that are no directions of the lift's space.
        InvalidLift: the splats moved or changed since the lift.
    """
    if scene.object is None or scene.object_views is None:
        return Catalogue((), NOT_LOOKED_FOR, np.zeros((0, scene.channels), np.float32))
    labels, number = scene.object, len(scene.object_views)
    features = object_features(scene)
    names, scores = _named(features, words, vectors)
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(number + 1))
    evidence = scene.evidence.astype(np.float64)
    whole, known = evidence.sum() or 1.0, scene.metadata.views
    found = []
    for one in range(number):
        rows = order[ends[one] : ends[one + 1]]
        weights = evidence[rows] if evidence[rows].any() else np.ones(rows.size)
        box = largest_box(scene.splats, rows, weights)
        x, y, z = np.mean(box, axis=0).tolist()
        found.append(
            SceneObject(
                id=one,
                name=names[one],
                score=scores[one],
                splats=int(rows.size),
                share=float(evidence[rows].sum() / whole),
                centre=(x, y, z),
                box=box,
                views=tuple(known[view] for view in scene.object_views[one] if 0 <= view < len(known)),
            )
        )
    told = f"{number} objects, which masks of three or more views keep together" if number else NONE_FOUND
    return Catalogue(tuple(found), told, features)


def object_features(scene: OpenedLift) -> np.ndarray:
    """[N, F] f32: the unit mean of each object's unit features, by evidence; zeros where none has a feature."""
    from scipy.sparse import csr_array

    assert scene.object is not None and scene.object_views is not None
    number = len(scene.object_views)
    sums = np.zeros((number, scene.channels))
    weights = np.where(scene.seen, scene.evidence / np.where(scene.seen, scene.norms, 1.0), 0.0)
    chosen = np.flatnonzero((scene.object >= 0) & (weights > 0))
    for first in range(0, chosen.size, _BLOCK):
        rows = chosen[first : first + _BLOCK]
        places = scene.object[rows], np.arange(rows.size)
        shares = csr_array((weights[rows].astype(np.float64), places), shape=(number, rows.size))
        sums += shares @ scene.features[rows].astype(np.float32)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0).astype(np.float32)


def _named(features: np.ndarray, words: Sequence[str], vectors: Any) -> tuple[list[str | None], list[float | None]]:
    """Name and cosine of each object; None without words, and for an object without a feature."""
    number = len(features)
    check_texts(words, "words")
    if not words:
        return [None] * number, [None] * number
    rows = None if vectors is None else np.atleast_2d(np.asarray(as_numpy(vectors), np.float32))
    if rows is None or len(rows) != len(words) or len(words) > MOST_WORDS:
        got = f"{len(words)} words and {0 if rows is None else len(rows)} vectors"
        raise InvalidQuery("words", expected=f"at most {MOST_WORDS} words, a vector each", got=got)
    if rows.shape[1] != features.shape[1] or not np.isfinite(rows).all() or not rows.any(axis=1).all():
        expected = f"finite vectors of {features.shape[1]} channels, as the lift has, none of them zero"
        raise InvalidQuery("words", expected=expected, got=f"vectors of {rows.shape[1]} channels")
    nearest, best = np.zeros(number, np.int64), np.full(number, -np.inf, np.float32)
    norms = norms_of(features)
    for first in range(0, len(words), 256):
        scores = cosines(features, norms, rows[first : first + 256])
        place = scores.argmax(axis=1)
        higher = scores[np.arange(number), place] > best
        nearest[higher], best[higher] = first + place[higher], scores[np.arange(number), place][higher]
    known = norms > 0
    names = [words[row] if has else None for row, has in zip(nearest.tolist(), known, strict=True)]
    return names, [score if has else None for score, has in zip(best.tolist(), known, strict=True)]


def table_csv(found: Catalogue) -> bytes:
    """The catalogue as a table: a line an object."""
    content = io.StringIO(newline="")
    writer = csv.writer(content)
    corners = [f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"]
    writer.writerow(["id", "name", "score", "splats", "share", "x", "y", "z", *corners, "views"])
    for one in found.objects:
        low, high = one.box
        named = "" if one.name is None else one.name, "" if one.score is None else f"{one.score:.6g}"
        digits = 9 if max(map(abs, (*low, *high))) < MAP_REACH else 15  # as many as the boxes' numbers have
        numbers = (f"{value:.{digits}g}" for value in (one.share, *one.centre, *low, *high))
        writer.writerow([one.id, *named, one.splats, *numbers, " ".join(one.views)])
    return content.getvalue().encode()


def one_object_splats(scene: OpenedLift, number: int, suffix: str = ".ply") -> Iterable[bytes]:
    """The splats of one object, as a file in blocks; of a PLY every property of theirs to the byte.

    Raises:
        NotFound: the lift has no object of that number.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import some_rows

    return some_rows(scene.splat_file, object_members(scene, number), suffix)


def object_members(scene: OpenedLift, number: int) -> np.ndarray:
    """[P] bool, the splats of an object; NotFound where the lift has none of that number."""
    count = 0 if scene.object_views is None else len(scene.object_views)
    if scene.object is None or not 0 <= number < count:
        expected = f"a number from 0 to {count - 1}" if count else "a lift with objects"
        raise NotFound("object", expected=expected, got=str(number), hint="the list of the lift's objects has them")
    return scene.object == number
