"""Commands that judge: `evaluate` a lift by labels of people, and `check` files of a scene against each other."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
from liftcore import evaluate
from PIL import Image

from tests.promises.command_line import error_line, run
from tests.promises.scenes import look_at, random_grid, random_splats, write_pack
from tests.promises.tiny_files import write_lift
from tests.tiny_scene import HEIGHT, SPLATS_A_CLUSTER, WIDTH, WORDS

CLUSTER = np.repeat(np.arange(3), SPLATS_A_CLUSTER)


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lifted tiny scene."""
    return write_lift(tmp_path_factory.mktemp("judgements"))


def write_labels(folder: Path, dataset: str, masks: Mapping[str, Mapping[str, np.ndarray]]) -> Path:
    """Write masks of words in views as a data set has them."""
    if dataset == "lerf-ovs":
        (folder / "label/scene").mkdir(parents=True)
        for view, by_word in masks.items():
            objects = []
            for word, mask in by_word.items():
                for y in range(HEIGHT):
                    columns = np.flatnonzero(mask[y])
                    if columns.size:  # outlines are of the object
                        outline = [[columns[0], y], [columns[-1], y], [columns[-1], y], [columns[0], y]]
                        objects.append({"category": word, "segmentation": [[float(a), float(b)] for a, b in outline]})
            info = {"width": WIDTH, "height": HEIGHT}
            (folder / f"label/scene/{view}.json").write_text(json.dumps({"info": info, "objects": objects}))
        return folder
    for view, by_word in masks.items():
        (folder / "scene/segmentations" / view).mkdir(parents=True)
        for word, mask in by_word.items():
            Image.fromarray(mask).save(folder / f"scene/segmentations/{view}/{word}.png")
    (folder / "scene/segmentations/classes.txt").write_text("\n".join(WORDS))
    return folder


@pytest.mark.parametrize("dataset", ["lerf-ovs", "3d-ovs"])
def test_right_lift_scores_near_one_and_wrong_words_zero(dataset: Any, lift: Path, tmp_path: Path) -> None:
    scene, masks = lc.Scene(lift), dict[str, dict[str, np.ndarray]]()
    for view in ("left", "right"):
        renders = lc.render(scene.splats, scene.cameras[view], np.eye(3, dtype=np.float32)[CLUSTER])
        masks[view] = {word: np.asarray(renders)[..., k] > 0.5 for k, word in enumerate(WORDS)}
    data = write_labels(tmp_path / "right", dataset, masks)
    options = ["--table", lift.with_name("words.safetensors"), "--protocol", "P3", "own"]
    words = ["evaluate", dataset, f"scene={lift}", "--data", data, *options]
    document = run(*words, "--json").document
    encoder = f"table:{lift.with_name('words.safetensors')}"
    by_call = evaluate.evaluate_lifts(dataset, f"scene={lift}", data, encoder=encoder, protocols=["P3", "own"])
    assert document == json.loads(json.dumps(by_call.document()))
    assert [row["protocol"] for row in document["measured"]] == ["P3", "own"]
    for row in document["measured"]:
        means = row["means"]["all labelled"]
        assert (means["frames"], means["objects"], row["frames"]) == (2, 6, ["left", "right"])
        assert min(means[name] for name in ("object_micro", "frame_macro", "class_pooled")) > 0.9
        assert row["lifted_frames"] == ["left", "right"]
    assert any("2 of 2 judged frames were lifted" in warning for warning in document["warnings"])
    assert run(*words).out.count("measured") == len(re.findall("^measured", run(*words).out, re.MULTILINE))
    held_out = tmp_path / "held_out.txt"
    held_out.write_text("right.jpg\n")
    assert run(*words, "--held-out", held_out, "--json").document["measured"][0]["frames"] == ["right"]
    mistaken = {view: dict(zip([*WORDS], np.roll([*m.values()], 1, 0), strict=True)) for view, m in masks.items()}
    wrong = ["evaluate", dataset, f"scene={lift}", "--data", write_labels(tmp_path / "wrong", dataset, mistaken)]
    assert run(*wrong, *options, "--json").document["measured"][0]["means"]["all labelled"]["object_micro"] < 0.1


def test_means_are_those_of_counted_pixels(lift: Path, tmp_path: Path) -> None:
    """Labels are stripes; a view without a camera and a word without a vector are named and left out."""
    scene, encoder = lc.Scene(lift), f"table:{lift.with_name('words.safetensors')}"
    masks, shared, union = dict[str, dict[str, np.ndarray]](), np.zeros((2, 2)), np.zeros((2, 2))
    for row, view in enumerate(("left", "right")):
        masks[view] = {}
        for column, word in enumerate(("apple", "book")):
            truth = np.zeros((HEIGHT, WIDTH), bool)
            truth[:, 10 * column + 2 : 10 * column + 9 + 2 * row] = True
            predicted = scene.mask(scene.ask(word, encoder=encoder), view)
            shared[row, column], union[row, column] = (truth & predicted).sum(), (truth | predicted).sum()
            masks[view][word] = truth
    masks["left"].pop("book")
    masks["stray"] = masks["right"]
    masks["right"] |= {"griffin": masks["right"]["apple"]}
    shared[0, 1] = union[0, 1] = np.nan
    ious = shared / union
    words = ["--data", write_labels(tmp_path, "lerf-ovs", masks), "--table", encoder[6:], "--protocol", "own"]
    document = run("evaluate", "lerf-ovs", f"scene={lift}", *words, "--json").document
    means = document["measured"][0]["means"]["all labelled"]
    assert means["object_micro"] == pytest.approx(np.nanmean(ious)) and 0.1 < means["object_micro"] < 0.9
    assert means["frame_macro"] == pytest.approx(np.nanmean(ious, axis=1).mean())
    assert means["class_pooled"] == pytest.approx((np.nansum(shared, axis=0) / np.nansum(union, axis=0)).mean())
    assert means["accuracy_25"] == pytest.approx((ious[~np.isnan(ious)] >= 0.25).mean())
    assert any("stray have labels but no camera" in warning for warning in document["warnings"])
    assert any("griffin" in warning and "left out" in warning for warning in document["warnings"])


@pytest.mark.parametrize("content", ["[]", '{"info": {}, "objects": []}', '{"info": {"width": 1, "height": 1}}'])
def test_malformed_labels_are_named_by_their_file(content: str, lift: Path, tmp_path: Path) -> None:
    (tmp_path / "label/scene").mkdir(parents=True)
    (tmp_path / "label/scene/left.json").write_text(content)
    table = ["--table", lift.with_name("words.safetensors")]
    assert "left.json" in error_line("evaluate", "lerf-ovs", f"scene={lift}", "--data", tmp_path, *table)


BAD_EVALUATIONS = {
    "nothing.safetensors --data {data}": "nothing at",
    "scene={lift} {folder}/scene={lift} --data {data} --protocol P9": "invalid choice: 'P9'",
    "scene={lift} --data {folder}/none": "--data: expected",
    "scene={lift} --data {data} --threshold soon": "threshold: expected",
    "scene={lift} --data {data} --held-out nowhere.txt": "--held-out: expected a file of view names",
    "scene={folder}/words.safetensors --data {data}": "lift",
}


@pytest.mark.parametrize("words", BAD_EVALUATIONS)
def test_lifts_that_cannot_be_judged_are_refused(words: str, lift: Path, tmp_path: Path) -> None:
    data = write_labels(tmp_path, "3d-ovs", {"left": {"apple": np.ones((HEIGHT, WIDTH), bool)}})
    arguments = words.format(lift=lift, folder=lift.parent, data=data).split()
    table = ["--table", lift.with_name("words.safetensors")]
    assert BAD_EVALUATIONS[words] in error_line("evaluate", "3d-ovs", *arguments, *table)


Change = Callable[[np.ndarray], np.ndarray]
CAUSES: dict[str, tuple[Change, str]] = {  # change of the photos -> the cause that is said
    "none": (lambda image: image, ""),
    "half the size": (lambda image: image[::2, ::2], ""),
    "cropped": (lambda image: image[12:-12], "another shape than their cameras"),
    "on their side": (np.rot90, "lie on their side"),
    "turned": (lambda image: image[::-1, ::-1], "photos and cameras are turned to each other"),
    "mirrored": (lambda image: image[:, ::-1], "mirrored left to right"),
    "shifted": (lambda image: np.roll(image, (-9, 14), axis=(0, 1)), "principal points"),
    "darker": (lambda image: image // 4, "another exposure"),
}


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of splats in many colours, cameras before them, grids, and photos that show them."""
    folder, rng = tmp_path_factory.mktemp("sheet"), np.random.default_rng(0)
    (folder / "photos").mkdir()
    splats = random_splats(3, 2_000, flat=0.05)
    cameras = {f"v{k}": look_at(rng.normal((0, 0, -4), (0.8, 0.8, 0.2)), f"v{k}", 128, 96) for k in range(4)}
    views = {name: random_grid(rng) for name in cameras}
    result = lc.lift(splats, cameras, views, preset="row-sum", progress=False)
    result.save_scene(folder, splats, lc.Cameras(cameras))
    scene = lc.Scene(folder / "lift.safetensors")
    for name in cameras:
        scene.export(folder / f"photos/{name}.png", None, "rgb", view=name)
    return folder


def test_check_names_cameras_and_maps_of_others(sheet: Path, tmp_path: Path) -> None:
    splats, cameras = lc.read_splats(sheet / "splats.ply"), lc.read_cameras(sheet / "cameras.json")
    photos = {path.stem: path for path in sorted((sheet / "photos").iterdir())}

    def wrong(splats: lc.Splats, cameras: lc.Cameras, photos: Any = None, maps: Any = None) -> str:
        pack = maps and write_pack(tmp_path / "maps.safetensors", maps)
        return " | ".join(evaluate.check_scene(splats, cameras, photos, pack).wrong)

    scale = np.ones((4, 4))
    scale[:3, 3] = 0.5
    near = lc.Cameras([camera.replace(viewmat=camera.viewmat * scale) for camera in cameras.values()])
    assert "with positions times about 2 " in wrong(splats, near, photos)
    far = replace(splats, means=splats.means + 1000)
    assert wrong(far, cameras).startswith("cameras: ")
    swapped = dict(zip(photos, [*[*photos.values()][1:], photos["v0"]], strict=True))
    assert "not of each other" in wrong(splats, cameras, swapped)
    rows, columns = np.meshgrid(np.linspace(0, 3, 12), np.linspace(0, 4, 16), indexing="ij")
    waves = np.stack([np.cos(k * rows + columns + k) for k in range(8)], axis=2).astype(np.float32)
    good = {name: lc.FeatureGrid(np.roll(waves, k, 0)) for k, name in enumerate(cameras)}
    transposed = {name: lc.FeatureGrid(view.grid.permute(2, 0, 1).reshape(12, 16, 8)) for name, view in good.items()}
    assert "read as [F, h, w]" not in wrong(splats, cameras, None, good)
    assert "read as [F, h, w]" in wrong(splats, cameras, None, transposed)
    few = {"v0": photos["v0"], "stranger": photos["v1"]}
    report = evaluate.check_scene(splats, cameras, few)
    assert "3 cameras have none" in report.notes[0] and "1 have no camera: 'stranger'" in report.notes[1]


@pytest.mark.parametrize("case", CAUSES)
def test_check_names_the_cause_of_wrong_photos(case: str, sheet: Path, tmp_path: Path) -> None:
    change, cause = CAUSES[case]
    for path in (sheet / "photos").iterdir():
        with Image.open(path) as photo:
            Image.fromarray(np.ascontiguousarray(change(np.asarray(photo)))).save(tmp_path / path.name)
    files = (sheet / "splats.ply", sheet / "cameras.json", tmp_path)
    reply, report = run("check", *files, "--json"), evaluate.check_scene(*files)
    document: dict[str, Any] = json.loads(reply.out)
    assert (reply.status, document["healthy"], document["wrong"]) == (2 if cause else 0, not cause, [*report.wrong])
    assert len(report.wrong) == bool(cause) and all(cause in problem for problem in report.wrong)
    assert ("not healthy: fix" if cause else "\nhealthy: no contradictions") in "\n" + run("check", *files).out
