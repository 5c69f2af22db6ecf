"""Maps of photos that were stretched, padded or cropped: the fit is said, warned about, and told by photos."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
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
    result = lc.lift(splats, cameras, views, preset="row-sum", progress=False)
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
