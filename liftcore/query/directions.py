"""The directions in feature space that a query names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.areas import area_feature
from liftcore.query.presence import table_of
from liftcore.query.question import Query
from liftcore.query.scene import Scene, as_numpy
from liftcore.query.terms import Area, Example, SplatSet, SplatTerm, Term, Vector, parse_example
from liftcore.text import TextEncoder, check_texts
from liftcore.text.phrases import PartPhrase, part_phrases, read_phrase
from liftcore.text.wording import Wording, shipped_words


class ReadQuery(NamedTuple):
    """A query whose texts are names, and the phrases that they were read from."""

    query: Query  # with the places of the phrases, for errors
    phrases: Mapping[int, tuple[str, str]]  # by the index of a term: the phrase, and "list", "negation" or "quotes"


def read_query(query: Query, encoder: TextEncoder | None) -> ReadQuery:
    """Read the texts of a query (`liftcore.text.phrases`): a list is several, a negation has negatives too."""
    source = table_of(encoder)
    is_word = None if source is None else source.vocabulary.has_word
    terms = list[tuple[bool, bool, int, str, Term]]()  # negative, example, index in the query, form, and the term
    for place, term in enumerate(query.terms):
        is_negative = place >= len(query.positives)
        if not isinstance(term, str):
            terms.append((is_negative, True, place, "", term))
            continue
        with _errors_of(query, place):
            check_texts([term])
            reading = read_phrase(term, is_word)
            if is_negative and reading.negatives:
                raise InvalidQuery("negatives", expected="names of what it is not", got=repr(term[:80]))
        form = "quotes" if reading.is_quoted else "list" if reading.negatives or reading.names != (term,) else ""
        terms.extend((is_negative, False, place, form, name) for name in reading.names)
        terms.extend((True, False, place, "negation", name) for name in reading.negatives)
    terms.sort(key=itemgetter(0, 1))
    positives, negatives = ([entry[-1] for entry in terms if entry[0] is side] for side in (False, True))
    if source is not None and len(positives) > 1:
        for _, is_example, place, _, name in terms:
            part = None if is_example else source.vocabulary.find_part(str(name))
            if part is not None and part.sure:
                raise InvalidQuery(query.places[place], expected="a part of an object alone", got=repr(name))
    phrases = {index: (str(query.terms[place]), form) for index, (_, _, place, form, _) in enumerate(terms) if form}
    if not phrases:
        return ReadQuery(query, {})
    options = Query.model_fields.keys() - {"text", "like", "negatives", "unlike"}
    read = Query.of(positives, negatives, **{name: getattr(query, name) for name in options})
    vars(read)["places"] = [query.places[place] for _, _, place, _, _ in terms]
    return ReadQuery(read, phrases)


def wordings(scene: Scene, query: Query, encoder: TextEncoder | None) -> dict[int, Wording]:
    """Return the wording of each text among the terms, by its index: the word of a table, else the text itself."""
    source = table_of(encoder)
    texts = {place: term for place, term in enumerate(query.terms) if isinstance(term, str)}
    if source is None:
        return {place: Wording(text, text, "") for place, text in texts.items()}
    by_place: dict[int, Wording] = {}
    for place, text in texts.items():
        with _errors_of(query, place):
            word = source.vocabulary.find(text)
            if word is None:
                raise source.refusal(text, object_words(scene, source.words, source.embeddings))
        by_place[place] = word
    return by_place


def part_phrase(text: str, encoder: TextEncoder) -> PartPhrase | None:
    """Return the part of an object that a text names; None if it names no part.

    A text that a table has as a word names no part; nor does one of the shipped words, with any other encoder.
    """
    source = table_of(encoder)
    if source is not None:
        return source.vocabulary.find_part(text)
    part = shipped_words().find_part(text)
    return part or next((phrase for phrase in part_phrases(text) if phrase.sure), None)


def object_words(scene: Scene, words: Sequence[str], vectors: np.ndarray) -> tuple[str, ...]:
    """Return the nearest word of each of the lift's objects, without repeats, the largest total weight first.

    An object is left out if its word is not among the nearest hundredth also about the scene's mean: the word may be
    near to the whole scene.

    Args:
        words: n. vectors: [n, F] f32, unit.
    """
    if scene.object is None or vectors.shape[1] != scene.channels or not len(scene.object_means):
        return ()
    nearest = (scene.object_means @ vectors.T).argmax(axis=1)
    centred = (scene.object_means - scene.rough_mean) @ vectors.T
    nearer_counts = (centred > np.take_along_axis(centred, nearest[:, None], axis=1)).sum(axis=1)
    sure = (nearer_counts < max(1, len(words) // 100)) & scene.object_means.any(axis=1)
    rows: list[int] = np.flatnonzero(sure).tolist()
    return tuple(dict.fromkeys(words[int(nearest[row])].replace("_", " ") for row in rows))


def directions(
    scene: Scene, query: Query, encoder: TextEncoder | None, asked_as: Mapping[int, Wording] = {}
) -> np.ndarray:
    """Return the unit vector of every term, [n, F] f32.

    Args:
        asked_as: of the texts (`wordings`).

    Raises:
        InvalidQuery: a text without an encoder or with one of another space, a text that it cannot encode, or an
            example without a feature: outside the image, on a ray that misses the scene, of another length.
        NotFound: an example names a view that does not exist.
        InvalidLift: the splats or the cameras that an example needs moved or changed.
    """
    rows = _encode(scene, query, encoder, asked_as)
    for place, term in enumerate(query.terms):
        if not isinstance(term, str):
            with _errors_of(query, place):
                rows[place] = _unit(_feature(scene, term), "vector" if isinstance(term, Vector) else str(term))
    empty = np.zeros((0, scene.channels), np.float32)  # of a query of sets
    return np.stack([rows[place] for place in range(len(query.terms))]) if rows else empty


@contextmanager
def _errors_of(query: Query, place: int) -> Iterator[None]:
    """Raise the errors of a term again under its place in the query."""
    try:
        yield
    except (InvalidQuery, NotFound) as error:
        term, name = query.terms[place], query.places[place]
        got = error.got if isinstance(term, str | Vector) else f"{error.got} in {term}"
        hint, nearest = error.hint, error.nearest
        raise type(error)(name, expected=error.expected, got=got, hint=hint, nearest=nearest) from None


def _encode(
    scene: Scene, query: Query, encoder: TextEncoder | None, asked_as: Mapping[int, Wording]
) -> dict[int, np.ndarray]:
    """Return the unit vector of each text, by its index among the terms."""
    texts = {place: term for place, term in enumerate(query.terms) if isinstance(term, str)}
    if not texts:
        return {}
    assert encoder is not None  # `ask` opens one for texts
    space = scene.metadata.text_space or "not named"
    if encoder.channels != scene.channels:
        expected = f"{scene.channels} channels as the lift has (its text space: {space})"
        hint = "query with the text encoder that belongs to the features' image encoder"
        raise InvalidQuery("encoder", expected=expected, got=f"{encoder.name} with {encoder.channels}", hint=hint)
    rows = as_numpy(encoder.encode([asked_as[place].word for place in texts]))
    return {place: _unit(row, text) for row, (place, text) in zip(rows, texts.items(), strict=True)}


def _feature(scene: Scene, example: Area | SplatTerm | SplatSet | Vector) -> np.ndarray:
    if isinstance(example, Area):
        return area_feature(scene, example)
    if isinstance(example, Vector):
        if len(example.values) != scene.channels:
            raise InvalidQuery("vector", expected=f"{scene.channels} channels, as the lift has", got=str(example))
        return np.array(example.values)
    if isinstance(example, SplatSet):
        rows = np.flatnonzero(scene.set_members(example) & scene.has_feature)
        if not rows.size:
            raise InvalidQuery(str(example), expected="a set with splats that have a feature", got="none of them")
        return scene.mean_of(rows)
    count = len(scene.features)
    if example.splat >= count:
        raise InvalidQuery(str(example), expected=f"a splat in 0..{count - 1}", got=str(example.splat))
    return scene.features[example.splat]


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    """Scale a vector to length one, [F] f32; by its largest entry first, so that no square over- or underflows."""
    wide = np.asarray(vector, np.float64)
    largest = np.abs(wide).max()
    if not np.isfinite(largest) or largest == 0:
        got = "nothing but zeros" if largest == 0 else "NaN or infinity"
        raise InvalidQuery(name, expected="a finite feature with a direction", got=got)
    scaled = wide / largest
    return (scaled / np.linalg.norm(scaled)).astype(np.float32)


def read_example(notation: str, argument: str = "like") -> Example:
    """Read an example by its notation, or the vector of a file that ends in .npy, [F] or [1, F] of any number type.

    Raises:
        InvalidQuery: it is none of them (the error names ``argument``), or an array that is no vector.
        InvalidFeatures: no such file, or no array of numbers in it; a pickle is never opened.
    """
    if not notation.endswith(".npy"):
        return parse_example(notation, argument)
    from liftcore.io.npy import open_array

    values = open_array(Path(notation))
    if values.shape not in ((values.size,), (1, values.size)):
        raise InvalidQuery(notation, expected="one vector, [F] or [1, F]", got=f"the shape {list(values.shape)}")
    return Vector(tuple(values.reshape(-1).astype(np.float64).tolist()))
