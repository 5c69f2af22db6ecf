"""The command that judges files of a scene against each other: `check`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
from liftcore import evaluate
from PIL import Image

from tests.promises.command_line import run
from tests.promises.scenes import look_at, random_grid, random_splats, write_pack
from tests.promises.tiny_files import write_files, write_lift
from tests.tiny_scene import SPLATS_A_CLUSTER

CLUSTER = np.repeat(np.arange(3), SPLATS_A_CLUSTER)


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lifted tiny scene."""
    return write_lift(tmp_path_factory.mktemp("judgements"))


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
    sides = ("fx", "fy", "cx", "cy")
    third = lc.Cameras(
        [camera.replace(**{side: getattr(camera, side) / 3 for side in sides}) for camera in cameras.values()]
    )
    text = wrong(splats, third, photos)  # of a picture of another size
    assert "with intrinsics times" in text and "a picture of 0.33" in text and "share a frame" not in text
    assert " | " not in text
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


def photos_of(splats: lc.Splats, cameras: lc.Cameras, folder: Path) -> Path:
    """Write renders on black of splats of degree 0 as photos."""
    assert splats.sh is not None
    colours = (0.5 + 0.28209479 * splats.sh[:, 0]).clamp(0, 1)
    for name, camera in cameras.items():
        image = lc.render(splats, camera, colours)
        Image.fromarray((255 * image.numpy().clip(0, 1)).round().astype(np.uint8)).save(folder / f"{name}.png")
    return folder


def test_check_calls_nothing_wrong_that_has_nothing_to_compare(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    splats, cameras = lc.read_splats(files["splats"]), lc.read_cameras(files["cameras"])
    assert evaluate.check_scene(splats, cameras, photos_of(splats, cameras, tmp_path), files["features"]).wrong == ()
    object_splats = splats[CLUSTER == 1]  # of one object on nothing, seen from nearly one place
    far = lc.Cameras([camera.replace(fx=9.0, fy=9.0) for camera in cameras.values()])
    assert evaluate.check_scene(object_splats, far, photos_of(object_splats, far, tmp_path)).wrong == ()


def test_check_names_mirrored_masks(sheet: Path, tmp_path: Path) -> None:
    masks = {}
    for path in sorted((sheet / "photos").iterdir()):
        bright = np.asarray(Image.open(path).convert("L")) > 110
        masks[path.stem] = lc.Regions(bright[:, ::-1].astype(np.int32), np.eye(2, dtype=np.float32))
    files = sheet / "splats.ply", sheet / "cameras.json", sheet / "photos"
    wrong = evaluate.check_scene(*files, write_pack(tmp_path / "p.safetensors", masks)).wrong
    assert any("the masks are mirrored left to right" in text for text in wrong), wrong


Change = Callable[[np.ndarray], np.ndarray]
CAUSES: dict[str, tuple[Change, str]] = {  # change of the photos -> the cause that is said
    "none": (lambda image: image, ""),
    "half the size": (lambda image: image[::2, ::2], ""),
    "cropped": (lambda image: image[12:-12], "another shape than their cameras"),
    "on their side": (np.rot90, "lie on their side"),
    "turned": (lambda image: image[::-1, ::-1], "photos and cameras are turned to each other"),
    "mirrored": (lambda image: image[:, ::-1], "mirrored left to right"),
}


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
