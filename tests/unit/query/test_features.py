"""Questions of features as codes have the answers of the same features, a row a splat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.query.scores import Features
from liftcore.query.threshold import find_threshold
from tests.promises.tiny_files import photo_vectors, row_of_splats, scene_with

COUNT = 6_000
WORDS = ("cat", "boat", "pizza", "mug", "curtain")
REGIONS = 20  # of each word


@pytest.fixture(scope="module")
def scenes() -> list[lc.Scene]:
    """A lift of clusters of five words, a hundredth without a feature; exact, and the same features as codes."""
    rng = np.random.default_rng(1)
    clusters = rng.integers(0, len(WORDS), COUNT)
    regions = photo_vectors([word for word in WORDS for _ in range(REGIONS)], 0.3)
    codebook = np.concatenate([np.zeros_like(regions[:1]), regions]).astype(np.float16)
    code = (1 + clusters * REGIONS + rng.integers(0, REGIONS, COUNT)).astype(np.uint16)
    code[::100] = 0
    objects = np.where(rng.random(COUNT) < 0.9, clusters, rng.integers(-1, len(WORDS), COUNT)).astype(np.int32)
    lift = scene_with(codebook[code[:12]].astype(np.float32)).lift
    columns = {
        "features": codebook[code],
        "total_weight": rng.random(COUNT, np.float32) * (code > 0),
        "has_feature": code > 0,
        "object": objects,
        "object_views": np.zeros((len(WORDS), 5), np.int32),
    }
    tensors = {name: torch.from_numpy(column) for name, column in columns.items()}
    lift = replace(lift, **tensors, metadata=lift.metadata.model_copy(update={"landmarks": ()}))
    exact, coded = (lc.Scene(lift, row_of_splats(COUNT)) for _ in range(2))
    coded.features = Features(codebook, code)
    return [exact, coded]


@pytest.mark.parametrize("text", [*WORDS, "sofa", "cat and mug", "cat but not the mug"])
def test_codes_answer_words_as_their_rows_do(scenes: list[lc.Scene], text: str) -> None:
    exact, coded = (scene.ask(text, encoder="lvis") for scene in scenes)
    assert np.array_equal(exact.scores, coded.scores) and np.array_equal(exact.selected, coded.selected)
    assert exact.threshold == coded.threshold and exact.rivals == coded.rivals
    assert (exact.present, exact.presence, exact.reason) == (coded.present, coded.presence, coded.reason)
    assert coded.statistics == pytest.approx(exact.statistics, abs=1e-12)
    assert (exact.count > 0) == (text != "sofa")


def test_codes_answer_examples_as_their_rows_do(scenes: list[lc.Scene]) -> None:
    exact, coded = (scene.ask(lc.Query(like=["splat:5"])) for scene in scenes)
    np.testing.assert_allclose(coded.scores, exact.scores, atol=1e-5)
    assert exact.count and np.array_equal(exact.selected, coded.selected)


def test_codes_are_labelled_and_coloured_as_their_rows_are(scenes: list[lc.Scene]) -> None:
    exact, coded = (scene.segment([*WORDS, "sofa"], encoder="lvis") for scene in scenes)
    assert np.array_equal(exact.labels, coded.labels) and (exact.labels >= 0).mean() > 0.8
    assert np.array_equal(exact.score, coded.score) and np.array_equal(exact.margin, coded.margin)
    has_feature = torch.from_numpy(scenes[1].has_feature)
    assert torch.equal(scenes[1].principal.any(dim=1), has_feature)


def test_objects_of_codes_have_the_means_of_their_rows(scenes: list[lc.Scene]) -> None:
    exact, coded = scenes
    np.testing.assert_allclose(coded.object_means, exact.object_means, atol=1e-6)
    np.testing.assert_allclose(coded.mean, exact.mean, atol=1e-6)
    assert np.array_equal(coded.norms, exact.norms) and np.array_equal(coded.has_feature, exact.has_feature)


@pytest.mark.parametrize("weighted", [False, True])
def test_threshold_over_rows_is_that_over_splats(weighted: bool) -> None:
    rng = np.random.default_rng(0)
    code = rng.integers(0, 900, 50_000)
    scores = np.sort(rng.normal(0.2, 0.02, 900) + (np.arange(900) > 800) * 0.1).astype(np.float32)
    weights = rng.random(len(code), np.float32) if weighted else np.ones(len(code), np.float32)
    for method in ("auto", "paper"):
        splats = find_threshold(scores[code], method, weights)
        assert find_threshold(scores, method, np.bincount(code, weights, 900)) == splats
