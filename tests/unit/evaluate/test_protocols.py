"""Protocols compared with their definitions, and labels with masks whose pixels can be counted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.errors import InvalidInput
from liftcore.evaluate.judging import compare_frame, mean_of_scenes, means, pooled_ious
from liftcore.evaluate.labels import LabelledObject, lerf_scenes, three_d_ovs_scenes
from liftcore.evaluate.protocols import (
    EvaluationProtocol,
    Prediction,
    RenderedFeatures,
    RenderedScores,
    SelectedSplats,
    segment,
)
from liftcore.evaluate.published import published
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import view_mask
from liftcore.query.scene import Scene
from liftcore.query.threshold import find_threshold
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.text import open_encoder
from tests.labelled_scene import HEIGHT, WIDTH, isat, rectangle, write_lift

P1, P2, P3, _ = EvaluationProtocol


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(write_lift(tmp_path_factory.mktemp("lift")))


def words(scene: Scene):
    return open_encoder(scene.lift.metadata.text_space)


def box(shape: tuple[int, int], x1: int, y1: int, x2: int, y2: int) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[y1:y2, x1:x2] = True
    return mask


def test_iou_and_its_means_are_those_of_counted_pixels() -> None:
    shape = (10, 10)
    first_mask, second_mask = box(shape, 0, 0, 4, 10), box(shape, 2, 0, 6, 10)  # 40 pixels each, 20 shared: 1/3
    objects = [LabelledObject("a", first_mask, ((0, 0, 3, 9),)), LabelledObject("b", second_mask, ())]
    first = compare_frame(
        P3, "one", objects, {"a": Prediction(first_mask, (0, 5)), "b": Prediction(first_mask, (0, 0))}, lifted=True
    )
    empty = np.zeros(shape, bool)
    second = compare_frame(
        P3,
        "two",
        [LabelledObject("a", first_mask, ()), LabelledObject("c", empty, ())],
        {"a": Prediction(empty, (9, 9)), "c": Prediction(box(shape, 0, 0, 5, 1), (0, 0))},
        lifted=False,
    )
    assert [row.iou for row in first + second] == [1.0, pytest.approx(1 / 3), 0.0, None]
    summary = means(first + second)
    assert (summary.frames, summary.objects) == (2, 3)
    assert summary.object_micro == pytest.approx((1 + 1 / 3 + 0) / 3)
    assert summary.frame_macro == pytest.approx((2 / 3 + 0) / 2)
    assert pooled_ious(first + second) == {"a": pytest.approx(40 / 80), "b": pytest.approx(20 / 60)}
    assert summary.class_pooled == pytest.approx((1 / 2 + 1 / 3) / 2)
    assert (summary.localised, summary.accuracy_25, summary.accuracy_50) == (1 / 3, 2 / 3, 1 / 3)
    second_summary = means(second)
    assert mean_of_scenes([summary, second_summary]).object_micro == pytest.approx((4 / 9 + 0) / 2)
    assert means([]).object_micro is None


def test_false_alarms_of_an_absent_class_count_where_pixels_are_pooled() -> None:
    shape = (4, 5)
    mask, empty = box(shape, 0, 0, 5, 2), np.zeros(shape, bool)
    rows = [
        *compare_frame(P2, "one", [LabelledObject("a", mask, ())], {"a": Prediction(mask, None)}, lifted=False),
        *compare_frame(P2, "two", [LabelledObject("a", empty, ())], {"a": Prediction(mask, None)}, lifted=False),
    ]
    assert pooled_ious(rows) == {"a": 0.5}
    assert (means(rows).object_micro, means(rows).localised) == (1.0, None)


def test_p1_is_localised_in_a_box_and_p3_in_the_mask() -> None:
    corner = LabelledObject("a", box((9, 9), 0, 0, 1, 1), ((0, 0, 4, 4), (7, 7, 8, 8)))
    for peak, in_box, in_mask in (((0, 0), True, True), ((4, 4), True, False), ((5, 4), False, False)):
        predictions = {"a": Prediction(corner.mask, peak)}
        assert [compare_frame(p, "v", [corner], predictions, lifted=False)[0].localised for p in (P1, P3)] == [
            in_box,
            in_mask,
        ]
    assert compare_frame(P1, "v", [corner], {"a": Prediction(corner.mask, (8, 7))}, lifted=False)[0].localised


def plain_segment(relevance: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Apply LangSplat's steps pixel by pixel; borders mirror without repeating the edge, as OpenCV's filters do."""
    height, width = relevance.shape

    def mirrored(index: int, size: int) -> int:
        index = abs(index) % (2 * size - 2)
        return min(index, 2 * size - 2 - index)

    mean = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            rows = [mirrored(y + k, height) for k in range(-15, 15)]
            columns = [mirrored(x + k, width) for k in range(-15, 15)]
            mean[y, x] = relevance[np.ix_(rows, columns)].mean()
    blend = 0.5 * (mean + relevance)
    cut = np.clip((blend - blend.min()) / (blend.max() - blend.min() + 1e-9) * 2 - 1, 0, 1) > 0.4
    mask = np.zeros_like(cut)
    for y in range(height):
        for x in range(width):
            square = cut[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4]
            mask[y, x] = 2 * square.sum() > square.size
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    return mask, (int(column), int(row))


@pytest.mark.parametrize(("height", "width"), [(24, 41), (9, 12)])
def test_p1_segments_a_map_as_langsplat_does(height: int, width: int) -> None:
    rng = np.random.default_rng(height)
    relevance = np.kron(rng.random((3, 3)), np.ones((height // 3 + 1, width // 3 + 1)))[:height, :width]
    relevance = (relevance + 0.2 * rng.random(relevance.shape)).astype(np.float32)
    mask, peak = plain_segment(relevance)
    prediction = segment(relevance)
    assert (prediction.mask == mask).all() and 0 < mask.mean() < 1
    assert prediction.peak == peak
    flat = segment(np.full((height, width), 0.5, np.float32))
    assert not flat.mask.any()


def test_p1_compares_rendered_features(scene: Scene) -> None:
    texts = ["red apple", "book"]
    cosines = RenderedFeatures(scene, texts, words(scene)).cosines("frame_00002")
    rendered = scene.raster.render(scene.cameras["frame_00002"], scene.lift.features.float(), scene.compositing)
    unit = torch.nn.functional.normalize(rendered, dim=-1)
    vectors = torch.as_tensor(words(scene).encode([*texts, "object", "things", "stuff", "texture"]))
    torch.testing.assert_close(cosines, unit @ vectors.T, atol=1e-5, rtol=0)


def test_p2_sees_the_selected_splats_alone(scene: Scene) -> None:
    texts, encoder = ["red apple", "unicorn"], words(scene)
    protocol = SelectedSplats(scene, texts, encoder, threshold=0.5)
    selected = ask(scene, Query.of(("red apple",), threshold=0.5), encoder).selected
    splats = scene.splats
    few = replace(
        splats,
        **{
            name: getattr(splats, name)[selected] for name in ("means", "quats", "log_scales", "opacity_logits", "sh")
        },
        extras={},
    )
    row_sums = CpuRaster(few).row_sums(scene.cameras["frame_00001"], scene.compositing)
    predictions = protocol.predict_view("frame_00001")
    assert (predictions["red apple"].mask == (row_sums > 0.7).numpy()).all() and predictions["red apple"].mask.any()
    assert not predictions["unicorn"].mask.any() and predictions["unicorn"].peak is None


@pytest.mark.parametrize("threshold", ["auto", 0.4])
def test_p3_cuts_the_rendered_scores_of_a_query(scene: Scene, threshold: str | float) -> None:
    texts, encoder = ["book", "red apple"], words(scene)
    predictions = RenderedScores(scene, texts, encoder, threshold).predict_view("frame_00002")
    for text in texts:
        view = view_mask(scene, ask(scene, Query.of((text,), threshold=threshold), encoder), "frame_00002")
        hit = view.row_sums >= 0.5
        cut = find_threshold(view.attention[hit], threshold).value
        assert (predictions[text].mask == (hit & (view.attention >= cut))).all() and predictions[text].mask.any()
        x, y = predictions[text].peak or (0, 0)
        assert view.attention[y, x] == view.attention.max()


def labels_of(folder: Path, document: object) -> Path:
    labels = folder / "label" / "kitchen"
    labels.mkdir(parents=True)
    content = document if isinstance(document, str) else json.dumps(document)
    (labels / "frame_00001.json").write_text(content)
    return folder


def test_polygons_of_a_category_are_united_and_rescaled(tmp_path: Path) -> None:
    document = isat(
        [
            ("cup", rectangle(2, 3, 10, 8)),
            ("__background__", rectangle(0, 0, 160, 120)),
            ("cup", rectangle(8, 3, 12, 8)),
            ("dust", []),
            ("dot", [[5, 6]]),
        ],
        scale=2,
    )
    scenes = lerf_scenes(labels_of(tmp_path, document))
    assert scenes.keys() == {"kitchen"} and scenes["kitchen"].views == ("frame_00001",)
    objects = {label.category: label for label in scenes["kitchen"].objects("frame_00001", WIDTH, HEIGHT)}
    assert objects.keys() == {"cup", "dust", "dot"}
    assert (objects["cup"].mask == box((HEIGHT, WIDTH), 2, 3, 12, 8)).all()
    assert objects["cup"].boxes == ((2, 3, 9, 7), (8, 3, 11, 7))
    assert not objects["dust"].mask.any() and objects["dot"].mask.sum() == 1
    enlarged = scenes["kitchen"].objects("frame_00001", 2 * WIDTH, 2 * HEIGHT)[0]
    assert enlarged.mask.sum() == (2 * 9 - 2 * 2 + 1) * (2 * 7 - 2 * 3 + 1) + 2 * 2 * (2 * 7 - 2 * 3 + 1)


GOOD = isat([("cup", rectangle(0, 0, 4, 4))])


@pytest.mark.parametrize(
    "document",
    [
        "[]",
        "[" * 100_000,
        {**GOOD, "info": {"width": 0, "height": 3}},
        {**GOOD, "objects": {"a": 1}},
        {**GOOD, "objects": [1]},
        {**GOOD, "objects": [{"category": " ", "segmentation": []}]},
        {**GOOD, "objects": [{"category": "cup"}]},
        {**GOOD, "objects": [{"category": "cup", "segmentation": [[1, "2"]]}]},
        {**GOOD, "objects": [{"category": "cup", "segmentation": [[1, float("nan")]]}]},
        {**GOOD, "objects": [{"category": "cup", "segmentation": [[1, 1e300]]}]},
    ],
)
def test_malformed_labels_are_refused_by_their_file(tmp_path: Path, document: object) -> None:
    labels = lerf_scenes(labels_of(tmp_path, document))["kitchen"]
    with pytest.raises(InvalidInput, match=r"frame_00001\.json"):
        labels.objects("frame_00001", WIDTH, HEIGHT)


def test_masks_of_classes_are_read_in_any_size_and_depth(tmp_path: Path) -> None:
    view = tmp_path / "bed" / "segmentations" / "03"
    view.mkdir(parents=True)
    (view.parent / "classes.txt").write_text("red bag\n\n cat \nsofa\n")
    mask = box((12, 16), 4, 2, 12, 10)
    Image.fromarray(mask.astype(np.uint8)).save(view / "red bag.png")  # zeros and ones
    large = Image.fromarray(mask.astype(np.uint8) * 255).resize((32, 24), Image.Resampling.NEAREST)
    large.save(view / "cat.jpg", quality=60)
    for data in (tmp_path, tmp_path / "bed"):
        scenes = three_d_ovs_scenes(data)
        assert scenes.keys() == {"bed"} and scenes["bed"].classes == ("red bag", "cat", "sofa")
    objects = {label.category: label for label in scenes["bed"].objects("03", 16, 12)}
    assert (objects["red bag"].mask == mask).all() and objects["red bag"].boxes == ((4, 2, 11, 9),)
    assert (objects["cat"].mask == mask).mean() > 0.97
    assert not objects["sofa"].mask.any() and objects["sofa"].boxes == ()


def test_labels_that_are_not_there_are_refused(tmp_path: Path) -> None:
    for read_scenes in (lerf_scenes, three_d_ovs_scenes):
        for data in (tmp_path, tmp_path / "none"):
            with pytest.raises(InvalidInput, match=r"^data:"):
                read_scenes(data)
    view = tmp_path / "bed" / "segmentations" / "03"
    view.mkdir(parents=True)
    classes = view.parent / "classes.txt"
    classes.write_bytes(b"\n")
    with pytest.raises(InvalidInput, match="a class a line"):
        three_d_ovs_scenes(tmp_path)
    classes.write_bytes(b"cat\n")
    scene = three_d_ovs_scenes(tmp_path)["bed"]
    with pytest.raises(InvalidInput, match=r"named like the classes"):
        scene.objects("03", 4, 4)
    (view / "cat.png").write_bytes(b"no picture")
    with pytest.raises(InvalidInput, match=r"cat\.png"):
        scene.objects("03", 4, 4)


def test_published_means_are_those_of_their_scenes_but_where_the_paper_slips() -> None:
    rows = [row for dataset in ("lerf-ovs", "3d-ovs") for row in published(dataset) if row.scenes]
    off = {row.method for row in rows if abs(sum(row.scenes.values()) / len(row.scenes) - row.mean) > 0.11}
    assert off == {"N2F2"}
