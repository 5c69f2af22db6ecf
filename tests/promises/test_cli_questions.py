"""Commands that ask a lift or judge it: places of their words, files that they write, and what they say to people."""

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
import torch
from liftcore import evaluate
from PIL import Image

from tests.promises.command_line import contents, error_line, run
from tests.promises.scenes import look_at, random_grid, random_splats, write_pack
from tests.promises.tiny_files import write_files, write_lift
from tests.tiny_scene import HEIGHT, SPLATS_A_CLUSTER, WIDTH, WORDS

CLUSTER = np.repeat(np.arange(3), SPLATS_A_CLUSTER)


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lifted tiny scene; tests write beside it and not over it."""
    return write_lift(tmp_path_factory.mktemp("questions"))


@pytest.fixture
def table(lift: Path) -> list[object]:
    """The option of the words of the tiny scene."""
    return ["--table", lift.with_name("words.safetensors")]


@pytest.mark.parametrize(
    "words",
    [
        "{lift} apple --table {table}",
        "--table {table} {lift} apple",
        "--table {table} {lift} --view left apple",
        "{lift} --view left apple --negative apple --table {table} --negative book",
        "{lift} --table {table} -- apple",
    ],
)
def test_text_stands_before_between_or_after_options(words: str, lift: Path, table: list[object]) -> None:
    answer = run("query", "--json", *words.format(lift=lift, table=table[1]).split()).document["answer"]
    negatives = ["apple", "book"] if "--negative" in words else []
    expected = lc.Scene(lift).ask(lc.Query(text=["apple"], negatives=negatives), encoder=f"table:{table[1]}")
    assert answer["text"] == ["apple"] and answer["count"] == SPLATS_A_CLUSTER
    assert answer["statistics"] == expected.statistics


REFUSALS = {  # words behind the lift -> what the line says
    "query red mug": "arguments: mug; a text of several words is one, in quotes",
    "query --vieuw left mug": "arguments: --vieuw left",
    "query --negative cat mug": "before --negative, got only --negative cat mug",
    "query apple": "'tiny' is not the name of an available encoder",
    "query apple --table {c}": "c.json: expected table as --table, got cameras",
    "query": "query: expected a text or an example",
    "query --like splat:60": "splat:60: expected a splat in 0..59, got 60",
    "query --like nowhere": "--like: expected",
    "query --like splat:0 --threshold high": "threshold: expected",
    "query --like splat:0 --mask {m}.png": "--mask and --attention and --overlay: expected a view",
    "query --like splat:0 --camera {c} --mask {m}.png": "--camera: expected one camera, got 3 of them",
    "query --like splat:0 --scores {m}.csv": "ending in .npy",
    "query --like splat:0 --object {m}.sog": "splat-transform",
    "query --like splat:0 --unlike splat:0 --threshold 1 --object {m}.ply": "nothing stands out",
    "segment --words nope --table {t}": "--words: expected a file of words, one a line",
    "segment --table {t} --labels {m}.png": "got no --view and no --camera",
    "segment --table {t} --example nothing": "--example: expected",
    "objects --vocabulary nope --table {t}": "--vocabulary: expected a file of words",
    "objects --csv {m}.xlsx": "ending in .csv",
    "objects --distance 0 0 0 1 0 0 2 --metres-per-unit 2": "one of --distance and --metres-per-unit, got both",
}


@pytest.mark.parametrize("words", REFUSALS)
def test_wrong_question_is_one_line_and_writes_nothing(words: str, lift: Path) -> None:
    folder = lift.parent
    paths = {"c": folder / "c.json", "t": folder / "words.safetensors", "m": folder / "made"}
    name, *options = words.format(**{key: str(path) for key, path in paths.items()}).split()
    before = contents(folder)
    assert REFUSALS[words] in error_line(name, lift, *options) and contents(folder) == before


def test_words_say_what_is_found_and_where(lift: Path, table: list[object]) -> None:
    words = ["query", lift, "apple", *table, "--top", 2, "--objects", "--view", "left"]
    out = run(*words, "--metres-per-unit", 2).out
    assert "\n'apple': 20 of 60 splats at or above" in out and "\n  view left: " in out
    assert re.search(r"\n  splat \d+: score 1 at \(-1\.\d+, \S+, \S+\)\n  splat ", out)
    assert re.search(r"\n  object 1: 20 splats, 100\.0% of the selection, .* x .* metres\n", out)
    document = run(*words, "--json").document["answer"]
    (apple,) = document["objects"]
    assert apple["splats"] == 20 and document["unit"] == "scene units" and len(document["top"]) == 2
    segmented = run("segment", lift, *table, "--example", "splat:0").out
    assert segmented.startswith("splat:0: apple 1.000, ")
    assert "3 of 3 words found; 0 of 60 splats have no word" in run("segment", lift, *table).out
    tree_lines = run("objects", lift, *table, "--tree").out
    assert {re.sub(r" \(.*", "", line.strip())[2:] for line in tree_lines.splitlines()[1:]} == set(WORDS)
    splat = int(np.flatnonzero(lc.Scene(lift).members(0))[0])
    assert "may be object:0, object: 20 splats" in run("query", lift, "--like", f"splat:{splat}").out


def test_overlay_tints_the_selection_and_dims_the_rest(lift: Path, tmp_path: Path) -> None:
    Image.fromarray(np.full((3 * HEIGHT, 3 * WIDTH, 3), 100, np.uint8)).save(tmp_path / "photo.png")
    options = ["--view", "left.jpg", "--photo", tmp_path / "photo.png", "--overlay", tmp_path / "o.png"]
    share = run("query", lift, "--like", "splat:0", *options, "--json").document["view"]["mask_share"]
    with Image.open(tmp_path / "o.png") as picture:
        pixels = np.asarray(picture).astype(int)
    mask = lc.Scene(lift).mask(lc.Scene(lift).ask(lc.Query(like=["splat:0"])), "left")
    assert share == pytest.approx(mask.mean()) and 0 < share < 0.5
    assert pixels.shape[1] == WIDTH and pixels[HEIGHT:].min() < 128  # a caption below
    rest = pixels[:HEIGHT][~mask, 0]
    assert (pixels[:HEIGHT][mask, 0] > 100).all() and np.mean((rest > 10) & (rest < 50)) > 0.5


def test_object_of_an_answer_is_its_splats_alone(lift: Path, table: list[object], tmp_path: Path) -> None:
    document = run("query", lift, "lamp", *table, "--object", tmp_path / "o.ply", "--json").document
    assert document["files"] == {"object": str(tmp_path / "o.ply")}
    splats = lc.Scene(lift).splats
    for path in (tmp_path / "o.ply", tmp_path / "e.ply"):
        assert torch.equal(lc.read_splats(path).means, splats.means[CLUSTER == 2])
        run("export", lift, "--text", "lamp", "--only", *table, "-o", tmp_path / "e.ply")


def test_labels_are_columns_with_names_and_boxes(lift: Path, table: list[object], tmp_path: Path) -> None:
    out = tmp_path / "labels.ply"
    document = run("segment", lift, *table, "--labelled", out, "--json").document
    assert document["files"] == {"labelled": str(out), "names": f"{out}.json"}
    names, splats, source = json.loads(Path(f"{out}.json").read_text()), lc.read_splats(out), lc.Scene(lift).splats
    assert torch.equal(splats.means, source.means) and torch.equal(splats.quats, source.quats)
    words = {entry["class_id"]: entry["name"] for entry in names["classes"]}
    class_ids, instance_ids = (splats.extras[name].numpy() for name in ("class_id", "instance_id"))
    assert [words[value] for value in class_ids] == [WORDS[number] for number in CLUSTER]
    assert len(names["instances"]) == 3 and float(splats.extras["score"].min()) > 0.5
    for entry in names["instances"]:
        inside = instance_ids == entry["instance_id"]
        assert set(class_ids[inside]) == {entry["class_id"]} and inside.sum() == entry["splats"]
        box = entry["oriented_box"]
        sides = (splats.means.numpy()[inside] - box["centre"]) @ np.array(box["axes"]).T
        assert (np.abs(sides) <= np.array(box["half_sizes"]) + 1e-5).all()


def test_objects_are_written_one_by_one_and_as_a_table(lift: Path, tmp_path: Path) -> None:
    (tmp_path / "words.txt").write_text("lamp\napple\n")
    words = ["--vocabulary", tmp_path / "words.txt", "--encoder", f"table:{lift.with_name('words.safetensors')}"]
    options = ["--into", tmp_path / "each", "--csv", tmp_path / "t.csv", "--features"]
    document = run("objects", lift, *words, *options, "--json").document
    scene, entries = lc.Scene(lift), document["answer"]["objects"]
    assert {entry["name"] for entry in entries} == {"apple", "lamp"} and len(entries) == 3
    for entry in entries:
        splats = lc.read_splats(document["files"][f"object-{entry['id']}"])
        assert torch.equal(splats.means, scene.splats.means[scene.members(entry["id"])])
        assert np.argmax(entry["feature"]) == CLUSTER[scene.members(entry["id"])][0]
    rows = (tmp_path / "t.csv").read_text().splitlines()
    assert len(rows) == 4 and [row.split(",")[0] for row in rows[1:]] == [str(entry["id"]) for entry in entries]


def regions_of(files: dict[str, Path]) -> dict[str, lc.Regions]:
    """Return the views of the tiny scene."""
    return {
        view: regions
        for view, regions in lc.read_features(files["features"]).items()
        if isinstance(regions, lc.Regions)
    }


@pytest.mark.parametrize(("space", "message"), [("none", "is 'none'"), ("", "is not recorded"), ("mine", "'mine'")])
def test_words_to_a_lift_without_words_are_refused(space: str, message: str, tmp_path: Path) -> None:
    files = write_files(tmp_path)
    names = {"text_space": space} if space else {}
    pack = write_pack(tmp_path / "n.safetensors", dict(regions_of(files)), **names)
    result = lc.lift_files(files["splats"], files["cameras"], [pack], progress=False)
    result.save(tmp_path / "lift.safetensors")
    line = error_line("query", tmp_path / "lift.safetensors", "mug")
    assert message in line and "--like" in line


@pytest.mark.slow
def test_table_that_ships_stands_in_for_absent_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    files, words = write_files(tmp_path), lc.open_encoder("lvis").encode(["cat", "boat", "mug"])
    views = {view: replace(regions, codebook=torch.from_numpy(words)) for view, regions in regions_of(files).items()}
    pack = write_pack(tmp_path / "n.safetensors", dict(views), text_space="open_clip:ViT-B-32/openai")
    lift = lc.lift_files(files["splats"], files["cameras"], [pack], progress=False)
    lift.save(tmp_path / "lift.safetensors")
    document = run("query", tmp_path / "lift.safetensors", "cat", "--json").document
    assert document["encoder"] == lc.open_encoder("lvis").name and document["answer"]["present"]
    assert "using the table lvis" in caplog.text
    assert "open_clip" in error_line(
        "query", tmp_path / "lift.safetensors", "cat", "--encoder", "open_clip:ViT-B-32/openai"
    )


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
