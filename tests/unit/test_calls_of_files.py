"""Public calls that take files: a path may be a text, one may stand for several, and a wrong choice is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import liftcore as lc
from liftcore import evaluate, files
from liftcore.features.encoders.encode import find_images
from tests import tiny_scene

Call = Callable[..., Any]


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The working folder, with a tiny scene, maps, and photos of its views."""
    folder = tmp_path_factory.mktemp("files")
    scene = tiny_scene.make_scene()
    for name, content in (
        *(("splats.ply", scene.splats), ("cameras.json", scene.cameras)),
        *(("pack.safetensors", scene.features), ("table.safetensors", scene.table)),
    ):
        (folder / name).write_bytes(content)
    for name in ("maps", "photos", "label/kitchen"):
        (folder / name).mkdir(parents=True)
    for view in tiny_scene.VIEWS:
        np.save(folder / "maps" / f"{view}.npy", np.ones((6, 8, 3), np.float16))
        Image.new("RGB", (tiny_scene.WIDTH, tiny_scene.HEIGHT)).save(folder / "photos" / f"{view}.png")
    (folder / "label" / "kitchen" / "frame.json").write_text("{}")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def list_of(value: Any) -> list[Any]:
    return [value]


def retag(path: Any) -> Any:
    lc.retag_pack(path("pack.safetensors"), path("named.safetensors"), {"text_space": "words"})
    return lc.read_features("named.safetensors").text_space


def checked_views(path: Any, form: Callable[[Any], Any]) -> Any:
    report = evaluate.check_scene(
        path("splats.ply"), path("cameras.json"), form(path("photos")), form(path("pack.safetensors"))
    )
    return [view.view for view in report.views]


def speeds(path: Any, form: Callable[[Any], Any]) -> Any:
    return evaluate.SceneFiles(path("splats.ply"), path("cameras.json"), form(path("pack.safetensors")))


PATHS: dict[str, Call] = {
    "pack_folder": lambda path, form: lc.pack_folder(path("maps"), path("made.safetensors"), "npy"),
    "retag_pack": lambda path, form: retag(path),
    "find_images": lambda path, form: find_images(form(path("photos"))),
    "check_output": lambda path, form: files.check_output(path("new.npy"), form(path("pack.safetensors")), "npy"),
    "identify": lambda path, form: files.identify(path("splats.ply")),
    "wrong_kind": lambda path, form: str(files.wrong_kind(path("splats.ply"), "lift", lc.InvalidLift)),
    "visible_files": lambda path, form: files.visible_files(path("maps")),
    "camera_files": lambda path, form: files.camera_files(path("cameras.json")),
    "read_image": lambda path, form: files.read_image(path("photos/left.png"))[1],
    "Checkpoint": lambda path, form: lc.Checkpoint(path("kept"), 5),
    "SceneFiles": speeds,
    "check_scene": checked_views,
}


@pytest.mark.parametrize("call", PATHS.values(), ids=PATHS)
def test_path_may_be_a_text_and_one_alone_is_a_list_of_it(call: Call) -> None:
    ways = [call(path, form) for path in (Path, str) for form in (list_of, lambda value: value)]
    assert all(way == ways[0] for way in ways)


CHOICES: list[tuple[str, Call]] = [
    (r"kind: expected one of langsplat, npy, masks, prompts, got 'mask'", lambda: pack("mask")),
    (r"layout: expected one of hwc, chw, got 'xyz'", lambda: pack("npy", layout="xyz")),
    (r"layuot: expected one of layout of npy", lambda: pack("npy", layuot="chw")),
    (r"unlabelled: expected one of layout of npy", lambda: pack("npy", unlabelled=3)),
    (r"layout: expected no option of langsplat", lambda: pack("langsplat", layout="chw")),
    (r"folders: expected one of phrases, views", lambda: pack("prompts", folders="view")),
    (r"text_space: expected None for prompts", lambda: pack("prompts", text_space="x")),
    (r"normalised: expected True, False or None, got 'maybe'", lambda: pack("npy", normalised="maybe")),
    (r"text_space: expected a non-empty text, got 3", lambda: pack("npy", text_space=3)),
    (r"^encoder: expected", lambda: pack("masks", photos="photos")),
    (r"^photos: expected", lambda: pack("masks", encoder="open_clip:a/b")),
    (
        r"^normalised: expected True or None.*got False",
        lambda: pack("masks", encoder="open_clip:a/b", photos="photos", normalised=False),
    ),
    (r"^names: expected a file of names", lambda: pack("prompts", names="nowhere.txt")),
    (r"folder: expected the path", lambda: lc.pack_folder(None, "x.safetensors", "npy")),  # pyright: ignore
    (r"images: expected images", lambda: lc.encode_images([], "x.safetensors", "timm:resnet18")),
    (r"^encoder: expected one of maskclip", lambda: lc.encode_images("photos", "x.safetensors", "magic")),
    (r"kind: expected one of splats, ply", lambda: files.check_output("new.npy", [], "foo")),
    (r"kind: expected one of splats, cameras", lambda: evaluate.inspect_file("splats.ply", "foo")),
    (r"settings: expected LiftSettings, or None", lambda: lift({"quality": "fast"})),
    (r"files: expected SceneFiles", lambda: evaluate.compare_speeds("splats.ply")),  # pyright: ignore
    (r"splats: expected the path", lambda: evaluate.SceneFiles(None, "cameras.json", ())),  # pyright: ignore
    (
        r"settings: expected settings that are the same in all runs, got quality",
        lambda: evaluate.compare_speeds(speeds(str, list_of), settings={"quality": "fast"}),
    ),
]


def pack(kind: Any, **options: Any) -> Any:
    return lc.pack_folder("maps", "refused.safetensors", kind, **options)


def lift(settings: Any) -> Any:
    return lc.lift_files("splats.ply", "cameras.json", ["pack.safetensors"], settings)


@pytest.mark.parametrize(("message", "call"), CHOICES, ids=[message for message, _ in CHOICES])
def test_wrong_choice_is_named_with_what_is_possible(message: str, call: Call, folder: Path) -> None:
    with pytest.raises(lc.SplatliftError, match=message) as excinfo:
        call()
    assert "--" not in f"{excinfo.value.argument} {excinfo.value.expected}", "options are the command line's"
    assert not (folder / "refused.safetensors").exists()


@pytest.mark.parametrize(
    "names",
    [{}, "words", {"foo": "x"}, {"text_space": 3}, {"encoder": " "}, {"normalised": "maybe"}, {"words": "["}],
)
def test_names_that_no_reader_takes_make_no_pack(names: Any, folder: Path) -> None:
    with pytest.raises(lc.InvalidInput, match=r"names|text_space|encoder"):
        lc.retag_pack("pack.safetensors", "refused.safetensors", names)
    assert not (folder / "refused.safetensors").exists()
