"""Maps of photos that were stretched, padded, cropped or taken through a lens: each lies where its photo shows it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
import torch
from liftcore.evaluate import check_scene
from PIL import Image

from tests.promises.command_line import run
from tests.promises.scenes import look_at, plane_under_pixels

FITS = ("stretch", "pad", "pad-end", "crop")
WIDTH, HEIGHT, CELLS = 96, 64, 24
COLOURS = np.random.default_rng(5).uniform(0, 1, (16, 3))
CANVAS = {  # that a map covers, in pixels
    "stretch": (WIDTH, HEIGHT), "pad": (WIDTH, WIDTH), "pad-end": (WIDTH, WIDTH), "crop": (HEIGHT, HEIGHT),
}  # fmt: skip


def patch_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the patch 0..15 of places on a square of four by four."""
    return np.clip(x + 2, 0, 3.99).astype(int) + 4 * np.clip(y + 2, 0, 3.99).astype(int)


@pytest.fixture(scope="module")
def scene() -> tuple[lc.Splats, lc.Cameras, np.ndarray]:
    """A plane of patches in 16 colours, its cameras, and the patch of each splat."""
    rng, count = np.random.default_rng(2), 2500
    means = np.zeros((count, 3), np.float32)
    means[:, :2] = np.stack(np.meshgrid(*[np.linspace(-1.96, 1.96, 50)] * 2), axis=-1).reshape(-1, 2)
    patches, quats = patch_of(means[:, 0], means[:, 1]), np.tile(np.eye(1, 4, dtype=np.float32), (count, 1))
    sh = ((COLOURS[patches] - 0.5) / 0.28209479).astype(np.float32)[:, None]
    sizes, logits = np.full((count, 3), -3.2, np.float32), np.full(count, 4, np.float32)
    centres = rng.normal((0, 0, -3.2), (0.7, 0.7, 0.2), (6, 3))
    cameras = {f"v{k}": look_at(centre, f"v{k}", WIDTH, HEIGHT) for k, centre in enumerate(centres)}
    return lc.Splats(means, quats, sizes, logits, sh=sh), lc.Cameras(cameras), patches


def map_of(camera: lc.Camera, fit: str) -> np.ndarray:
    """Return a map [24, 24, 16] of the patches, of a photo that was made to fit; bars are of patch 5."""
    sides = CANVAS[fit]
    scale = [CELLS / side for side in sides]
    before = 0.0 if fit == "pad-end" else 0.5
    bars = [before * (side - photo) for side, photo in zip(sides, (WIDTH, HEIGHT), strict=True)]
    at_cells = camera.replace(
        width=CELLS, height=CELLS, fx=camera.fx * scale[0], fy=camera.fy * scale[1],
        cx=(camera.cx + bars[0]) * scale[0], cy=(camera.cy + bars[1]) * scale[1],
    )  # fmt: skip
    x, y = plane_under_pixels(at_cells)
    patches, (v, u) = patch_of(x, y), np.mgrid[:CELLS, :CELLS] + 0.5
    for axis, places, photo in ((0, u, WIDTH), (1, v, HEIGHT)):
        pixels = places / scale[axis] - bars[axis]
        patches[(pixels < 0) | (pixels > photo)] = 5
    return np.eye(16, dtype=np.float32)[patches]


def share_right(scene: tuple[lc.Splats, lc.Cameras, np.ndarray], true_fit: str, fit: Any) -> float:
    splats, cameras, patches = scene
    views = {name: lc.FeatureGrid(map_of(camera, true_fit), fit=fit) for name, camera in cameras.items()}
    result = lc.lift(splats, cameras, views, preset="row-sum", diagnostic_rays=0, progress=False)
    return float((result.features.float().argmax(dim=1).numpy() == patches)[result.has_feature.numpy()].mean())


@pytest.mark.parametrize("true_fit", FITS)
def test_a_map_is_right_if_its_fit_is_said(scene: tuple[lc.Splats, lc.Cameras, np.ndarray], true_fit: str) -> None:
    right = {fit: share_right(scene, true_fit, fit) for fit in FITS}
    assert right[true_fit] > 0.85
    assert all(right[true_fit] > right[other] + 0.1 for other in FITS if other != true_fit), right
    assert share_right(scene, true_fit, "") == right["stretch"]


@pytest.mark.parametrize("true_fit", FITS)
def test_a_fit_is_recorded_by_pack_and_told_by_check(
    scene: tuple[lc.Splats, lc.Cameras, np.ndarray], true_fit: str, tmp_path: Path
) -> None:
    splats, cameras, _ = scene
    (tmp_path / "maps").mkdir()
    photos = {}
    for name, camera in cameras.items():
        np.save(tmp_path / "maps" / f"{name}.npy", map_of(camera, true_fit))
        photos[name] = tmp_path / f"{name}.png"
        pixels = 255 * COLOURS[patch_of(*plane_under_pixels(camera))]
        Image.fromarray(pixels.round().astype(np.uint8)).save(photos[name])
    packs = {fit: tmp_path / f"{fit or 'unsaid'}.safetensors" for fit in ("", true_fit)}
    for fit, pack in packs.items():
        words = ["--map-fit", fit] if fit else []
        assert run("pack", "npy", tmp_path / "maps", "-o", pack, *words).status == 0
        inspected = json.loads(run("inspect", pack, "--json").out)
        assert inspected["map_fit"] == fit
    unsaid = lc.plan(splats, cameras, lc.read_features(packs[""])).warnings
    assert any(all(fit in text for fit in FITS) for text in unsaid)
    assert not any("aspect" in text for text in lc.plan(splats, cameras, lc.read_features(packs[true_fit])).warnings)
    for fit in ("", true_fit):
        report = check_scene(splats, cameras, photos, packs[fit])
        messages = [text for text in report.wrong if "--map-fit" in text]
        is_right = (fit or "stretch") == true_fit
        assert messages == [] if is_right else f"--map-fit {true_fit}" in messages[0], (fit, report)


LENS = {"k1": -0.45, "k2": 0.15}  # bends corners by a quarter of their distance


def patches_on_photo(camera: lc.Camera) -> np.ndarray:
    """Return the patch [H, W] that each pixel of a photo through LENS shows, by iteration; -1 for none."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    distorted = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
    places = distorted
    for _ in range(50):
        r2 = np.square(places).sum(axis=0)
        places = distorted / (1 + LENS["k1"] * r2 + LENS["k2"] * r2**2)
    rays = np.stack([*places, np.ones_like(u)], axis=2) @ camera.viewmat[:3, :3]
    points = camera.centre - rays * (camera.centre[2] / rays[..., 2:])
    on_plane = np.abs(points[..., :2]).max(axis=2) < 2
    return np.where(on_plane, patch_of(points[..., 0], points[..., 1]), -1)


def test_maps_and_masks_of_a_distorted_photo_lie_where_it_shows_things(
    scene: tuple[lc.Splats, lc.Cameras, np.ndarray], tmp_path: Path
) -> None:
    splats, cameras, patches = scene
    truth = {name: patches_on_photo(camera) for name, camera in cameras.items()}
    book = np.eye(16, dtype=np.float32)
    views = {name: lc.Regions(labels.astype(np.int32), book) for name, labels in truth.items()}
    frames = [
        {
            "file_path": name, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "transform_matrix": (np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1, -1, 1])).tolist(),
        }
        for name, camera in cameras.items()
    ]  # fmt: skip
    right, masks = {}, {}
    for name, lens in (("lens", LENS), ("none", {})):
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "frames": frames, **lens}))
        with_lens = lc.read_cameras(path)
        result = lc.lift(splats, with_lens, views, preset="row-sum", diagnostic_rays=0, progress=False)
        has_feature = result.has_feature.numpy()
        right[name] = (result.features.float().argmax(dim=1).numpy() == patches)[has_feature].mean()
        assert ("distorted photos" in " ".join(result.diagnostics["warnings"])) == bool(lens)
        exact = lc.LiftResult.of(replace(result, rows=torch.from_numpy(book[patches]), has_feature=patches >= 0))
        exact_scene, common, union = lc.Scene(exact, splats, with_lens), 0, 0
        for patch in range(16):
            expected = truth["v0"] == patch
            places = np.argwhere(expected)
            y, x = places[np.square(places - places.mean(axis=0)).sum(axis=1).argmin()]
            answer = exact_scene.ask(lc.Query(like=[f"v0:{x},{y}"], threshold=0.5))
            mask = exact_scene.mask(answer, "v0")
            common, union = common + (mask & expected).sum(), union + (mask | expected).sum()
        masks[name] = common / union
    assert right["lens"] > 0.93 and right["lens"] > right["none"] + 0.03, right
    assert masks["lens"] > 0.65 and masks["lens"] > masks["none"] + 0.1, masks
