"""Rules of a selection: other words compete, zero scores select nothing, objects are selected as a whole."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.query.ask import ask
from liftcore.query.presence import References
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.query.selection import CompetingWords, correct_by_objects
from liftcore.text.table import TableEncoder

from .made_up import lifted


def pictures(table: TableEncoder, words: Sequence[str], noise: float, hub: float = 0.0) -> np.ndarray:
    """Return [n, 512], vectors like those of photos: cosine .29 to their word, .22 to others; ``hub`` adds hub words.

    Hub words are nearer to all vectors than other words are, by a vector of length ``hub`` towards them.
    """
    rows, mean = table.encode(words), table.embeddings.mean(axis=0)
    gap = np.random.default_rng(5).normal(size=512)
    gap -= mean * (gap @ mean) / np.square(mean).sum()
    hubs = (table.encode(table.words[::100]) - mean).sum(axis=0)
    offsets = np.random.default_rng(0).normal(size=rows.shape)
    offsets *= noise / np.linalg.norm(offsets, axis=1, keepdims=True)
    return 0.28 * rows + 0.9 * gap / np.linalg.norm(gap) + hub * hubs / np.linalg.norm(hubs) + offsets


def test_presence_hidden_by_hubs_is_unsure_and_selected(scene: Scene, table: TableEncoder) -> None:
    """Splats nearer to some hub words than to their own word, as images may be: contrast still separates them."""
    words = [word for word in ("cat", "boat", "pizza") for _ in range(200)]
    with_hubs = lifted(scene, pictures(table, words, 0.2, hub=0.3))
    answer = ask(with_hubs, "pizza", table)
    assert answer.present is None and "not sure" in answer.reason
    assert answer.presence is not None and answer.presence < 0.5
    assert answer.selected[400:].mean() > 0.9 and answer.count < 300
    assert ask(with_hubs, "sofa", table).present is False


def test_mostly_selected_object_is_selected_whole_unless_it_holds_two(scene: Scene, table: TableEncoder) -> None:
    words = ["cat"] * 300 + ["boat"] * 200 + ["pizza"] * 200
    rows = pictures(table, words, 0.1)
    rows[200:300] = pictures(table, ["cat"] * 100, 0.1) * 0.6 + 0.4 * pictures(table, ["zebra"] * 100, 0.1)
    views = torch.zeros((3, 5), dtype=torch.int32)
    separate_labels = torch.from_numpy(np.repeat([0, 1, 2], [300, 200, 200]).astype(np.int32))
    # Half of the boat is in the cat's object.
    mixed_labels = torch.from_numpy(np.repeat([0, 1, 2], [400, 100, 200]).astype(np.int32))
    cut = ask(lifted(scene, rows), "cat", table)
    complete = ask(lifted(scene, rows, object=separate_labels, object_views=views), "cat", table)
    assert cut.selected[:200].mean() > 0.9
    assert np.flatnonzero(complete.selected).tolist() == list(range(300))
    of_mixed = ask(lifted(scene, rows, object=mixed_labels, object_views=views), "cat", table)
    assert not of_mixed.selected[300:].any()


@pytest.mark.parametrize("weight", [0.1, 0.6])  # of its splats: most of the object's weight is the cat's, or not
def test_rest_of_an_object_is_added_only_if_it_answers_by_itself(
    scene: Scene, table: TableEncoder, weight: float
) -> None:
    """A larger thing that masks join with a cat, seen by few rays: it is like no other object, and smoothed."""
    words = ["cat"] * 300 + ["sofa"] * 900 + ["pizza"] * 400
    rows = pictures(table, words, 0.1)
    rows[300:1200] = 0.75 * rows[300:1200] + 0.25 * pictures(table, ["cat"] * 900, 0.1)
    numbers = torch.from_numpy(np.repeat([0, 1], [1200, 400]).astype(np.int32))
    weights = torch.from_numpy(np.repeat([1, weight, 1], [300, 900, 400]).astype(np.float32))
    objects = {"object": numbers, "object_views": torch.zeros((2, 5), dtype=torch.int32), "total_weight": weights}
    answer = ask(lifted(scene, rows, **objects), "cat", table)
    assert answer.selected[:300].mean() > 0.9
    assert answer.selected[300:].mean() < 0.02, answer.threshold.explanation


def test_word_near_to_all_of_a_scene_keeps_no_rest_from_its_thing(scene: Scene, table: TableEncoder) -> None:
    rows = pictures(table, ["cat"] * 300 + ["boat"] * 200 + ["pizza"] * 200, 0.1)
    rows[130:300] *= 0.8
    boat, cat = table.encode(["boat", "cat"])
    bias = 0.12 * (boat - cat)  # the same for all splats: it makes the rest of the cat nearer to the boat's word
    numbers = torch.from_numpy(np.repeat([0, 1, 2], [300, 200, 200]).astype(np.int32))
    views, cats = torch.zeros((3, 5), dtype=torch.int32), np.arange(700) < 130
    rivals = CompetingWords.among(References(tuple(table.words), table.embeddings), cat[None])
    subject = lifted(scene, rows + bias, object=numbers, object_views=views)
    remainder = subject.mean_of(np.arange(130, 300))
    assert remainder @ boat > remainder @ cat
    answer, _ = correct_by_objects(subject, cats, rivals)
    assert np.array_equal(answer, np.arange(700) < 300)


def test_object_with_another_nearer_word_is_not_selected(scene: Scene, table: TableEncoder) -> None:
    words = ["sheep"] * 300 + ["cow"] * 200 + ["curtain"] * 1200
    labels = torch.from_numpy(np.repeat([0, 1, 2], [300, 200, 1200]).astype(np.int32))
    rows, views = pictures(table, words, 0.1), torch.zeros((3, 5), dtype=torch.int32)
    rows[:40] = 0.5 * rows[:40] + 0.5 * pictures(table, ["cow"] * 40, 0.1)  # a part of the sheep, a little like a cow
    merged = pictures(table, ["cow"] * 40 + words[40:], 0.1)  # a cow that masks merge with the sheep
    ways: tuple[dict[str, Any], ...] = {}, {"object": labels, "object_views": views}
    cases = [ask(lifted(scene, features, **fields), "cow", table) for features in (rows, merged) for fields in ways]
    assert cases[0].selected[:40].mean() > 0.5 and not cases[1].selected[:300].any()
    assert "another word is nearer" in cases[1].threshold.explanation
    assert cases[2].selected[:40].mean() > 0.5 and (cases[3].selected >= cases[2].selected)[:40].all()
    assert all(case.selected[300:500].mean() > 0.9 for case in cases)


def test_of_an_object_that_holds_two_the_nearer_part_is_selected(scene: Scene, table: TableEncoder) -> None:
    words = ["cat"] * 300 + ["boat"] * 200 + ["pizza"] * 200
    rows = pictures(table, words, 0.1)
    rows[250:300] = 0.55 * rows[250:300] + 0.45 * pictures(table, ["zebra"] * 50, 0.1)
    labels = np.repeat([0, 1, 2], [360, 140, 200]).astype(np.int32)  # sixty splats of the boat are in the cat's
    views = torch.zeros((3, 5), dtype=torch.int32)
    cut = ask(lifted(scene, rows), "cat", table)
    answer = ask(lifted(scene, rows, object=torch.from_numpy(labels), object_views=views), "cat", table)
    assert cut.selected[250:300].mean() < 0.5 < answer.selected[250:300].mean()
    assert not answer.selected[300:].any()


@pytest.fixture
def handles(scene: Scene, table: TableEncoder) -> Scene:
    """Two mugs, one with one handle and one with two, a cat without a handle, and a handle of no object."""
    rows = pictures(table, ["mug"] * 600 + ["cat"] * 300 + ["handle"] * 60 + ["curtain"] * 1200, 0.1)
    for first in (140, 300, 500):
        part = slice(first, first + 50)
        rows[part] = 0.4 * rows[part] + 0.6 * pictures(table, ["handle"] * 50, 0.1)
    labels = torch.from_numpy(np.repeat([0, 1, 2, 3, 4], [200, 400, 300, 60, 1200]).astype(np.int32))
    return lifted(scene, rows, object=labels, object_views=torch.zeros((5, 5), dtype=torch.int32))


@pytest.mark.parametrize("phrase", ["the mug's handles"])
def test_phrase_finds_the_part_within_the_thing_alone(phrase: str, handles: Scene, table: TableEncoder) -> None:
    answer = ask(handles, phrase, table)
    expected = np.concatenate([np.arange(first, first + 50) for first in (140, 300, 500)])
    assert answer.selected[expected].mean() > 0.9 and not np.delete(answer.selected, expected).any()
    (wording,) = answer.wording
    assert (wording.text, wording.word, wording.match) == (phrase, "handle of the mug", "part")
    assert answer.present is not False and "Within it" in answer.reason and answer.query.text == [phrase]


def test_part_of_a_thing_without_one_or_of_none_is_not_there(handles: Scene, table: TableEncoder) -> None:
    for phrase in ("handle of the cat", "the cat's handle", "handle of the teapot"):
        answer = ask(handles, phrase, table)
        assert answer.count == 0 and answer.present is False, phrase
    assert "teapot" in answer.reason and "no parts" in answer.reason
    loose = ask(handles, "cat handle", table)  # two nouns in a row, which may mean something else
    assert loose.count == ask(handles, "handle", table).count > 0 and loose.wording[0].match == "head"


def test_part_that_is_nearly_all_of_the_thing_is_none(handles: Scene, table: TableEncoder) -> None:
    words = TableEncoder("words", ["cat", "handle"], table.encode(["cat", "cat"]))
    answer = ask(handles, Query.of(("handle of the cat",), threshold=0.0), words)
    assert answer.count == 0 and answer.present is False and "no part" in answer.reason
    assert ask(handles, Query.of(("handle of the cat",), threshold=0.0, absent="keep"), words).count == 300


@pytest.mark.parametrize(("level_agreement", "by_node"), [(0.89, True), (0.91, False)])
def test_word_of_a_part_takes_its_node_where_levels_differ(
    scene: Scene, table: TableEncoder, level_agreement: float, by_node: bool
) -> None:
    rows = pictures(table, ["mug"] * 300 + ["cat"] * 300 + ["curtain"] * 900, 0.1)
    rows[:60] = 0.85 * rows[:60] + 0.15 * pictures(table, ["handle"] * 60, 0.1)  # the sum of both levels
    node_features = pictures(table, ["mug", "cat", "curtain", "handle", "mug"], 0.02)
    tree = {
        "object": np.repeat([0, 1, 2], [300, 300, 900]), "object_views": np.zeros((3, 5)),
        "node": np.repeat([3, 4, 1, 2], [60, 240, 300, 900]), "node_parents": np.array([-1, -1, -1, 0, 0]),
        "node_views": np.zeros((5, 5)),
    }  # fmt: skip
    fields: dict[str, Any] = {name: torch.from_numpy(values.astype(np.int32)) for name, values in tree.items()}
    fields |= {"node_confidence": torch.ones(5), "node_features": torch.from_numpy(node_features).half()}
    facts = {"diagnostics": {"objects": {"level_agreement": level_agreement}}}
    subject = lifted(scene, rows, metadata=scene.lift.metadata.model_copy(update=facts), **fields)
    answer = ask(subject, Query.of(("handle",), absent="keep"), table)
    assert (np.flatnonzero(answer.selected).tolist() == list(range(60))) == by_node
    assert ("the named parts are selected" in answer.threshold.explanation) == by_node
    assert np.flatnonzero(ask(subject, "mug", table).selected)[[0, -1]].tolist() == [0, 299]
