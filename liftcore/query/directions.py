"""The directions in feature space that a query names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.areas import feature_shown
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import Query
from liftcore.query.regions import codebook_row, regions_of
from liftcore.query.terms import Area, Example, OneSplat, Region, Term, Vector, parse_example
from liftcore.text import TextEncoder


def directions(scene: OpenedLift, query: Query, encoder: TextEncoder | None, names: Sequence[str] = ()) -> np.ndarray:
    """The unit vector of every term, [n, F] f32.

    Args:
        names: what errors call each of the terms; () = what they are themselves.

    Raises:
        InvalidQuery: a text without an encoder or with one of another space, a text that it cannot read, or an
            example that has no feature: outside the image, on a ray that misses the scene, of another length.
        NotFound: an example names a view or a region that is not there.
        InvalidLift: the splats, the cameras or the packs that an example needs moved or changed.
    """
    named = _Names(query.terms, names)
    rows = _encode(scene, query, encoder, named) | _regions(scene, query, named)
    for place, term in enumerate(query.terms):
        if not isinstance(term, str | Region):
            with named(place):
                rows[place] = _unit(_feature(scene, term), "vector" if isinstance(term, Vector) else str(term))
    return np.stack([rows[place] for place in range(len(query.terms))])


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
            raise type(error)(self.names[place], expected=error.expected, got=got, hint=error.hint) from None


def _encode(scene: OpenedLift, query: Query, encoder: TextEncoder | None, named: _Names) -> dict[int, np.ndarray]:
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


def _feature(scene: OpenedLift, example: Area | OneSplat | Vector) -> np.ndarray:
    if isinstance(example, Area):
        return feature_shown(scene, example)
    if isinstance(example, Vector):
        if len(example.values) != scene.channels:
            raise InvalidQuery("vector", expected=f"{scene.channels} channels, as the lift has", got=str(example))
        return np.array(example.values)
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
