"""The directions in feature space that a query names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.areas import feature_shown
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.presence import references_of
from liftcore.query.question import AskableWord, AskableWords, Query
from liftcore.query.regions import codebook_row, regions_of
from liftcore.query.selections import set_members
from liftcore.query.terms import Area, Example, Region, SplatSet, SplatTerm, Term, Vector, parse_example
from liftcore.text import CachingEncoder, TextEncoder, check_texts
from liftcore.text.table import TableEncoder
from liftcore.text.wording import PartPhrase, Wording, part_phrases, shipped_words


def wordings(
    scene: OpenedLift, query: Query, encoder: TextEncoder | None, names: Sequence[str] = ()
) -> dict[int, Wording]:
    """What each text among the terms is asked as, by its place: the word of a table, else the text itself.

    Args:
        names: what errors call each of the terms; () = what they are themselves.

    Raises:
        InvalidQuery: no word of the table stands for a text; ``nearest`` has those that could be asked.
    """
    source = table_of(encoder or scene.table)
    texts = {place: term for place, term in enumerate(query.terms) if isinstance(term, str)}
    if source is None:
        return {place: Wording(text, text, "") for place, text in texts.items()}
    found: dict[int, Wording] = {}
    for place, text in texts.items():
        with _Names(query.terms, names)(place):
            check_texts([text])
            word = source.vocabulary.find(text)
            if word is None:
                raise source.refusal(text, named_things(scene, source.words, source.embeddings))
        found[place] = word
    return found


def table_of(encoder: TextEncoder | None) -> TableEncoder | None:
    """An encoder that is a table of words; None for any other."""
    source = encoder.source if isinstance(encoder, CachingEncoder) else encoder
    return source if isinstance(source, TableEncoder) else None


def part_phrase(scene: OpenedLift, query: Query, encoder: TextEncoder | None) -> PartPhrase | None:
    """The part of a thing that the only positive of a query names; None where it is something else.

    A table that has the whole text as a word asks that; so does any encoder where the shipped words have it.
    """
    encoder = encoder or scene.table
    if encoder is None or len(query.positives) != 1 or not query.text:
        return None
    source = table_of(encoder)
    if source is not None:
        return source.vocabulary.find_part(query.text[0])
    known = shipped_words().find_part(query.text[0])
    return known or next((phrase for phrase in part_phrases(query.text[0]) if phrase.sure), None)


def unknown_part(scene: OpenedLift, query: Query, encoder: TextEncoder | None) -> PartPhrase | None:
    """The part, as typed, that the only positive of a query names and no word of the table stands for; None else."""
    source = table_of(encoder or scene.table)
    if source is None or len(query.positives) != 1 or not query.text:
        return None
    return source.vocabulary.unknown_part(query.text[0])


def askable_words(scene: OpenedLift, encoder: TextEncoder, text: str, count: int) -> AskableWords:
    """What a lift can be asked (`Scene.askable`)."""
    source = table_of(encoder)
    if source is not None:
        here = named_things(scene, source.words, source.embeddings)
        words = tuple(AskableWord(**one._asdict()) for one in source.vocabulary.complete(text, count))
        return AskableWords(any_text=False, words=words, here=here)
    known = references_of(encoder, scene.metadata.text_space)
    here = () if isinstance(known, str) else named_things(scene, known.words, known.vectors)
    return AskableWords(any_text=True, words=(), here=here)


def named_things(scene: OpenedLift, words: Sequence[str], vectors: np.ndarray) -> tuple[str, ...]:
    """The words that are nearest to the lift's objects, each once, the object with the most evidence first.

    An object whose word is not among the nearest hundredth also about the scene's mean is left out: the word may be
    near to all that the scene shows.

    Args:
        words: n. vectors: [n, F] f32, unit.
    """
    if scene.object is None or vectors.shape[1] != scene.channels or not len(scene.object_means):
        return ()
    plain = (scene.object_means @ vectors.T).argmax(axis=1)
    apart = (scene.object_means - scene.rough_mean) @ vectors.T
    ahead = (apart > np.take_along_axis(apart, plain[:, None], axis=1)).sum(axis=1)
    sure = (ahead < max(1, len(words) // 100)) & scene.object_means.any(axis=1)
    rows: list[int] = np.flatnonzero(sure).tolist()
    return tuple(dict.fromkeys(words[int(plain[row])].replace("_", " ") for row in rows))


def directions(
    scene: OpenedLift,
    query: Query,
    encoder: TextEncoder | None,
    names: Sequence[str] = (),
    asked_as: Mapping[int, Wording] | None = None,
) -> np.ndarray:
    """The unit vector of every term, [n, F] f32.

    Args:
        names: what errors call each of the terms; () = what they are themselves.
        asked_as: of the texts (`wordings`); None: found here.

    Raises:
        InvalidQuery: a text without an encoder or with one of another space, a text that it cannot read, or an
            example that has no feature: outside the image, on a ray that misses the scene, of another length.
        NotFound: an example names a view or a region that is not there.
        InvalidLift: the splats, the cameras or the packs that an example needs moved or changed.
    """
    named = _Names(query.terms, names)
    rows = _encode(scene, query, encoder, named, asked_as) | _regions(scene, query, named)
    for place, term in enumerate(query.terms):
        if not isinstance(term, str | Region):
            with named(place):
                rows[place] = _unit(_feature(scene, term), "vector" if isinstance(term, Vector) else str(term))
    empty = np.zeros((0, scene.channels), np.float32)  # of a query of sets
    return np.stack([rows[place] for place in range(len(query.terms))]) if rows else empty


@dataclass(frozen=True)
class _Names:
    """What is wrong with a term is said under its name, if it has one."""

    terms: Sequence[Term]
    names: Sequence[str]

    @contextmanager
    def __call__(self, place: int) -> Iterator[None]:
        try:
            yield
        except (InvalidQuery, NotFound) as error:
            if not self.names:
                raise
            term = self.terms[place]
            got = error.got if isinstance(term, str | Vector) else f"{error.got} in {term}"
            name, hint, nearest = self.names[place], error.hint, error.nearest
            raise type(error)(name, expected=error.expected, got=got, hint=hint, nearest=nearest) from None


def _encode(
    scene: OpenedLift,
    query: Query,
    encoder: TextEncoder | None,
    named: _Names,
    asked_as: Mapping[int, Wording] | None,
) -> dict[int, np.ndarray]:
    """The unit vector of each text, by its place among the terms."""
    texts = {place: term for place, term in enumerate(query.terms) if isinstance(term, str)}
    if not texts:
        return {}
    encoder = encoder or scene.table
    if encoder is None:
        space = scene.metadata.text_space or "not named"
        expected = f"a text encoder (the lift's text space: {space})"
        hint = "name a text encoder of the lift's space, or ask by example"
        raise InvalidQuery("encoder", expected=expected, got="no encoder", hint=hint)
    if encoder.channels != scene.channels:
        space = scene.metadata.text_space or "not named"
        expected = f"{scene.channels} channels as the lift has (its text space: {space})"
        hint = "query with the text encoder that belongs to the features' image encoder"
        raise InvalidQuery("encoder", expected=expected, got=f"{encoder.name} with {encoder.channels}", hint=hint)
    asked_as = wordings(scene, query, encoder, named.names) if asked_as is None else asked_as
    texts = {place: asked_as[place].word for place in texts}
    try:
        rows = encoder.encode(list(texts.values()))
    except InvalidQuery:
        for place, text in texts.items():  # together they do not tell which of them it is
            with named(place):
                encoder.encode([text])
        raise
    return {place: _unit(row, text) for row, (place, text) in zip(as_numpy(rows), texts.items(), strict=True)}


def _regions(scene: OpenedLift, query: Query, named: _Names) -> dict[int, np.ndarray]:
    """The unit row of each region, by its place among the terms; a view is read once for all that are of it."""
    asked = [(term.view, place, term) for place, term in enumerate(query.terms) if isinstance(term, Region)]
    rows: dict[int, np.ndarray] = {}
    for _, of_view in groupby(sorted(asked, key=itemgetter(0, 1)), key=itemgetter(0)):
        regions = None  # one view at a time: maps are large
        for _, place, term in of_view:
            with named(place):
                regions = regions or regions_of(scene, term.view, str(term))
                rows[place] = _unit(codebook_row(regions, term), str(term))
    return rows


def _feature(scene: OpenedLift, example: Area | SplatTerm | SplatSet | Vector) -> np.ndarray:
    if isinstance(example, Area):
        return feature_shown(scene, example)
    if isinstance(example, Vector):
        if len(example.values) != scene.channels:
            raise InvalidQuery("vector", expected=f"{scene.channels} channels, as the lift has", got=str(example))
        return np.array(example.values)
    if isinstance(example, SplatSet):
        rows = np.flatnonzero(set_members(scene, example) & scene.seen)
        if not rows.size:
            raise InvalidQuery(str(example), expected="a set with splats that have a feature", got="none of them")
        return scene.mean_of(rows)
    count = len(scene.features)
    if example.splat >= count:
        raise InvalidQuery(str(example), expected=f"a splat in 0..{count - 1}", got=str(example.splat))
    return scene.features[example.splat]


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    """[F] f32 of length one. Scaled by its largest entry first, so that no square overflows or vanishes."""
    wide = np.asarray(vector, np.float64)
    largest = np.abs(wide).max()
    if not np.isfinite(largest) or largest == 0:
        got = "nothing but zeros" if largest == 0 else "NaN or infinity"
        raise InvalidQuery(name, expected="a finite feature with a direction", got=got)
    scaled = wide / largest
    return (scaled / np.linalg.norm(scaled)).astype(np.float32)


def read_example(notation: str, argument: str = "like") -> Example:
    """An example by its notation, or the vector of a file that ends in .npy.

    Raises:
        InvalidQuery: it is none of them (blamed on ``argument``), or an array that is no vector.
        InvalidFeatures: no such file, or no array of numbers in it.
    """
    return read_vector(Path(notation)) if notation.endswith(".npy") else parse_example(notation, argument)


def read_vector(path: Path) -> Vector:
    """The vector of a ``.npy`` file, [F] or [1, F] of any number type.

    Raises:
        InvalidFeatures: no such file, or no array of numbers in it; a pickle is never opened.
        InvalidQuery: the array is no vector.
    """
    from liftcore.io.npy import open_npy

    values = open_npy(path)
    if values.shape not in ((values.size,), (1, values.size)):
        raise InvalidQuery(str(path), expected="one vector, [F] or [1, F]", got=f"the shape {list(values.shape)}")
    return Vector(tuple(values.reshape(-1).astype(np.float64).tolist()))
