"""Queries of a lift by words and examples: scores of all splats, and the selected ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.candidates import candidates, parts_of
from liftcore.query.directions import directions, object_words, part_phrase, read_query, wordings
from liftcore.query.presence import (
    NOT_IN_WORDS,
    References,
    any_present,
    best_splats,
    estimate_presence,
    products,
    references_of,
    references_of_space,
    small_table_of,
    table_of,
)
from liftcore.query.question import Answer, Candidate, Presence, Query, Threshold, WordMatch
from liftcore.query.scene import AnyEncoder, Scene, as_numpy
from liftcore.query.scores import LEAST_LIKENESS, LOWEST_COSINE, combine, cosines, cosines_about, spaced
from liftcore.query.selection import (
    LEAST_FIRST,
    NEAR,
    SAME_WORD,
    CompetingWords,
    add_objects,
    compare_ranks,
    correct_by_objects,
    nearest_to_query,
    objects_within,
    part_nodes,
)
from liftcore.query.terms import Vector
from liftcore.query.threshold import explain_no_selection, find_threshold, has_one_mode
from liftcore.runtime.one_thread import one_thread
from liftcore.text import TextEncoder, check_texts
from liftcore.text.phrases import PartPhrase
from liftcore.text.wording import SUGGESTED, Wording, base_of, members_of, normalize_text

MOST_RIVALS = 3  # competing words in an answer
LEAST_RIVAL = 0.1  # least share of the selected total weight to which such a word is the nearest
LEAST_RIVAL_OF_CLEAR = 0.5  # the same for a clear answer
WHOLE_SHARE = 0.9  # of an object's splats, from which a selection is no part of it
LEAST_OF_WHOLE = 0.1  # of what a word selects in the whole scene, from which its splats in an object are a part
SAME_AS_WORD = 0.9  # cosine of all splats to a word without competitors, from which all are of it
SAME_AS_EXAMPLE = 0.98  # the same of an example: features of one encoder are more alike
MOST_COMPARED = 4_096  # splats that are compared with an example


@dataclass(frozen=True)
class ResolvedQuery:
    """A query with the directions of its terms and the words that compete with them."""

    query: Query
    rows: np.ndarray  # [n, F] f32, the unit direction of each term
    by_cosine: np.ndarray  # [n] bool, the terms that are compared by uncentred cosines: words
    references: References | str  # of the text space; or a sentence why there are none, "" if no positive is a word
    asked_as: Mapping[int, Wording]  # of the texts, by their indices among the terms
    small_table: np.ndarray | None = None  # [n, F] f32, unit: all words of a table that has too few to be references
    candidates: tuple[Candidate, ...] = ()  # nodes that clicks among the terms may mean
    unknown_part: PartPhrase | None = None  # a part for which there is no word, so that the object is selected

    @property
    def wording(self) -> tuple[WordMatch, ...]:
        """The texts that another word stands for."""
        return tuple(WordMatch(**word._asdict()) for word in self.asked_as.values() if word.match)


@dataclass(frozen=True)
class PartQuery:
    """Queries for a phrase that names a part of an object."""

    query: Query  # of the phrase
    phrase: PartPhrase
    object: ResolvedQuery
    part: ResolvedQuery
    whole: ResolvedQuery | None  # the phrase as a whole, if it may not mean a part


def ask(scene: Scene, query: Query | str, encoder: AnyEncoder = None) -> Answer:
    """Score every splat for a query and select those that answer it.

    The threshold `auto` comes from a histogram of scores, in which each splat counts by its total weight, as splats
    hit by few rays have noisy scores. The threshold is compared with other words, and objects of the region graph may
    be selected as a whole (`liftcore.query.selection`). Any other threshold selects by the score alone. Scores that
    are all equal or zero select nothing, unless all of the scene is of one thing. Absent words
    (`liftcore.query.presence`) are left out of the scores, and without another positive nothing is selected, unless
    the query keeps absent words. The presence of negatives and examples is not estimated.

    Args:
        scene: an opened lift. query: words and examples, or one text alone.
        encoder: as `Scene.encoder` opens it, of the lifted features' space; examples need none.

    Raises:
        InvalidQuery, NotFound, InvalidLift: as `Scene.ask`.
    """
    query = query if isinstance(query, Query) else Query.of(query)
    check_texts(query.texts)  # before an encoder is opened
    # The table is in the metadata, which are checked so: a lift of other rows than its splats answers nothing.
    reader = scene.encoder(encoder) if query.texts or encoder is not None else scene.table
    return answer_of(scene, resolve_query(scene, query, reader))


def ask_vectors(scene: Scene, positives: Any, negatives: Any = (), **fields: Any) -> Answer:
    """Answer a query of vectors of the lift's text space, which count as words, as `LiftResult.query` does."""
    query = Query.of(_vectors(positives), _vectors(negatives), **fields)
    vars(query)["places"] = ["vector"] * len(query.terms)  # for errors
    rows = directions(scene, query, None)
    references = references_of_space(rows, scene.metadata.text_space)
    return answer_of(scene, ResolvedQuery(query, rows, np.ones(len(rows), np.bool_), references, {}))


def _vectors(values: Any) -> tuple[Vector, ...]:
    try:
        if values is None:
            raise TypeError
        rows = np.asarray(as_numpy(values), np.float64)
    except (TypeError, ValueError):
        type_name = type(values).__name__
        raise InvalidQuery("query", expected="a text, a list of texts, or vectors [n, F]", got=type_name) from None
    return tuple(Vector(tuple(row.tolist())) for row in np.atleast_2d(rows)) if rows.size else ()


def resolve_query(scene: Scene, query: Query, encoder: TextEncoder | None) -> ResolvedQuery | PartQuery:
    """Resolve the terms of a query to directions; all errors of its terms are raised here (see `ask`)."""
    query, phrases = read_query(query, encoder)
    text = query.text[0] if query.text and len(query.positives) == 1 else ""  # that may name a part
    text = "" if phrases.get(0, ("", ""))[1] == "quotes" else text
    phrase = part_phrase(text, encoder) if text and encoder is not None else None
    if phrase is None:
        request, source = _resolve(scene, query, encoder), table_of(encoder)
        as_typed = {
            index: Wording(typed, request.asked_as[index].word, form) for index, (typed, form) in phrases.items()
        }
        missing = source.vocabulary.unknown_part(text) if text and source is not None else None
        return replace(request, asked_as={**request.asked_as, **as_typed}, unknown_part=missing)
    object_query = _resolve(scene, Query(text=[phrase.object_phrase], absent=query.absent), encoder)
    whole = None if phrase.sure else _resolve(scene, query, encoder)
    return PartQuery(query, phrase, object_query, _resolve(scene, query, encoder, phrase), whole)


def _resolve(
    scene: Scene, query: Query, encoder: TextEncoder | None, phrase: PartPhrase | None = None
) -> ResolvedQuery:
    """Resolve a query as a whole, or for the part that a phrase names.

    A table has no vector for "the mug's handle", so the part's word is used. Any other encoder encodes the whole
    phrase, which is more specific.
    """
    words = np.array([isinstance(term, str) for term in query.terms], np.bool_)
    asked_as = wordings(scene, query, encoder)
    if phrase is not None and table_of(encoder) is not None:
        asked_as = asked_as | {0: Wording(query.text[0], phrase.part, "part")}
    rows = directions(scene, query, encoder, asked_as)
    if phrase is not None:
        asked_as = asked_as | {0: Wording(query.text[0], str(phrase), "part")}
    if encoder is None or not words[: len(query.positives)].any():
        return ResolvedQuery(query, rows, words, "", asked_as, candidates=candidates(scene, query))
    return ResolvedQuery(
        query, rows, words, references_of(encoder, scene.metadata.text_space), asked_as, small_table_of(encoder)
    )


@one_thread()
def answer_of(scene: Scene, request: ResolvedQuery | PartQuery) -> Answer:
    """Answer a resolved query."""
    return _part_answer(scene, request) if isinstance(request, PartQuery) else _answer(scene, request)


def _part_answer(scene: Scene, request: PartQuery) -> Answer:
    """Answer a query for a part of an object: the object first, then the part among its splats and nodes alone.

    A phrase that may not mean a part (`PartPhrase`) is answered as a whole unless most of such a part, and a share of
    what the whole scene has of the word, is in both answers: "boat cat" is no part of the boat.
    """
    phrase, part = request.phrase.object_phrase, request.part
    object_answer = _answer(scene, request.object)
    if object_answer.count:
        inside = add_objects(scene, object_answer.selected)
        answer = _answer(scene.within(inside), part)
        note = "" if answer.count or answer.present is False else " Nothing stands out there."
        reason = f"{phrase!r} has {object_answer.count:,} splats. Within it: {answer.reason}{note}"
        if answer.count >= WHOLE_SHARE * inside.sum() and request.query.absent == "drop":
            reason = f"{phrase!r} is there, but {part.query.text[0]!r} tells no part of it from the rest."
            answer = answer.with_selected(np.zeros_like(inside), request.query, clear=False, present=False)
    else:
        answer, note = object_answer, "it" if object_answer.present is False else f"{phrase!r} is not found, and"
        reason = f"{object_answer.reason} So {note} has no parts."
    if request.whole is not None:
        whole = _answer(scene, request.whole)
        shared = int((answer.selected & whole.selected).sum())
        if shared <= max(answer.count / 2, LEAST_OF_WHOLE * whole.count):
            return whole
    changes = {"present": False, "presence": object_answer.presence} if object_answer.present is False else {}
    return answer.with_selected(answer.selected, request.query, reason=reason, wording=part.wording, **changes)


def _similarities(scene: Scene, request: ResolvedQuery) -> np.ndarray:
    """Compute the cosines of every row of the features to each term of a query, [K, n] f32."""
    features, norms, of_words = scene.features.rows, scene.features.norms, request.by_cosine
    similar = np.empty((len(of_words), len(features)), np.float32)  # a row a term, so that its scores are contiguous
    if of_words.any():
        similar[of_words] = cosines(features, norms, request.rows[of_words]).T
    if not of_words.all():
        similar[~of_words] = cosines_about(features, norms, scene.mean, request.rows[~of_words]).T
    return similar.T


def _answer(scene: Scene, request: ResolvedQuery) -> Answer:
    query, has_feature, rows = request.query, scene.has_feature, scene.distinct
    if query.sets:
        return _set_answer(scene, query)
    similarities = _similarities(scene, request)
    presence, mask = _presence(rows, request, similarities)
    scores = combine(similarities if mask.all() else similarities[:, mask], int(mask[: len(query.positives)].sum()))
    scores = np.where(rows.has_feature, scores, np.float32(LOWEST_COSINE))
    if presence.present is False and query.absent == "drop":
        threshold, selected = _select_nothing(scene, query, presence.reason)
    else:
        words = np.flatnonzero((request.by_cosine & mask)[: len(query.positives)])
        if query.threshold == "auto" and 1 < len(words) == mask[: len(query.positives)].sum():
            threshold, selected = _select_each(scene, request, mask, similarities, words)
        else:
            threshold, selected = _select(scene, request, mask, scores)
    clear = threshold.clear and presence.present is not False and bool(selected.any())
    least = LEAST_RIVAL_OF_CLEAR if clear and presence.present is not None else LEAST_RIVAL
    is_selected = scene.features.with_splats(selected)
    competitors = _nearer_words(rows, request, scores, is_selected, least)
    if presence.present is False and (members := _of_kind(scene, request)):
        competitors = members
        named_members = ", ".join(map(repr, members))
        presence = presence.replace(reason=f"{presence.reason} Of its kind in this scene: {named_members}.")
    scores = np.where(has_feature, scene.features.of_splats(scores), np.float32(LOWEST_COSINE))
    nodes = request.candidates
    if request.unknown_part is not None and selected.any():
        nodes = parts_of(scene, objects_within(scene, selected))
        # The part has no word, so the reason names the object that was selected.
        sentence = presence.reason.replace(repr(query.text[0]), repr(request.unknown_part.object_phrase))
        presence = presence.replace(reason=f"{sentence} {_without_word(request.unknown_part, len(nodes))}")
    return Answer.of(
        query, scores, has_feature, selected, wording=request.wording, rivals=competitors, candidates=nodes,
        threshold=threshold, clear=clear, statistics=_statistics(scores[has_feature]), **dict(presence),
    )  # fmt: skip


def _without_word(phrase: PartPhrase, parts: int) -> str:
    """Explain in two sentences that no word stands for a part, and what to do."""
    ask = "ask one of its candidates, click the part" if parts else "click the part"
    return (
        f"No word stands for {phrase.part!r}, so this is all of {phrase.object_phrase!r}. To have the part, {ask}, "
        "or take an encoder that reads any text."
    )


def _of_kind(scene: Scene, request: ResolvedQuery) -> tuple[str, ...]:
    """Return the words of the scene's objects that are of a kind that a text names, such as "penguin" for "bird"."""
    positives = (request.asked_as.get(place) for place in range(len(request.query.positives)))
    members = frozenset[str]().union(*(members_of(wording.word) for wording in positives if wording))
    if not members or isinstance(request.references, str):
        return ()
    words = object_words(scene, request.references.words, request.references.vectors)
    return tuple(word for word in words if base_of(word) in members)[:SUGGESTED]


def _nearer_words(
    scene: Scene, request: ResolvedQuery, scores: np.ndarray, selected: np.ndarray, least: float
) -> tuple[str, ...]:
    """Return reference words that are the nearest of all to a share of the selected splats, or else the best ones."""
    references, positives = request.references, len(request.query.positives)
    own_rows = request.rows[:positives][request.by_cosine[:positives]]
    if not isinstance(references, References) or not len(own_rows):
        return ()
    rows, weights = best_splats(scene, scores, selected if selected.any() else True)
    if not len(rows):
        return ()
    names = {
        normalize_text(base_of(word.word)) for word in request.asked_as.values()
    }  # "fish" and "fish (food)" are one
    is_own = (references.vectors @ own_rows.T >= SAME_WORD).any(axis=1)
    is_own |= np.array([word in names for word in references.plain_words])
    own_cosines, reference_cosines = products(scene.features[rows], scene.norms[rows], own_rows, references.vectors)
    reference_cosines[:, is_own] = -1.0
    nearest = np.where(reference_cosines.max(axis=1) > own_cosines.max(axis=1), reference_cosines.argmax(axis=1), -1)
    shares = np.bincount(nearest[nearest >= 0], weights[nearest >= 0], len(references.words)) / weights.sum()
    order = np.argsort(-shares, kind="stable")[:MOST_RIVALS]
    return tuple(references.words[row].replace("_", " ") for row in order.tolist() if shares[row] >= least)


def _set_answer(scene: Scene, query: Query) -> Answer:
    """Answer a query of sets: a score of one for their splats and zero for the others, also without a feature."""
    members = np.zeros(len(scene.features), np.bool_)
    for splat_set in query.splat_sets:
        members |= scene.set_members(splat_set)
    label, count, scores = ", ".join(query.sets), int(members.sum()), members.astype(np.float32)
    threshold = Threshold(value=0.5, method="set", explanation=f"the splats of {label}, as they are", clear=count > 0)
    presence = Presence(present=count > 0, presence=float(count > 0), reason=f"{label} has {count} splats.")
    return Answer.of(
        query, scores, np.ones_like(members), members,
        threshold=threshold, clear=count > 0, statistics=_statistics(scores), **dict(presence),
    )  # fmt: skip


def _select(
    scene: Scene, request: ResolvedQuery, mask: np.ndarray, scores: np.ndarray
) -> tuple[Threshold, np.ndarray]:
    """Return the threshold of a query and the selected splats, [P] bool.

    Args:
        mask: [n] bool, the terms that take part in the scores. scores: [K] f32, of the rows of the features.
    """
    threshold, row_mask, competitors = _select_rows(scene.distinct, request, mask, scores)
    selected = scene.has_feature & scene.features.of_splats(row_mask)
    if competitors is None:
        return threshold, selected
    (parts,) = part_nodes(scene, [competitors])
    if parts:
        selected = scene.has_feature & np.logical_or.reduce([scene.members(node) for node in parts])
        addition = f"levels differ in meaning, so the named parts are selected: {', '.join(map(str, parts))}"
    else:
        selected, addition = correct_by_objects(scene, selected, competitors)
    if addition:
        threshold = threshold.replace(explanation=f"{threshold.explanation.removesuffix('.')}; {addition}.")
    return threshold, selected


def _select_rows(
    scene: Scene, request: ResolvedQuery, mask: np.ndarray, scores: np.ndarray
) -> tuple[Threshold, np.ndarray, CompetingWords | None]:
    """Return the threshold of a query, the rows above it [K] bool, and the words by which objects correct them."""
    query, positives = request.query, len(request.query.positives)
    valid_scores = scores[scene.has_feature]
    in_words = (request.by_cosine & mask)[:positives]
    reference_words, table_words = _competing_words(request, request.rows[:positives][in_words])
    competitors = reference_words or table_words
    is_automatic = query.threshold == "auto" and in_words.any() and in_words.sum() == mask[:positives].sum()
    lack = explain_no_selection(valid_scores)
    is_of_word = lack and is_automatic and valid_scores.any()
    is_example = query.threshold == "auto" and not in_words.any() and len(mask) == 1
    if (is_example and _is_one_thing(scene, request.rows[0])) or (
        is_of_word and _are_of_word(scene, valid_scores, scores, competitors)
    ):
        return *_select_all(scene, valid_scores), None
    if lack:
        return *_select_nothing(scene, query, lack), None
    least = -math.inf if in_words.any() else LEAST_LIKENESS
    threshold = find_threshold(valid_scores, query.threshold, scene.weights, least)
    selected = scene.has_feature & (scores >= np.float32(threshold.value))
    if not is_automatic:
        return threshold, selected, None
    is_unclear = reference_words is None and has_one_mode(
        valid_scores, threshold.value, scene.weights, scene.effective_count
    )
    threshold = threshold.replace(clear=threshold.clear and not is_unclear)
    if is_unclear and _are_of_word(scene, valid_scores, scores, competitors):
        threshold, selected = _select_all(scene, valid_scores)
    if competitors is None:
        return threshold, selected, None
    comparison = compare_ranks(scene, scores, threshold.value, competitors)
    if reference_words is not None and comparison.rest >= NEAR:
        return *_select_all(scene, valid_scores), None
    if comparison.lowest > threshold.value:
        retry = find_threshold(valid_scores, "auto", scene.weights, comparison.lowest)
        value = max(retry.value, comparison.lowest)
        explanation = f"Below {comparison.lowest:.4g} other words are nearer. {retry.explanation}"
        is_clear = retry.clear and retry.value == value
        threshold = retry.replace(value=value, explanation=explanation, clear=is_clear)
        selected = scene.has_feature & (scores >= np.float32(value))
    threshold = threshold.replace(clear=threshold.clear and comparison.first >= LEAST_FIRST)
    if table_words is not None:
        selected = nearest_to_query(scene, selected, table_words)
    return threshold, selected, competitors


def _are_of_word(
    scene: Scene, valid_scores: np.ndarray, scores: np.ndarray, competitors: CompetingWords | None
) -> bool:
    """Return True if scores without a valley are those of the word: against competing words, or by themselves."""
    if competitors is not None:
        return compare_ranks(scene, scores, math.inf, competitors).rest >= NEAR
    return float(valid_scores.min()) >= SAME_AS_WORD


def _is_one_thing(scene: Scene, example: np.ndarray) -> bool:
    """Return True if a scene is alike to an example [F], and no valley parts it without the most similar splat."""
    rows = spaced(np.flatnonzero(scene.has_feature), MOST_COMPARED)
    similar = products(scene.features[rows], scene.norms[rows], example[None], example[None])[0][:, 0]
    if not len(rows) or similar.min() < SAME_AS_EXAMPLE:
        return False
    others = np.argsort(similar, kind="stable")[:-1]
    values, weights = similar[others], scene.total_weight[rows[others]]
    return not len(values) or has_one_mode(values, find_threshold(values, "auto", weights).value, weights)


def _select_nothing(scene: Scene, query: Query, explanation: str) -> tuple[Threshold, np.ndarray]:
    """Return a threshold above all scores, and no splats, [P] bool."""
    method = query.threshold if isinstance(query.threshold, str) else "fixed"
    threshold = Threshold(value=math.inf, method=method, explanation=explanation, clear=False)
    return threshold, np.zeros_like(scene.has_feature)


def _select_all(scene: Scene, valid_scores: np.ndarray) -> tuple[Threshold, np.ndarray]:
    """Return the threshold of a scene of one thing, and all of its splats, [P] bool."""
    low, explanation = (
        float(valid_scores.min()),
        "No part stands apart, as all is of one thing: it is selected whole.",
    )
    return Threshold(value=low, method="auto", explanation=explanation), scene.has_feature.copy()


def _select_each(
    scene: Scene, request: ResolvedQuery, mask: np.ndarray, similarities: np.ndarray, words: np.ndarray
) -> tuple[Threshold, np.ndarray]:
    """Return the lowest threshold of several words, and the splats that one of them selects by its own, [P] bool.

    Cosines of words differ in scale: by a common threshold a word of low ones selects nothing.
    """
    cuts, selected = list[Threshold](), np.zeros_like(scene.has_feature)
    for word in words.tolist():
        word_mask = mask.copy()
        word_mask[: len(request.query.positives)] = False
        word_mask[word] = True
        scores = np.where(
            scene.distinct.has_feature, combine(similarities[:, word_mask], 1), np.float32(LOWEST_COSINE)
        )
        threshold, of_word = _select(scene, request, word_mask, scores)
        cuts.append(threshold)
        selected |= of_word
    explanation = " ".join(
        f"{request.query.positives[word]!r}: {cut.explanation}" for word, cut in zip(words, cuts, strict=True)
    )
    lowest = min(cuts, key=lambda cut: cut.value)
    return lowest.replace(explanation=explanation, clear=all(cut.clear for cut in cuts)), selected


def _competing_words(
    request: ResolvedQuery, directions: np.ndarray
) -> tuple[CompetingWords | None, CompetingWords | None]:
    """Return the words that compete with the positives [p, F]: reference words, and the others of a small table."""
    reference_words = table_words = None
    if len(directions) and isinstance(request.references, References):
        reference_words = CompetingWords.among(request.references, directions)
    if len(directions) and request.small_table is not None:
        table_words = CompetingWords.of_small_table(request.small_table, directions)
    return reference_words, table_words if table_words and len(table_words.vectors) else None


def _presence(scene: Scene, request: ResolvedQuery, similarities: np.ndarray) -> tuple[Presence, np.ndarray]:
    """Return the presence of the positives, and the terms that count, [n] bool: all, or without absent words."""
    mask, positives = np.ones(len(request.rows), np.bool_), len(request.query.positives)
    words = np.flatnonzero(request.by_cosine[:positives]).tolist()
    if not words:
        return NOT_IN_WORDS, mask
    if isinstance(request.references, str):
        return Presence(present=None, presence=None, reason=request.references), mask
    names = [repr(term) if isinstance(term, str) else str(term) for term in request.query.positives]
    presences = [
        estimate_presence(scene, names[k], request.rows[k], similarities[:, k], request.references) for k in words
    ]
    presence = any_present(presences)
    if presence.present is False and len(words) < positives:  # examples may be present
        presence = presence.replace(present=None)
    if presence.present is not False and request.query.absent == "drop":
        mask[[k for k, word in zip(words, presences, strict=True) if word.present is False]] = False
    return presence, mask


def _statistics(scores: np.ndarray) -> dict[str, float]:
    """Return the least, the largest and the mean of scores [n] f32."""
    if not len(scores):
        return {}
    return {"min": float(scores.min()), "max": float(scores.max()), "mean": float(scores.astype(np.float64).mean())}
