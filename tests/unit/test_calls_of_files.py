"""Public calls that take files: a path may be a text, and one may stand for several."""

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
    for name in ("maps", "photos"):
        (folder / name).mkdir(parents=True)
    for view in tiny_scene.VIEWS:
        np.save(folder / "maps" / f"{view}.npy", np.ones((6, 8, 3), np.float16))
        Image.new("RGB", (tiny_scene.WIDTH, tiny_scene.HEIGHT)).save(folder / "photos" / f"{view}.png")
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
