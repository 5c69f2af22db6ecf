"""Segmentation by many words: the word of each splat or none, its pictures, and the best words for an example."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.io.splats import read_splats
from liftcore.query.colours import NO_CLUSTER_COLOUR
from liftcore.query.render import render
from liftcore.query.scene import Scene
from liftcore.query.segment import label_map, map_png, picture_png, segment
from liftcore.query.splat_colours import view_colours
from tests.tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH

EYE = np.eye(CHANNELS, dtype=np.float32)
COUNT = 3 * SPLATS_A_CLUSTER
CLUSTER = np.arange(COUNT) // SPLATS_A_CLUSTER


@pytest.fixture
def clear(scene: Scene) -> Scene:
    """Three clusters, each of one unit axis with noise."""
    rows = EYE[CLUSTER] + np.random.default_rng(0).normal(0, 0.05, (COUNT, CHANNELS)).astype(np.float32)
    ones = torch.ones(COUNT)
    lift = replace(scene.lift, rows=torch.from_numpy(rows), total_weight=ones, has_feature=ones > 0)
    lifted = Scene(lift, scene.splats, scene.cameras)
    lifted.splat_file = scene.splat_file
    return lifted


def test_words_that_are_not_there_name_nothing(clear: Scene) -> None:
    between = (EYE[0] + EYE[5]) / np.sqrt(2)  # the second best word of the first cluster
    words, vectors = ["apple", "pear", "book", "lamp", "void"], np.stack([EYE[0], between, *EYE[[1, 2, 7]]])
    segmentation = segment(clear, words, vectors)
    assert {label.word for label in segmentation.named_words} == {"apple", "book", "lamp"}
    assert np.array_equal(segmentation.rows, np.array([0, 2, 3])[CLUSTER])


def test_splats_of_no_word_and_unseen_ones_are_named_none(clear: Scene) -> None:
    segmentation, rest = segment(clear, ["apple", "book"], EYE[:2]), slice(2 * SPLATS_A_CLUSTER, None)
    assert np.array_equal(segmentation.rows == -1, CLUSTER == 2)
    assert np.array_equal(segmentation.labels == 0, CLUSTER == 2)
    assert not segmentation.margin[rest].any() and not segmentation.score[rest].any()
    cosines, rows = clear.features[:] @ EYE[:2].T / clear.norms[:, None], np.arange(2 * SPLATS_A_CLUSTER)
    scores = cosines[rows, CLUSTER[rows]]
    np.testing.assert_allclose(segmentation.score[rows], scores, atol=1e-6)
    np.testing.assert_allclose(segmentation.margin[rows], scores - cosines[rows, 1 - CLUSTER[rows]], atol=1e-6)
    without_feature = Scene(replace(clear.lift, has_feature=torch.arange(COUNT) != 3), clear.splats)
    assert segment(without_feature, ["apple", "book", "lamp"], EYE[:3]).rows[3] == -1
    flat = Scene(replace(clear.lift, rows=torch.ones(COUNT, CHANNELS)), clear.splats)  # of equal scores
    assert segment(flat, ["apple", "book"], EYE[:2]).named_words == ()


def test_splat_of_no_word_gets_the_one_of_most_of_its_node(clear: Scene) -> None:
    rows = clear.lift.features.clone()
    rows[:3], odd = torch.from_numpy(EYE[6]), [0, 1, 2]
    nodes = torch.from_numpy(np.where(np.arange(COUNT) == 2, -1, CLUSTER).astype(np.int32))
    views = torch.zeros((3, 5), dtype=torch.int32)
    tree = {"object": nodes, "object_views": views, "node": nodes, "node_views": views}
    tree |= {
        "node_parents": views[:, 0] - 1,
        "node_confidence": torch.ones(3),
        "node_features": torch.from_numpy(EYE[:3]).half(),
    }
    lift = replace(clear.lift, rows=rows, has_feature=torch.arange(COUNT) != 1)
    without_tree, with_tree = (Scene(replace(lift, **fields), clear.splats) for fields in (dict.fromkeys(tree), tree))
    words = ["apple", "book", "lamp"]
    assert segment(without_tree, words, EYE[:3]).rows[odd].tolist() == [-1, -1, -1]
    segmentation = segment(with_tree, words, EYE[:3])
    assert segmentation.rows[odd].tolist() == [0, -1, -1]
    assert segmentation.score[0] < 0.2 and segmentation.margin[0] <= 0
    assert np.array_equal(segmentation.rows[3:], CLUSTER[3:])


def test_pictures_show_the_words_of_the_pixels(clear: Scene) -> None:
    segmentation = segment(clear, ["apple", "book"], EYE[:2])
    values = label_map(clear, segmentation.labels, "middle")
    with Image.open(io.BytesIO(map_png(values, segmentation))) as picture:
        assert picture.mode == "P" and np.array_equal(np.asarray(picture), values)
        legend = json.loads(picture.info["legend"])
        pixels = np.asarray(picture.convert("RGB"))
    assert set(legend.values()) == {"apple", "book"}
    columns = {word: np.flatnonzero((values == int(value)).any(axis=0)).mean() for value, word in legend.items()}
    assert columns["apple"] < columns["book"] < WIDTH / 2 + 3
    assert not pixels[values == 0].any() and (pixels[values == 1] == segmentation.colours[1]).all()
    with Image.open(io.BytesIO(picture_png(render(clear, "middle"), values, segmentation))) as picture:
        assert picture.width == WIDTH and picture.height > HEIGHT + 12


def test_coloured_splats_have_the_colours_of_their_words(clear: Scene, tmp_path: Path) -> None:
    segmentation = segment(clear, ["apple", "book"], EYE[:2])
    clear.export(tmp_path / "named.ply", segmentation, "coloured")
    colours = view_colours(read_splats(tmp_path / "named.ply"), clear.cameras["middle"]).numpy()
    np.testing.assert_allclose(255 * colours, segmentation.colours[segmentation.labels], atol=1e-2)
    assert tuple(segmentation.colours[0]) == NO_CLUSTER_COLOUR
