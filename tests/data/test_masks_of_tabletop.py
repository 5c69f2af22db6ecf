"""A real region pack taken apart into masks and vectors, or phrases, and packed again: what a lift of it finds."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.features.masks import mask_views
from liftcore.features.pack import read_features, write_pack
from liftcore.features.prompts import prompt_views
from liftcore.features.views import Regions
from liftcore.io.safetensors_file import map_tensors
from liftcore.io.scene_files import lift_files
from liftcore.query.ask import ask
from liftcore.query.render import view_mask
from liftcore.query.scene import QueryScene
from liftcore.query.text.table import TableEncoder
from liftcore.settings import LiftSettings
from tests.run_lengths import sam_records

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def views(shared_data: Path) -> dict[str, Regions]:
    """One of 52, which is enough."""
    packs = read_features(shared_data / "tabletop" / "features_hard.safetensors")
    found = packs[packs.views[0]]
    assert isinstance(found, Regions)
    return {packs.views[0]: found}


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


def test_regions_of_all_levels_as_masks_make_the_same_lift(
    views: dict[str, Regions], shared_data: Path, tmp_path: Path
) -> None:
    (tmp_path / "masks").mkdir()
    for view, regions in views.items():
        masks = np.stack([(regions.labels == k).any(dim=0).numpy() for k in range(len(regions.codebook))])
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


def test_objects_are_found_in_the_words_of_their_masks(shared_data: Path, tmp_path: Path) -> None:
    scene, settings = shared_data / "tabletop", LiftSettings.of(preset="row-sum", certificate_rays=0)
    told = json.loads((scene / "truth.json").read_text(encoding="utf-8"))
    words = [thing["class"] for thing in told["objects"][:12]]  # the cloth and the curtain have no masks
    vectors = TableEncoder.open(scene / "text_table.safetensors").encode(
        [thing["class"] for thing in told["objects"]]
    )
    packs = read_features(scene / "features_clean.safetensors")
    for view in packs.views[::4]:
        regions = packs[view]
        assert isinstance(regions, Regions)
        nearest = np.append((regions.codebook.float().numpy() @ vectors.T).argmax(axis=1), -1)
        things = nearest[regions.labels[0].numpy()]
        for number in set(np.unique(things).tolist()) & {*range(len(words))}:
            (tmp_path / words[number]).mkdir(exist_ok=True)
            Image.fromarray(things == number).save(tmp_path / words[number] / f"{view}.png")
    found = prompt_views(tmp_path)
    write_pack(tmp_path / "pack", found.views, {}, table=found.table)
    result = lift_files(scene / "point_cloud.ply", scene / "cameras.json", [tmp_path / "pack"], settings)
    asked, truth = QueryScene(result), map_tensors(scene / "truth.safetensors")[0]
    for number, word in enumerate(words):
        answer, ious = ask(asked, word), []
        for view in told["held_out_views"]:
            mask, right = view_mask(asked, answer, view).mask, truth[f"{view}/mask"] == number
            ious.append((mask & right).sum() / (mask | right).sum() if right.any() else 1.0)
        assert np.mean(ious) >= 0.95, (word, ious)
