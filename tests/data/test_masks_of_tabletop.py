"""A real region pack taken apart into masks and vectors, and packed again, is the same pack or the same lift."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.features.masks import mask_views
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions
from liftcore.io.scene_files import lift_files
from liftcore.settings import LiftSettings
from tests.run_lengths import sam_records

if TYPE_CHECKING:
    from pathlib import Path

EVERY = 26  # of 52 views: two are enough


@pytest.fixture(scope="module")
def views(shared_data: Path) -> dict[str, Regions]:
    packs = read_features(shared_data / "tabletop" / "features_hard.safetensors")
    found = {view: packs[view] for view in packs.views[::EVERY]}
    return {view: regions for view, regions in found.items() if isinstance(regions, Regions)}


def test_a_level_as_pictures_is_the_same_pack(views: dict[str, Regions], tmp_path: Path) -> None:
    whole = {view: Regions(regions.labels[:1], regions.codebook) for view, regions in views.items()}
    (tmp_path / "masks").mkdir()
    for view, regions in whole.items():
        Image.fromarray(np.where(regions.labels[0] < 0, 255, regions.labels[0]).astype(np.uint8)).save(
            tmp_path / "masks" / f"{view}.png"
        )
        np.save(tmp_path / "masks" / f"{view}.jpg.npy", regions.codebook)
    write_pack(tmp_path / "before", whole, {})
    write_pack(tmp_path / "after", mask_views(tmp_path / "masks", unlabelled=255), {})
    assert (tmp_path / "after").read_bytes() == (tmp_path / "before").read_bytes()


@pytest.mark.parametrize("kind", ["booleans", "run lengths"])
def test_regions_of_all_levels_as_masks_make_the_same_lift(
    kind: str, views: dict[str, Regions], shared_data: Path, tmp_path: Path
) -> None:
    (tmp_path / "masks").mkdir()
    for view, regions in views.items():
        masks = np.stack([(regions.labels == k).any(dim=0).numpy() for k in range(len(regions.codebook))])
        if kind == "booleans":
            np.save(tmp_path / "masks" / f"{view}_masks.npy", masks)
        else:
            text = json.dumps(sam_records(masks, as_string=True))
            (tmp_path / "masks" / f"{view}.json").write_text(text, encoding="utf-8")
        np.save(tmp_path / "masks" / f"{view}.npy", regions.codebook)
    write_pack(tmp_path / "before", views, {})
    write_pack(tmp_path / "after", mask_views(tmp_path / "masks"), {})
    scene = shared_data / "tabletop"
    before, after = (
        lift_files(
            scene / "point_cloud.ply",
            scene / "cameras.json",
            [tmp_path / name],
            LiftSettings.of(dtype="float32", certificate_rays=0, stride=2),
        )
        for name in ("before", "after")
    )
    assert torch.equal(before.seen, after.seen)
    assert torch.allclose(before.evidence, after.evidence, rtol=1e-6)
    assert torch.allclose(before.features, after.features, rtol=1e-4, atol=1e-6)
