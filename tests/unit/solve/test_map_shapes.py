"""Warnings of maps that do not have their images' shape; no lift is refused for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.evaluate.inspect import inspect_file
from liftcore.scene.cameras import Camera
from liftcore.solve.diagnostics import shape_warnings
from liftcore.values.pack import read_features, write_pack
from liftcore.values.views import FeatureGrid, ViewFeatures


def shape_warnings_of(tmp_path: Path, observation: ViewFeatures, size: tuple[int, int]) -> list[str]:
    """Return the warnings for a map in a view of this width and height, in pixels."""
    path = tmp_path / "pack.safetensors"
    write_pack(path, {"v": observation}, {"encoder": "e"})
    camera = Camera.pinhole("v", *size, 500.0, 500.0, 1.0, 1.0, viewmat=np.eye(4))
    return shape_warnings(read_features(path), [camera])


def grid(height: int, width: int, channels: int = 3) -> FeatureGrid:
    return FeatureGrid(torch.ones(height, width, channels))


def test_maps_as_encoders_make_them_give_no_warning(tmp_path: Path) -> None:
    for cells, size in (
        ((30, 40), (640, 480)), ((23, 31), (990, 742)), ((23, 30), (990, 742)), ((24, 31), (990, 742)),
        ((1, 3), (64, 48)), ((2, 2), (1280, 720)), ((371, 495), (990, 742)), ((3286, 4946), (1237, 821)),
        ((1, 1), (500, 2)),
    ):  # fmt: skip
        assert shape_warnings_of(tmp_path, grid(*cells), size) == [], cells


CROPS = [((23, 23), (990, 742)), ((16, 16), (480, 640))]
SWAPPED = [((40, 30), (640, 480)), ((512, 30), (640, 480))]


@pytest.mark.parametrize(("cells", "size"), [*CROPS, *SWAPPED])
def test_maps_that_may_be_crops_or_have_another_shape_give_a_warning(
    tmp_path: Path, cells: tuple[int, int], size: tuple[int, int]
) -> None:
    [warning] = shape_warnings_of(tmp_path, grid(*cells), size)
    assert f"{cells[1]}x{cells[0]} for {size[0]}x{size[1]}" in warning
    assert "1 of 1 views have maps of another aspect than their images" in warning
    assert "[rows, columns]" in warning and "stretched the photos, or did pad, pad-end or crop them" in warning


def test_the_pack_warns_of_channels_that_come_first(tmp_path: Path) -> None:
    path = tmp_path / "first.safetensors"
    write_pack(path, {"v": grid(512, 30, 40)}, {"encoder": "e", "normalised": "false"})
    assert any("--layout chw" in warning for warning in inspect_file(path)["warnings"])
    write_pack(path, {"v": grid(30, 40, 512)}, {"encoder": "e", "normalised": "false"})
    assert not any("--layout chw" in warning for warning in inspect_file(path)["warnings"])
