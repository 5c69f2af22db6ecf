"""Commands that ask a lift: places of their words, files that they write, and what they say to people."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import liftcore as lc
import numpy as np
import pytest
import torch
from PIL import Image

from tests.promises.command_line import contents, error_line, run
from tests.promises.scenes import write_pack
from tests.promises.tiny_files import write_files, write_lift
from tests.tiny_scene import HEIGHT, SPLATS_A_CLUSTER, WIDTH, WORDS, ply, splat_rows

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
    "query --negative cat mug": "before --negative, got only --negative cat mug",
    "query apple": "'tiny' is not the name of an available encoder",
    "query apple --table {c}": "c.json: expected table as --table, got cameras",
    "query": "query: expected a text or an example",
    "query --like splat:60": "like.0: expected a splat in 0..59, got 60 in splat:60",
    "query --like nowhere": "--like: expected",
    "query --like splat:0 --mask {m}.png": "--mask: expected a view",
    "query --like splat:0 --camera {c} --mask {m}.png": "--camera: expected one camera, got 3 of them",
    "query --like splat:0 --scores {m}.csv": "ending in .npy",
    "query --like splat:0 --object {m}.sog": "splat-transform",
    "query --like splat:0 --unlike splat:0 --threshold 1 --object {m}.ply": "nothing stands out",
    "query --like splat:0 --min-size 99 --object {m}.ply": "20 in smaller objects",
    "segment --words nope --table {t}": "--words: expected a file of words, one a line",
    "segment --table {t} --map {m}.png": "got no --view and no --camera",
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


def test_objects_are_written_one_by_one_and_as_a_table(lift: Path, tmp_path: Path) -> None:
    (tmp_path / "words.txt").write_text("lamp\napple\n", encoding="utf-8-sig")  # with a byte order mark
    words = ["--vocabulary", tmp_path / "words.txt", "--encoder", f"table:{lift.with_name('words.safetensors')}"]
    options = ["--into", tmp_path / "each", "--csv", tmp_path / "t.csv"]
    document = run("objects", lift, *words, *options, "--json").document
    scene, entries = lc.Scene(lift), document["answer"]["nodes"]
    assert {entry["name"] for entry in entries} == {"apple", "lamp"} and len(entries) == 3
    for entry in entries:
        splats = lc.read_splats(document["files"][f"object-{entry['id']}"])
        assert torch.equal(splats.means, scene.splats.means[scene.members(entry["id"])])
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


def test_edited_splats_are_sent_to_transfer(lift: Path, table: list[object], tmp_path: Path) -> None:
    rows = splat_rows()
    for edited in (rows[10:], rows @ np.diag([*[-1] * 2, *[1] * 12])):
        (tmp_path / "edited.ply").write_bytes(ply(edited.astype(np.float32)))
        question = ["query", lift, "apple", *table, "--splats", tmp_path / "edited.ply", "--objects"]
        assert "splatlift transfer" in error_line(*question)


@pytest.mark.slow
def test_table_that_ships_stands_in_for_absent_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
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
