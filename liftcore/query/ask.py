"""Queries of a lift by words and examples: scores of all splats, and the selected ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.io.json_file import finite
from liftcore.query.candidates import candidates, parts_of
from liftcore.query.directions import directions, part_phrase, table_of, unknown_part, wordings
from liftcore.query.objects import objects
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.presence import (
    NOT_IN_WORDS,
    References,
    any_present,
    best_splats,
    estimate_presence,
    pack_of,
    products,
    references_of,
    references_of_space,
)
from liftcore.query.question import (
    Answer,
    Box,
    Candidate,
    Objects,
    Point,
    Presence,
    Query,
    Threshold,
    TopSplat,
    WordMatch,
)
from liftcore.query.scores import LEAST_LIKENESS, LOWEST_COSINE, combine, cosines, cosines_about
from liftcore.query.selection import (
    LEAST_FIRST,
    SAME_WORD,
    CompetingWords,
    add_objects,
    compare_ranks,
    correct_by_objects,
    nearest_to_query,
    objects_within,
    part_nodes,
)
from liftcore.query.selections import set_members
from liftcore.query.terms import Vector
from liftcore.query.threshold import explain_no_selection, find_threshold
from liftcore.runtime.aliases import deprecated_names
from liftcore.runtime.cores import cores
from liftcore.runtime.one_thread import one_thread
from liftcore.text import TextEncoder, check_texts
from liftcore.text.wording import PartPhrase, Wording, base_of, normalize_text

if TYPE_CHECKING:
    from torch import Tensor


MOST_RIVALS = 3  # words that are named as nearer than what was asked
MOST_OF_IT = 0.5  # the same where an answer is clear
LEAST_RIVAL = 0.1  # of what is looked at, by total weight, to which such a word is the nearest
WHOLE = 0.9  # of a thing's splats, from which what is found of it is no part
_OF_ANSWER = ("rivals", "candidates", "threshold", "clear", "statistics", "present", "presence", "reason")
_QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass(frozen=True)
class Question:
    """A query with the directions of its terms and the words that compete with them."""

    query: Query
    rows: np.ndarray  # [n, F] f32, the unit direction of each term
    plain: np.ndarray  # [n] bool, the terms that are compared by uncentred cosines: words
    references: References | str  # of the words' space, or the reason why there are none
    asked_as: Mapping[int, Wording]  # of the texts, by their indices among the terms
    pack: np.ndarray | None = None  # [n, F] f32, unit, all words of a table that has too few to be references
    candidates: tuple[Candidate, ...] = ()  # nodes that clicks among the terms may mean
    part: PartQuestion | None = None  # of a phrase that names a part of an object
    unknown_part: PartPhrase | None = None  # a part for which there is no word, so that the object is selected


@dataclass(frozen=True)
class PartQuestion:
    """Queries for a phrase that names a part of an object."""

    phrase: PartPhrase
    thing: Question
    part: Question


@deprecated_names(why="reason")
@dataclass(frozen=True)
class VectorAnswer:
    """Answer of a lift to vectors (`query_vectors`); tensors are on the CPU, where queries run."""

    scores: Tensor
    """[P] f32 in -1..1; -1 for splats without a feature"""
    splats: Tensor
    """[P] bool, the selected splats (`ask`)"""
    threshold: float
    """on the scores"""
    explanation: str
    """one sentence on the threshold"""
    clear: bool
    """True if the selected splats are clearly separate from the others"""
    present: bool | None
    """True if the object is in the scene; None: not known, or not sure"""
    presence: float | None
    """in 0..1, present from 0.5 on"""
    reason: str
    """one sentence on the reason of `present`"""
    objects: Objects | None
    """the objects of the selected splats, with boxes; None without splats"""

    def __repr__(self) -> str:
        selection = f"{int(self.splats.sum())} of {len(self.splats)} splats at or above {self.threshold:.4g}"
        return f"VectorAnswer({selection}, present={self.present}, clear={self.clear})"


def ask(scene: OpenedLift, query: Query | str, encoder: TextEncoder | None = None) -> Answer:
    """Score every splat for a query and select those that answer it.

    A splat counts in the histogram by its total weight: what hardly a ray met scores by the chance of a few pixels.
    It is still selected by its score. With ``weight_by`` its confidence counts too. The threshold `auto` is held to
    other words, and things of the region graph may be taken whole (`liftcore.query.selection`); any other selects by
    the score alone. Scores that are all equal or zero select nothing. A word for what is not there
    (`liftcore.query.presence`) is left out of the scores, and where no other positive is left nothing is selected,
    unless the query keeps what is absent. Negatives and examples are not questioned.

    Args:
        scene: an opened lift.
        query: words and examples, or one text alone.
        encoder: the text encoder of the lifted features' space; examples and the lift's own words need none.

    Raises:
        InvalidQuery: a text without an encoder of the lift's space, a term that has no feature, or a lift without
            the confidence that the query needs.
        NotFound: an example names a view or a region that does not exist.
        InvalidLift: an example needs the scene's files, and they moved or changed.
    """
    query = Query.of(query) if isinstance(query, str) else query
    return answers(scene, [question(scene, query, encoder)])[0]


def query_vectors(
    scene: OpenedLift,
    positives: Any,
    negatives: Any = (),
    *,
    references: Any = None,
    encoder: TextEncoder | str | Path | None = None,
    grouped: bool = False,
    **fields: Any,
) -> VectorAnswer:
    """Query a lift by words, or by vectors of its text space, which count as words.

    Args:
        scene: an opened lift.
        positives: the target: a text or several, or [n, F] or [F], torch or numpy, rows of any length above zero.
        negatives: likewise; they reduce the scores (`scores.combine`).
        references: [n, F], the vectors of 200 words or more, to estimate presence; None = those of the lift's text
            space, if it has some (`liftcore.query.presence`).
        encoder: of texts and of reference words, as in `Scene.ask`. grouped: True to group the selection to objects.
        fields: of `Query`.

    Raises:
        InvalidQuery: a vector of another length, of zeros or not finite; a text that the encoder cannot encode, or no
            encoder of the lift's space; or a field that `Query` rejects.
        Unavailable: the encoder's weights are not on this machine.
    """
    import torch

    query = Query.of(_terms(positives), _terms(negatives), **fields)
    reader = scene.encoder(encoder) if query.texts or encoder is not None else None
    asked_as = wordings(scene, query, reader)
    rows = directions(scene, query, reader, asked_as=asked_as)
    if references is not None:
        others = References.of(references, scene.channels)
    elif reader is not None:
        others = references_of(reader, scene.metadata.text_space)
    else:
        others = references_of_space(rows, scene.metadata.text_space)
    pack = None if reader is None else pack_of(reader)
    answer = answers(scene, [Question(query, rows, np.ones(len(rows), np.bool_), others, asked_as, pack)])[0]
    scores, selected = map(torch.from_numpy, (answer.scores, answer.selected))
    found = objects(scene, answer) if grouped else None
    cut, known = answer.threshold, (answer.present, answer.presence, answer.reason)
    return VectorAnswer(scores, selected, cut.value, cut.explanation, answer.clear, *known, found)


def _terms(values: Any) -> tuple[str | Vector, ...]:
    words = (values,) if isinstance(values, str) else tuple(values) if isinstance(values, list | tuple) else ()
    if words and all(isinstance(word, str) for word in words):
        check_texts(words)
        return words
    try:
        if values is None:
            raise TypeError
        rows = np.asarray(as_numpy(values), np.float64)
    except (TypeError, ValueError):
        what = type(values).__name__
        raise InvalidQuery("query", expected="a text, a list of texts, or vectors [n, F]", got=what) from None
    return tuple(Vector(tuple(row.tolist())) for row in np.atleast_2d(rows)) if rows.size else ()


def question(scene: OpenedLift, query: Query, encoder: TextEncoder | None, names: Sequence[str] = ()) -> Question:
    """Resolve the terms of a query to directions; all errors of a query are raised here (see `ask`).

    Args:
        names: of the terms in errors; () = their own texts.
    """
    phrase = part_phrase(scene, query, encoder)
    if phrase is None:
        return replace(_question(scene, query, encoder, names), unknown_part=unknown_part(scene, query, encoder))
    thing = _question(
        scene, Query(text=[phrase.object_phrase], weight_by=query.weight_by, absent=query.absent), encoder
    )
    asked = _question(scene, query, encoder, names) if not phrase.sure else replace(thing, query=query)
    return replace(asked, part=PartQuestion(phrase, thing, _question(scene, query, encoder, names, phrase)))


def _question(
    scene: OpenedLift,
    query: Query,
    encoder: TextEncoder | None,
    names: Sequence[str] = (),
    phrase: PartPhrase | None = None,
) -> Question:
    """Resolve a query as a whole, or for the part that a phrase names.

    An encoder of any text encodes the phrase, which is more specific than the part's word alone.
    """
    words = np.array([isinstance(term, str) for term in query.terms], np.bool_)
    asked_as = wordings(scene, query, encoder, names)
    if phrase is not None and table_of(encoder or scene.table) is not None:
        asked_as = asked_as | {0: Wording(query.text[0], phrase.part, "part")}
    rows = directions(scene, query, encoder, names, asked_as)
    if phrase is not None:
        asked_as = asked_as | {0: Wording(query.text[0], str(phrase), "part")}
    scene.splat_weights(query.weight_by)
    encoder = encoder or scene.table
    if encoder is None or not words[: len(query.positives)].any():
        return Question(query, rows, words, "", asked_as, candidates=candidates(scene, query))
    return Question(query, rows, words, references_of(encoder, scene.metadata.text_space), asked_as, pack_of(encoder))


@one_thread()
def answers(scene: OpenedLift, questions: Sequence[Question]) -> list[Answer]:
    """Answer several queries in one pass over the features; each to the same bits as alone."""
    if any(asked.part for asked in questions):
        return [_part_answer(scene, asked) if asked.part else answers(scene, [asked])[0] for asked in questions]
    similarities = _similarities(scene, questions)
    if len(questions) == 1:
        return [_answer(scene, questions[0], similarities[0])]
    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(lambda asked, similar: _answer(scene, asked, similar), questions, similarities))


def _part_answer(scene: OpenedLift, asked: Question) -> Answer:
    """Answer a query for a part of an object: the object first, then the part among its splats and nodes alone.

    A phrase that may not mean a part (`PartPhrase`) is answered as a whole if no such part is found.
    """
    assert asked.part is not None
    sure, part = asked.part.phrase.sure, asked.part.part
    (thing,) = answers(scene, [asked.part.thing])
    if thing.count:
        inside = add_objects(scene, thing.selected)
        (found,) = answers(scene.within(inside), [part])
        nothing = "" if found.count or found.present is False else " Nothing stands out there."
        told = f"{asked.part.phrase.object_phrase!r} has {thing.count:,} splats. Within it: {found.reason}{nothing}"
        if found.count >= WHOLE * inside.sum() and asked.query.absent == "drop":
            told = (
                f"{asked.part.phrase.object_phrase!r} is there, but {part.query.text[0]!r} tells no part of it from "
                "the rest."
            )
            fields = {name: getattr(found, name) for name in _OF_ANSWER} | {"clear": False, "present": False}
            found = Answer.of(found.query, found.scores, found.seen, np.zeros_like(inside), **fields)
    else:
        found, nothing = (
            thing,
            "it" if thing.present is False else f"{asked.part.phrase.object_phrase!r} is not found, and",
        )
        told = f"{thing.reason} So {nothing} has no parts."
    if not found.count and not sure:
        return answers(scene, [replace(asked, part=None)])[0]
    fields = {name: getattr(found, name) for name in _OF_ANSWER} | {"reason": told}
    if thing.present is False:
        fields |= {"present": False, "presence": thing.presence}
    wording = tuple(WordMatch(**word._asdict()) for word in part.asked_as.values() if word.match)
    return Answer.of(asked.query, found.scores, found.seen, found.selected, **fields, wording=wording)


def located(scene: OpenedLift, answer: Answer, count: int | None = None) -> Answer:
    """Add to an answer its best splats, and the box around all selected ones.

    A single outlier stretches the box; boxes of ``objects`` are without outliers.

    Args:
        count: of the best splats; None = the query's. Equal scores are ordered by their rows.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    places, count = scene.axes, answer.query.top if count is None else count
    seen = np.flatnonzero(answer.seen)
    scores = answer.scores[seen]
    if 0 < count < len(scores):
        last = np.partition(scores, len(scores) - count)[len(scores) - count]
        seen = np.concatenate([seen[scores > last], seen[scores == last]])[:count]
    best = seen[np.argsort(-answer.scores[seen], kind="stable")][:count]
    top = tuple(
        TopSplat(splat=int(row), score=float(answer.scores[row]), position=_point(places[:, row])) for row in best
    )
    chosen = [axis[np.flatnonzero(answer.selected)] for axis in places] if answer.count else []
    ends = [np.array([end(axis) for axis in chosen]) for end in (np.min, np.max)] if chosen else []
    return answer.model_copy(update={"top": top, "box": Box(*map(_point, ends)) if ends else None})


def _similarities(scene: OpenedLift, questions: Sequence[Question]) -> list[np.ndarray]:
    """Compute for each query the cosines of every splat to each of its terms, [P, n] f32."""
    features, norms = scene.features, scene.norms
    of_words = np.concatenate([asked.rows[asked.plain] for asked in questions])
    # A row a word from here on, so that its scores are contiguous.
    columns = iter(np.ascontiguousarray(cosines(features, norms, of_words).T) if len(of_words) else ())
    found = []
    for asked in questions:
        similar = np.empty((len(asked.rows), len(features)), np.float32)
        if not asked.plain.all():
            similar[~asked.plain] = cosines_about(features, norms, scene.mean, asked.rows[~asked.plain]).T
        for row in np.flatnonzero(asked.plain):
            similar[row] = next(columns)
        found.append(similar.T)
    return found


def _answer(scene: OpenedLift, asked: Question, similarities: np.ndarray) -> Answer:
    query, seen = asked.query, scene.seen
    if query.sets:
        return _set_answer(scene, query)
    presence, kept = _presence(scene, asked, similarities)
    scores = combine(similarities if kept.all() else similarities[:, kept], int(kept[: len(query.positives)].sum()))
    if not scene.all_seen:
        scores = np.where(seen, scores, np.float32(LOWEST_COSINE))
    known = scores if scene.all_seen else scores[seen]
    if presence.present is False and query.absent == "drop":
        method = query.threshold if isinstance(query.threshold, str) else "fixed"
        found = Threshold(value=math.inf, method=method, explanation=presence.reason, clear=False)
        selected = np.zeros_like(seen)
    else:
        found, selected = _selected(scene, asked, kept, scores, scene.splat_weights(query.weight_by))
    clear = found.clear and presence.present is not False and bool(selected.any())
    least = MOST_OF_IT if clear and presence.present is not None else LEAST_RIVAL
    competitors = _nearer_words(scene, asked, scores, selected, least)
    meant = asked.candidates
    if asked.unknown_part is not None and selected.any():
        meant = parts_of(scene, objects_within(scene, selected))
        thing = presence.reason.replace(
            repr(query.text[0]), repr(asked.unknown_part.object_phrase)
        )  # what is there is the thing
        presence = presence.model_copy(update={"reason": f"{thing} {_without_word(asked.unknown_part, len(meant))}"})
    wording = tuple(WordMatch(**word._asdict()) for word in asked.asked_as.values() if word.match)
    return Answer.of(
        query, scores, seen, selected, wording=wording, rivals=competitors,
        candidates=meant, threshold=found, clear=clear, statistics=finite(_statistics(known)),
        **dict(presence),
    )  # fmt: skip


def _without_word(phrase: PartPhrase, parts: int) -> str:
    """Explain in two sentences that no word stands for a part, and what to do."""
    ask = "ask one of its candidates, click the part" if parts else "click the part"
    return (
        f"No word stands for {phrase.part!r}, so this is all of {phrase.object_phrase!r}. To have the part, {ask}, "
        "or take an encoder that reads any text."
    )


def _nearer_words(
    scene: OpenedLift, asked: Question, scores: np.ndarray, selected: np.ndarray, least: float
) -> tuple[str, ...]:
    """Return reference words that are the nearest of all to a share of the selected splats, or else the best ones."""
    references, positives = asked.references, len(asked.query.positives)
    own = asked.rows[:positives][asked.plain[:positives]]
    if not isinstance(references, References) or not len(own):
        return ()
    rows, weights = best_splats(scene, np.where(selected, scores, np.float32(-1.0)) if selected.any() else scores)
    if not len(rows):
        return ()
    names = {
        normalize_text(base_of(word.word)) for word in asked.asked_as.values()
    }  # "fish" and "fish (food)" are one
    same = (references.vectors @ own.T >= SAME_WORD).any(axis=1)
    same |= np.array([word in names for word in references.plain_words])
    near, others = products(scene.features[rows], scene.norms[rows], own, references.vectors)
    others[:, same] = -1.0
    nearest = np.where(others.max(axis=1) > near.max(axis=1), others.argmax(axis=1), -1)
    shares = np.bincount(nearest[nearest >= 0], weights[nearest >= 0], len(references.words)) / weights.sum()
    order = np.argsort(-shares, kind="stable")[:MOST_RIVALS]
    return tuple(references.words[row].replace("_", " ") for row in order.tolist() if shares[row] >= least)


def _set_answer(scene: OpenedLift, query: Query) -> Answer:
    """Answer a query of sets: a score of one for their splats and zero for the others, also without a feature."""
    members = np.zeros(len(scene.features), np.bool_)
    for one in query.splat_sets:
        members |= set_members(scene, one)
    named, count, scores = ", ".join(query.sets), int(members.sum()), members.astype(np.float32)
    found = Threshold(value=0.5, method="set", explanation=f"the splats of {named}, as they are", clear=count > 0)
    here = Presence(present=count > 0, presence=float(count > 0), reason=f"{named} has {count} splats.")
    return Answer.of(
        query, scores, np.ones_like(members), members,
        threshold=found, clear=count > 0, statistics=finite(_statistics(scores)), **dict(here),
    )  # fmt: skip


def _selected(
    scene: OpenedLift, asked: Question, kept: np.ndarray, scores: np.ndarray, weights: np.ndarray
) -> tuple[Threshold, np.ndarray]:
    """Return the threshold of a query and the selected splats, [P] bool.

    Args:
        mask: [n] bool, the terms that count. scores: [P] f32. weights: [P] f32 of the splats.
    """
    query, positives = asked.query, len(asked.query.positives)
    known = scores if scene.all_seen else scores[scene.seen]
    nothing = explain_no_selection(known)
    if nothing:
        method = query.threshold if isinstance(query.threshold, str) else "fixed"
        found = Threshold(value=math.inf, method=method, explanation=nothing, clear=False)
        return found, np.zeros_like(scene.seen)
    in_words = (asked.plain & kept)[:positives]
    least = -math.inf if in_words.any() else LEAST_LIKENESS
    counted = "total weight" if query.weight_by == "evidence" else "total weight times confidence"
    alone = scene.weights if query.weight_by == "evidence" else scene.weights_with_feature(weights)
    found = find_threshold(known, query.threshold, alone, least, counted)
    selected = scene.seen & (scores >= np.float32(found.value))
    competitors = _rivals(asked, asked.rows[:positives][in_words])
    if query.threshold != "auto" or not competitors or in_words.sum() < kept[:positives].sum():
        return found, selected
    standing = compare_ranks(scene, scores, weights, found.value, competitors[0])
    if standing.lowest > found.value:
        again = find_threshold(known, "auto", alone, standing.lowest, counted)
        value = max(again.value, standing.lowest)
        explanation = f"Below {standing.lowest:.4g} other words are nearer. {again.explanation}"
        found = again.model_copy(
            update={"value": value, "explanation": explanation, "clear": again.clear and again.value == value}
        )
        selected = scene.seen & (scores >= np.float32(value))
    found = found.model_copy(update={"clear": found.clear and standing.first >= LEAST_FIRST})
    if competitors[-1].nearer_limit == 0:
        selected = nearest_to_query(scene, selected, competitors[-1])
    parts = part_nodes(scene, competitors[0])
    if parts:
        selected = scene.seen & np.logical_or.reduce([scene.members(node) for node in parts])
        addition = f"levels differ in meaning, so the named parts are selected: {', '.join(map(str, parts))}"
    else:
        selected, addition = correct_by_objects(scene, selected, weights, competitors[0])
    if addition:
        found = found.model_copy(update={"explanation": f"{found.explanation.removesuffix('.')}; {addition}."})
    return found, selected


def _rivals(asked: Question, directions: np.ndarray) -> list[CompetingWords]:
    """Return the words that compete with the positives [p, F]: reference words, then the others of a pack."""
    if not len(directions):
        return []
    competitors = (
        [CompetingWords.among(asked.references, directions)] if isinstance(asked.references, References) else []
    )
    if asked.pack is not None:
        competitors.append(CompetingWords.of_pack(asked.pack, directions))
    return [some for some in competitors if len(some.vectors)]


def _presence(scene: OpenedLift, asked: Question, similarities: np.ndarray) -> tuple[Presence, np.ndarray]:
    """Return the presence of the positives, and the terms that count, [n] bool: all, or without absent words."""
    kept, positives = np.ones(len(asked.rows), np.bool_), len(asked.query.positives)
    words = np.flatnonzero(asked.plain[:positives]).tolist()
    if not words:
        return NOT_IN_WORDS, kept
    if isinstance(asked.references, str):
        return Presence(present=None, presence=None, reason=asked.references), kept
    names = [repr(term) if isinstance(term, str) else str(term) for term in asked.query.positives]
    presences = [
        estimate_presence(scene, names[k], asked.rows[k], similarities[:, k], asked.references) for k in words
    ]
    presence = any_present(presences)
    if presence.present is False and len(words) < positives:  # examples may be present
        presence = presence.model_copy(update={"present": None})
    if presence.present is not False and asked.query.absent == "drop":
        kept[[k for k, word in zip(words, presences, strict=True) if word.present is False]] = False
    return presence, kept


def _statistics(scores: np.ndarray) -> dict[str, float]:
    if len(scores) == 0:
        return {}
    ordered = np.sort(scores)  # vectorised, so faster than selecting seven order statistics
    quantiles = {f"q{round(100 * q):02d}": float(ordered[round(q * (len(scores) - 1))]) for q in _QUANTILES}
    mean = float(scores.mean(dtype=np.float64))
    return {"min": float(ordered[0]), "max": float(ordered[-1]), "mean": mean, **quantiles}


def _point(row: np.ndarray) -> Point:
    x, y, z = row.tolist()
    return x, y, z
