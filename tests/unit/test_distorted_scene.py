"""Distorted photos, from files to pictures: features reach the splats that the photos show, masks lie over them."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.errors import InvalidQuery
from liftcore.lifting.files import lift_files
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import render_png, view_mask
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.query.terms import Pixel, Vector
from liftcore.scene.cameras import Camera
from liftcore.values.lift_file import save_lift
from liftcore.values.settings import LiftSettings
from tests.distorted_scene import (
    HEIGHT,
    LENSES,
    VIEWS,
    WIDTH,
    is_clear,
    photo_of,
    quarter,
    wall,
    write_distorted_scene,
)

pytestmark = pytest.mark.slow

CLEAR = 0.1  # from the border of a quarter: two standard deviations of a splat, or three pixels


def lifted(folder: Path, lens: str, *, grids: bool = False) -> LiftResult:
    splats, cameras, features = write_distorted_scene(folder, lens, grids=grids)
    return lift_files(splats, cameras, [features], LiftSettings.of(preset="row-sum"))


def share_of_own_quarter(result: LiftResult) -> torch.Tensor:
    """Return the share of its own quarter in the feature of each splat with a feature that is clear of borders."""
    x, y = (axis.numpy() for axis in wall().means.T[:2])
    clear = is_clear(x, y, CLEAR) & result.has_feature.numpy()
    own_weight = result.features.float()[torch.arange(len(x)), torch.from_numpy(quarter(x, y))]
    return (own_weight / result.features.float().sum(dim=1)).nan_to_num(nan=1.0)[torch.from_numpy(clear)]


@pytest.mark.parametrize(("lens", "grids"), [("barrel", True), *((lens, False) for lens in LENSES)])
def test_features_reach_the_splats_that_the_photo_shows(lens: str, grids: bool, tmp_path: Path) -> None:
    result = lifted(tmp_path, lens, grids=grids)
    shares = share_of_own_quarter(result)
    assert len(shares) > 500
    assert float(shares.min()) > 0.9
    assert any("distorted photos" in text for text in result.metadata.diagnostics["warnings"])
    # The same maps taken for a pinhole's put the border elsewhere.
    document = json.loads((tmp_path / "transforms.json").read_text())
    pinhole_document = {key: value for key, value in document.items() if key not in LENSES[lens][0]}
    (tmp_path / "transforms.json").write_text(json.dumps(pinhole_document))
    paths = tmp_path / "splats.ply", tmp_path / "transforms.json"
    ignored = lift_files(*paths, [tmp_path / "features.safetensors"], LiftSettings.of(preset="row-sum"))
    assert float(share_of_own_quarter(ignored).min()) < 0.5
    assert not any("distorted photos" in text for text in ignored.metadata.diagnostics["warnings"])


def is_lifted(camera: Camera) -> np.ndarray:
    """[H, W] bool, the pixels of the photo that the camera's pinhole sees."""
    assert camera.lens is not None
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    x, y = camera.lens.on_plane(u, v)
    x, y = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    return (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)


@pytest.mark.parametrize("lens", ["barrel", "fisheye"])
def test_masks_lie_over_the_photo(lens: str, tmp_path: Path) -> None:
    save_lift(lifted(tmp_path, lens), tmp_path / "made.safetensors")
    scene = Scene(tmp_path / "made.safetensors")
    for view in VIEWS:
        photo = np.where(is_lifted(scene.cameras[view]), photo_of(view, lens, CLEAR), -1)
        for part in np.unique(photo[photo >= 0]):
            y, x = np.argwhere(photo == part)[len(np.argwhere(photo == part)) // 2]
            answer = ask(scene, Query.of((Pixel(view, int(x), int(y)),), threshold=0.5))
            rendered = view_mask(scene, answer, view)
            assert rendered.mask.shape == photo.shape
            selected, truth = rendered.mask & (photo >= 0), photo == part
            assert (selected & truth).sum() / (selected | truth).sum() > 0.99
    answer = ask(scene, Query.of((Vector((0.0, 1.0, 0.0, 0.0)),), threshold=0.5))
    expected = is_lifted(scene.cameras["left"]) & (photo_of("left", lens, CLEAR) == 1)
    assert view_mask(scene, answer, "left").mask[expected].all()
    with pytest.raises(InvalidQuery, match=rf"x in 0\.\.{WIDTH - 1} and y in 0\.\.{HEIGHT - 1}, got {WIDTH},0"):
        ask(scene, Query.of((Pixel("left", WIDTH, 0),)))
    for channel in ("rgb", "pca", "depth"):
        picture = Image.open(io.BytesIO(render_png(scene, "left", channel)))
        assert picture.size == (WIDTH, HEIGHT)
        assert np.asarray(picture).max() > 0
