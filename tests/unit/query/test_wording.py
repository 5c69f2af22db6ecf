"""Words as people type them: the word of the table that stands for each, and errors for those without one."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidQuery
from liftcore.query.scene import Scene
from liftcore.text import open_encoder
from liftcore.text.phrases import part_phrases
from liftcore.text.table import TableEncoder, Vocabulary

OF_SCENE = ["cat", "cow", "doughnut", "boat", "airplane", "flowerpot", "fish", "hammer", "pizza", "violin", "teapot"]


@cache
def lvis() -> Vocabulary:
    encoder = open_encoder("lvis")
    assert isinstance(encoder, TableEncoder)
    return encoder.vocabulary


def test_every_word_of_a_table_is_asked_as_it_is() -> None:
    assert [word for word in lvis().words if lvis().find(word) != (word, word, "")] == []
    assert lvis().find("THE  Trash_Can") == ("THE  Trash_Can", "trash can", "")


@pytest.mark.parametrize(
    ("text", "word", "match"),
    [
        ("tea cup", "teacup", "spelling"),
        ("Tea-Pot?", "teapot", "spelling"), ("octopus", "octopus (animal)", "qualifier"),
         ("donut", "doughnut", "synonym"),
        ("people", "person", "synonym"), ("hot dog", "sausage", "synonym"), ("apples", "apple", "number"),
         ("knives", "knife", "number"),
        ("cherries", "cherry", "number"), ("trouser", "trousers", "number"),
        ("a small toy car", "car (automobile)", "head"),
         ("a photo of cows", "cow", "head"), ("cup of tea", "cup", "head"),
         ("a pizza slice", "pizza", "head"), ("man with a hat", "person", "head"),
         ("the fish's tail", "fish", "head"),
    ],
)  # fmt: skip
def test_text_is_asked_as_the_word_that_stands_for_it(text: str, word: str, match: str) -> None:
    assert lvis().find(text) == (text, word, match)


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("animal", "cat"), ("food", "pizza"), ("xylophone", "musical instrument"),
         ("pinguin", "penguin"),
        ("a furry creature", "cat"), ("utensils", "cooking utensil"),
    ],
)  # fmt: skip
def test_what_nothing_stands_for_has_words_near_to_it(text: str, nearest: str) -> None:
    assert lvis().find(text) is None
    near = lvis().nearest(text)
    assert 1 <= len(near) <= 5 and all(word in lvis() for word in near)
    assert nearest in near


@pytest.mark.parametrize("text", ["sky", "asdfgh", "Tisch", "red", "?", "the", "\u732b", "x" * 1000, "a " * 500])
def test_what_is_like_nothing_has_no_words_near_to_it(text: str) -> None:
    assert lvis().find(text) is None and lvis().nearest(text) == ()


@pytest.mark.parametrize(
    ("text", "object_phrase", "part"),
    [
        ("the mug's handle", "mug", "handle"), ("handles of the mug", "mug", "handle"),
        ("mug handle", "mug", "handle"), ("wheel of my old car", "car (automobile)", "wheel"),
        ("the red mug's handle", "mug", "handle"),
        ("the mugs' handles", "mug", "handle"),
        ("the broken handle of the red mug", "mug", "handle"),
        ("a red coffee mug", None, None), ("slices of apples", None, None),
        ("cup of tea", None, None), ("a photo of the cat", None, None),
        ("lamp shade", None, None),  ("a " * 500, None, None), ("cat", None, None),
    ],
)  # fmt: skip
def test_part_and_thing_of_a_phrase_are_found(text: str, object_phrase: str | None, part: str | None) -> None:
    phrase = lvis().find_part(text)
    assert (phrase.object_phrase, phrase.part) == (object_phrase, part) if phrase else object_phrase is None


@pytest.mark.parametrize("text", ["men's shoes", "children\u2019s toys", "babies' bottles"])
def test_several_owners_without_an_article_may_name_a_kind(text: str) -> None:
    kind, *parts = [next(part_phrases(first + text)).sure for first in ("", "the ", "my ")]
    assert not kind and all(parts)
    assert next(part_phrases("baby's bottle")).sure
    wording = lvis().find(text)
    assert wording is not None and wording.word in ("shoe", "toy", "bottle")


def test_a_part_that_no_word_stands_for_is_separated_from_its_object() -> None:
    assert lvis().unknown_part("the black cat's tail") == ("cat", "tail", True)
    assert lvis().unknown_part("tip of the umbrella") == ("umbrella", "tip", True)
    texts = ("the mug's handle", "cat", "cat tail", "the zebu's tail", "cup of tea", "a photo of the cat")
    assert [lvis().unknown_part(text) for text in texts] == [None] * len(texts)


def test_words_of_a_short_table_are_found_by_synonyms() -> None:
    vocabulary = Vocabulary(OF_SCENE)
    assert [vocabulary.find(text) for text in ("kitten", "teacup", "bull", "wolf")] == [None] * 4
    assert vocabulary.nearest("teacup") == ("teapot",) and vocabulary.nearest("guitar") == ("violin",)
    assert vocabulary.find("ship") == ("ship", "boat", "synonym")
    assert vocabulary.find("plane") == ("plane", "airplane", "synonym")
    assert Vocabulary(["donut", "Car_(Automobile)"]).find("doughnuts") == ("doughnuts", "donut", "synonym")
    assert Vocabulary(["donut", "Car_(Automobile)"]).find("cars") == ("cars", "Car (Automobile)", "number")


def test_words_of_the_scene_come_first_of_their_kind() -> None:
    assert lvis().nearest("animals", first=["penguin", "fish"])[:2] == ("fish", "penguin")


def test_what_is_typed_is_completed_by_words_synonyms_and_letters() -> None:
    typed = ("dou", "don", "the tea", "pingu", "bunn", "")
    words = {text: [completion.word for completion in lvis().complete(text)] for text in typed}
    assert words["dou"][0] == "doughnut" and "doughnut" in words["don"] and "teapot" in words["the tea"]
    assert "penguin" in words["pingu"] and "rabbit" in words["bunn"] and words[""] == []
    assert ("doughnut", "donut") in lvis().complete("don") and len(lvis().complete("c", 5)) == 5


def test_words_of_the_scene_are_suggested_for_an_unknown_one(scene: Scene) -> None:
    table = TableEncoder("words", ["apple", "book", "lamp"], np.eye(3, scene.channels, dtype=np.float32))
    with pytest.raises(InvalidQuery, match="got 'boook'") as info:
        scene.ask("boook", encoder=table)
    assert info.value.nearest == ("book",)
    with pytest.raises(InvalidQuery) as info:
        scene.ask("sky", encoder=table)
    assert set(info.value.nearest or ()) == {"apple", "book", "lamp"}  # what is in the scene
    assert scene.suggested_words("ap", encoder=table).words[0].word == "apple"
    assert set(scene.suggested_words(encoder=table).scene_words) == {"apple", "book", "lamp"}


def test_a_word_near_to_all_of_the_scene_names_none_of_its_objects(scene: Scene) -> None:
    axes = np.eye(scene.channels, dtype=np.float32)
    table = TableEncoder("words", ["apple", "book", "lamp", "desk"], axes[[0, 1, 2, 5]])
    near_to_all = 0.8 * axes[5] + 0.6 * axes[scene.object]
    lift = replace(scene.lift, rows=torch.from_numpy(near_to_all), code=None)
    assert Scene(lift).suggested_words(encoder=table).scene_words == ()
