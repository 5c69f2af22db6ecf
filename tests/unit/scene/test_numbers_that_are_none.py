"""NaN and infinity in trained splats: rows stay, no ray hits them, colours are grey, and warnings count them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.io.splats import read_places, read_splats
from liftcore.query.splat_colours import view_colours
from liftcore.raster.reference import dense_view
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from tests.scenes import look_at, observed, random_camera, random_splats
from tests.tiny_scene import ply, splat_rows

COUNT, BROKEN = 40, {"means": 5, "log_scales": 9, "quats": 17, "opacity_logits": 20}
VALID_ROWS = torch.tensor([row not in BROKEN.values() for row in range(COUNT)])
ODD = {"means": np.nan, "log_scales": np.inf, "quats": -np.inf, "opacity_logits": np.nan}


def geometry_of(splats: Splats) -> dict[str, Any]:
    names = ("means", "quats", "log_scales", "opacity_logits", "beta")
    return {name: value.clone() for name in names if (value := getattr(splats, name)) is not None}


def broken(splats: Splats) -> dict[str, Any]:
    """Return the arrays of splats with NaN or infinity in four rows."""
    values = geometry_of(splats)
    for name, row in BROKEN.items():
        values[name].reshape(COUNT, -1)[row, 0] = ODD[name]
    return values


@pytest.mark.parametrize("kernel", list(Kernel))
def test_no_ray_meets_a_splat_that_is_no_number(kernel: Kernel) -> None:
    original = random_splats(3, COUNT, kernel=kernel)
    splats = Splats(**broken(original), kernel=kernel)
    valid_splats = Splats(**{name: value[VALID_ROWS] for name, value in geometry_of(original).items()}, kernel=kernel)
    assert splats.count == COUNT and "4 of 40 splats" in splats.warnings[0] and "splat 5" in splats.warnings[0]
    camera = random_camera(0)
    for dense_weights, images in zip(
        (dense_view(scene, camera, CompositingParams()).A for scene in (splats, valid_splats)),
        (
            torch.stack([lc.render(scene, camera, row) for row in torch.eye(scene.count)])
            for scene in (splats, valid_splats)
        ),
        strict=True,
    ):
        np.testing.assert_allclose(images.numpy().reshape(len(images), -1).T, dense_weights, atol=1e-5)
    cameras = {f"v{number}": random_camera(number, name=f"v{number}") for number in range(3)}
    views = {name: observed(number, 0) for number, name in enumerate(cameras)}
    for preset in ("default", "row-sum"):
        result, expected = (lc.lift(scene, cameras, views, preset, device="cpu") for scene in (splats, valid_splats))
        assert not result.has_feature[~VALID_ROWS].any() and not result.features[~VALID_ROWS].any()
        assert torch.equal(result.features[VALID_ROWS], expected.features)
        assert any("4 of 40 splats" in text for text in result.diagnostics["warnings"])


@pytest.mark.parametrize("kernel", [Kernel.GAUSSIAN_3D, Kernel.BETA])
def test_a_colour_that_is_no_number_is_grey_from_everywhere(kernel: Kernel) -> None:
    splats = random_splats(3, COUNT, kernel=kernel)
    sh = torch.rand(COUNT, 4, 3)
    sh[7, 2, 1], sh[8, 0, 0] = np.nan, np.inf
    lobes = torch.rand(COUNT, 2, 6) if kernel is Kernel.BETA else None
    if lobes is not None:
        lobes[9, 1, 3] = np.nan
    with_colours = replace(splats, sh=sh, sb_params=lobes)
    grey = [7, 8] + [9] * (lobes is not None)
    assert f"{len(grey)} of 40 splats have a colour that is no number" in with_colours.warnings[0]
    for centre in ([3.0, 1.0, -4.0], [0.0, -5.0, 0.3]):
        colours = view_colours(with_colours, look_at("v", np.array(centre), 8, 8, 8.0))
        torch.testing.assert_close(colours[grey], torch.full((len(grey), 3), 0.5), atol=1e-6, rtol=0)
        assert bool(torch.isfinite(colours).all())
    assert torch.equal(with_colours.opacity_logits, splats.opacity_logits)


def test_places_of_a_file_are_numbers(tmp_path: Path) -> None:
    rows = splat_rows()
    rows[5, 0] = np.nan
    (tmp_path / "s.ply").write_bytes(ply(rows))
    np.testing.assert_array_equal(read_places(tmp_path / "s.ply"), read_splats(tmp_path / "s.ply").means.numpy())
