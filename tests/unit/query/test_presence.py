"""Presence of an object: real CLIP vectors of words on splats, with the noise and the cone of image vectors."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidQuery
from liftcore.query.ask import ask
from liftcore.query.export import object_splats
from liftcore.query.presence import References, references_of
from liftcore.query.question import Query
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.query.segment import segment
from liftcore.query.terms import SplatTerm
from liftcore.text import LVIS_TABLE, CachingEncoder
from liftcore.text.table import TableEncoder
from tests.promises.tiny_files import photo_vectors, scene_with
from tests.tiny_scene import SPLATS_A_CLUSTER

COUNT = 3 * SPLATS_A_CLUSTER
PRESENT_WORDS = ("cat", "boat", "pizza")


@pytest.fixture(scope="module")
def clip() -> Scene:
    """Three clusters as photos of a cat, a boat and a pizza: cosine .29 to their own words, .22 to others."""
    return scene_with(photo_vectors([word for word in PRESENT_WORDS for _ in range(SPLATS_A_CLUSTER)], 0.25))


def test_an_absent_word_leaves_an_example_beside_it_and_has_no_splats(clip: Scene, table: TableEncoder) -> None:
    answer, by_example = (ask(clip, Query.of(terms), table) for terms in ((SplatTerm(0), "sofa"), (SplatTerm(0),)))
    assert np.array_equal(answer.selected, by_example.selected) and answer.count > 0 and answer.present is None
    with pytest.raises(InvalidQuery, match="absent=keep"):
        object_splats(clip, ask(clip, "sofa", table))


def test_references_that_mean_the_same_hide_nothing(clip: Scene, table: TableEncoder) -> None:
    rng = np.random.default_rng(2)
    near = table.encode(["cat"] * 30) + 0.01 * rng.normal(size=(30, 512))
    crowded = TableEncoder("crowded", (*table.words, *(f"cat {k}" for k in range(30))),
                           np.concatenate([table.embeddings, near]).astype(np.float32))  # fmt: skip
    assert ask(clip, "cat", crowded).present
    assert ask(clip, "sofa", crowded).present is False


def test_small_total_weight_makes_no_object(clip: Scene, table: TableEncoder) -> None:
    features = torch.cat([clip.lift.features, torch.from_numpy(table.encode(["sofa"]))])
    ones = torch.ones(COUNT + 1)
    values = {"rows": features, "has_feature": ones > 0}
    total_weight = torch.cat([torch.ones(COUNT), torch.tensor([1e-4])])
    for weight, present in ((1e-4, False), (1.0, True)):
        total_weight[-1] = weight
        lifted = Scene(replace(clip.lift, total_weight=total_weight.clone(), **values))
        assert ask(lifted, "sofa", table).present is present


class RecordingEncoder:
    """Text encoder of the shipped words in another space; ``texts`` are those that it encoded."""

    channels = 64

    def __init__(self, seed: int) -> None:
        self.name, self.texts = "recording", list[str]()
        self._projection = np.random.default_rng(seed).normal(size=(512, 64))
        self._table = TableEncoder.open(LVIS_TABLE)

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        self.texts += texts
        rows = self._table.encode(texts) @ self._projection
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_an_encoder_makes_its_references_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, second, other = RecordingEncoder(0), RecordingEncoder(0), RecordingEncoder(1)
    references = references_of(first, "")
    assert isinstance(references, References) and 200 <= len(references.words) <= len(first.texts)
    cached = references_of(CachingEncoder(second), "")
    assert isinstance(cached, References) and cached.words == references.words and len(second.texts) == 1
    np.testing.assert_allclose(cached.vectors, references.vectors, atol=1e-3)
    recomputed = references_of(other, "")  # an encoder of the same name with other vectors
    assert isinstance(recomputed, References) and len(other.texts) > len(recomputed.words)


def test_words_of_splats_that_are_not_selected_are_no_rivals(table: TableEncoder) -> None:
    subject = scene_with(table.encode(["boat"] * 200 + ["cat"]), np.append(np.ones(200), 1e-4))
    answer = ask(subject, Query.of("cat", threshold=0.95, absent="keep"), table)
    assert answer.count == 1 and not answer.rivals


def test_without_references_presence_is_not_known(clip: Scene, table: TableEncoder) -> None:
    axes = TableEncoder("axes", ("cat",), np.eye(512, dtype=np.float32)[:1])
    unknown = ask(clip, "cat", axes)
    assert (unknown.present, unknown.presence) == (None, None) and unknown.count > 0
    assert "200 words" in unknown.reason
    few = TableEncoder("few", ("cat", "sofa"), table.encode(["cat", "sofa"]))  # recognised as CLIP by its vectors
    assert ask(clip, "sofa", few).presence == ask(clip, "sofa", table).presence


def test_vectors_of_words_are_present_or_absent_too(clip: Scene, table: TableEncoder) -> None:
    cat, sofa = table.encode(["cat", "sofa"])
    assert LiftResult.of(clip.lift).query(cat).present and LiftResult.of(clip.lift).query(sofa).present is False
    assert not LiftResult.of(clip.lift).query(sofa, splats=clip.splats).selected.any()
    assert LiftResult.of(clip.lift).query(sofa, absent="keep").selected.any()
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(512, 512)))[0].astype(np.float32)
    rotated = LiftResult.of(replace(clip.lift, rows=clip.lift.features @ torch.from_numpy(rotation)))
    assert rotated.query(sofa @ rotation).present is None


def test_many_words_follow_the_same_rule(clip: Scene, table: TableEncoder) -> None:
    words = ["cat", "sofa", "lamp"]  # without the presence test, some splats would be a sofa
    segmentation = segment(clip, words, table.encode(words))
    assert [label.word for label in segmentation.named_words] == ["cat"]
    assert set(segmentation.rows.tolist()) <= {-1, 0}
