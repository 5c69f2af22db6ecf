"""Typed phrases: lists and negations select what they say, and what scores cannot answer is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
import torch

from tests.promises.tiny_files import photo_vectors, scene_with, write_table

OBJECTS = ("mug", "bowl", "lamp")
SPLATS = 20  # of each
READ = {
    "mug": "mug", "the small red mug": "mug", "mugs": "mug", "Where is the mug?": "mug", "mug, please": "mug",
    "please show me the mugs": "mug", "a photo of a mug": "mug", "the black and white mug": "mug",
    "only the mug": "mug", "I'm looking for the mug": "mug", "bowl mug": "mug",
    "mug\nbowl": "mug bowl", "1. mug 2. bowl": "mug bowl", "both the mug and the bowl": "mug bowl",
    "mug, bowl": "mug bowl", "mug; bowl": "mug bowl", "the mug and the bowl": "mug bowl", "mug or lamp": "mug lamp",
    "mug & bowl": "mug bowl", "mug/bowl": "mug bowl", "a red mug, a bowl, and the lamps": "mug bowl lamp",
    "I want the bowl as well as the lamp": "bowl lamp", "mug, mug": "mug", "mug but not the bowl": "mug",
    "the lamp, not the mug": "lamp", "lamp without bowls": "lamp", "mug and bowl except the lamp": "mug bowl",
    "mug -bowl": "mug", "mug (not bowl)": "mug", "mug w/o bowls": "mug", "mug \u00b7 bowl": "mug bowl",
    "mug\tbowl": "mug bowl", "mug vs. bowl": "mug bowl", '"mug"': "mug",
    '"mug", "bowl"': "mug bowl", 'mug -"bowl"': "mug", "\u201cmug\u201d": "mug",
    "not the mug but the bowl": "bowl", "bowl rather than mug": "bowl", "bowl, not mug, not lamp": "bowl",
}  # fmt: skip
REFUSALS = {
    "not the mug": "what it is not", "no mug": "what it is not", "everything except the mug": "what it is not",
    "all but the mug": "what it is not", "remove the mug": "what it is not", "don't show mugs": "what it is not",
    "neither mug nor bowl": "what it is not", "mug, not mug": "what it is not",
    "the bowl to the left of the mug": "ask for 'bowl'", "mug in front of the bowl": "ask for 'mug'",
    "the mug next to the lamp": "ask for 'mug'", "lamp between mug and bowl": "ask for 'lamp'",
    "bowl on the mug": "ask for 'bowl'", "bowl sitting under the lamp": "ask for 'bowl'", "left mug": "ask for 'mug'",
    "bowl holding a mug": "ask for 'bowl'", "two mugs": "ask for 'mugs'", "the biggest bowl": "ask for 'bowl'",
    "what is on the lamp": "by its name", "the mug's lamp, bowl": "alone", "mug, boowl": "nearest: bowl",
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> lc.Scene:
    """A mug, a bowl and a lamp, with vectors as of photos."""
    return scene_with(photo_vectors(list(np.repeat(OBJECTS, SPLATS)), 0.25))


def things_of(answer: lc.Answer) -> str:
    """Return the things of which most splats are selected."""
    shares = answer.selected.reshape(len(OBJECTS), SPLATS).mean(axis=1)
    assert ((shares > 0.8) | (shares < 0.2)).all(), shares
    return " ".join(name for name, share in zip(OBJECTS, shares, strict=True) if share > 0.5)


@pytest.mark.parametrize("phrase", READ)
def test_a_phrase_selects_the_things_that_it_names(scene: lc.Scene, phrase: str) -> None:
    answer = scene.ask(phrase, encoder="lvis", places=False)
    assert things_of(answer) == READ[phrase]
    assert phrase in OBJECTS or {match.text for match in answer.wording} == {phrase}


@pytest.mark.parametrize("phrase", REFUSALS)
def test_a_phrase_that_scores_cannot_answer_is_refused(scene: lc.Scene, phrase: str) -> None:
    with pytest.raises(lc.InvalidQuery) as refusal:
        scene.ask(phrase, encoder="lvis", places=False)
    assert REFUSALS[phrase] in str(refusal.value)


def test_an_answer_says_how_a_phrase_was_read(scene: lc.Scene) -> None:
    phrase = "red mugs or bowls but not the lamp"
    answer = scene.ask(phrase, encoder="lvis", places=False)
    matches = [(match.text, match.word, match.match) for match in answer.wording]
    assert matches == [(phrase, "mug", "list"), (phrase, "bowl", "list"), (phrase, "lamp", "negation")]
    assert answer.text == ["red mugs", "bowls"]


@pytest.mark.parametrize(("kind", "members"), [("bird", ("penguin",)), ("pet", ("cat",)), ("sofa", ())])
def test_a_kind_that_is_not_there_names_its_members_that_are(kind: str, members: tuple[str, ...]) -> None:
    things = ["penguin"] * 30 + ["violin"] * 30 + ["cat"] * 30
    objects = torch.from_numpy(np.repeat(np.arange(3, dtype=np.int32), 30))
    scene = scene_with(photo_vectors(things), object=objects, object_views=torch.zeros(3, 5, dtype=torch.int32))
    answer = scene.ask(kind, encoder="lvis", places=False)
    assert answer.present is False and not answer.count
    assert not members or answer.rivals == members
    assert ("Of its kind in this scene: " + ", ".join(map(repr, members)) in answer.reason) is bool(members)
    unwanted = scene.ask(lc.Query(text=["sofa"], negatives=[kind]), encoder="lvis", places=False)
    assert unwanted.present is False and "Of its kind" not in unwanted.reason


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.25])
def test_a_scene_of_one_thing_is_selected_whole_or_not_at_all(noise: float) -> None:
    mugs = scene_with(photo_vectors(["mug"] * 80, noise))
    answers = {word: mugs.ask(word, encoder="lvis", places=False) for word in ("mug", "bowl", "lamp")}
    assert [answer.count for answer in answers.values()] == [80, 0, 0]
    assert [answer.present for answer in answers.values()] == [True, False, False]
    assert "all is of one thing" in answers["mug"].threshold.explanation


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_an_example_selects_a_scene_of_one_thing_whole(noise: float) -> None:
    mugs = scene_with(photo_vectors(["mug"] * 80, noise))
    assert mugs.ask(lc.Query(like=["splat:3"]), places=False).count == 80
    two = scene_with(photo_vectors(["mug"] * 40 + ["lamp"] * 40, noise / 10))
    assert two.ask(lc.Query(like=["splat:3"]), places=False).count == 40


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2, 0.1])
def test_a_valley_between_equals_is_none(noise: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    encoders = [
        write_table(tmp_path / f"{count}.safetensors", OBJECTS[:count], np.eye(3)[:count]) for count in (1, 3)
    ]
    mugs, weights = np.eye(3)[[0] * 80] + noise * rng.normal(size=(80, 3)), rng.exponential(size=80) + 0.01
    for scene in (scene_with(mugs), scene_with(mugs, weights)):
        assert [scene.ask("mug", encoder=encoder, places=False).count for encoder in encoders] == [80, 80]
        lift: Any = scene.lift
        assert lift.query(np.eye(3)[0]).count == 80
    two = mugs.copy()
    two[:5] += [[-1, 1, 0]]
    assert [scene_with(two).ask(word, encoder=encoders[1], places=False).count for word in OBJECTS[:2]] == [75, 5]


def test_words_of_a_table_are_themselves_whatever_is_in_them(tmp_path: Path) -> None:
    words = ["mug and bowl", "no parking", "bowl on a lamp"]
    scene = scene_with(np.repeat(np.eye(3), SPLATS, axis=0))
    encoder = write_table(tmp_path / "words.safetensors", words, np.eye(3))
    for row, word in enumerate(words):
        selected = scene.ask(word, encoder=encoder, places=False).selected
        assert np.array_equal(np.flatnonzero(selected), np.arange(row * SPLATS, (row + 1) * SPLATS))
