"""Views of packs whose names have folders that the cameras' names leave out are lifted like any other."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import torch

from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions
from liftcore.io.lift_file import save_lift
from liftcore.io.scene_files import lift_files
from liftcore.query.directions import directions
from liftcore.query.scene import QueryScene
from liftcore.query.terms import Query, Region
from liftcore.settings import LiftSettings
from tests.scenes import write_scene

if TYPE_CHECKING:
    from pathlib import Path

SETTINGS = LiftSettings.of(certificate_rays=10)


def repacked(features: Path, names: dict[str, str], out: Path) -> Path:
    packs = read_features(features)
    write_pack(out, {name: packs[view] for view, name in names.items()}, {"encoder": "random"})
    return out


def test_folders_before_the_names_of_views_change_no_bit(tmp_path: Path) -> None:
    splats, cameras, features = write_scene(tmp_path, 3)
    rig = repacked(features, {"v0": "camA/v0", "v1": "camA/v1", "v2": "camB/v2"}, tmp_path / "rig.safetensors")
    plain, made = (lift_files(splats, cameras, [pack], SETTINGS) for pack in (features, rig))
    assert torch.equal(plain.features, made.features)
    assert made.metadata.views == plain.metadata.views == ("v0", "v1", "v2")
    assert made.metadata.certificate["warnings"] == plain.metadata.certificate["warnings"]
    save_lift(made, tmp_path / "rig.lift")
    scene, packs = QueryScene.open(tmp_path / "rig.lift"), read_features(features)
    observation = packs["v1"]
    assert isinstance(observation, Regions)
    label = int(observation.labels[0].max())  # the region is asked for by the lift's name of the view
    (direction,) = directions(scene, Query((Region("v1", 0, label),)), None)
    assert torch.allclose(
        torch.as_tensor(direction),
        torch.nn.functional.normalize(observation.codebook[label].float(), dim=0),
        atol=1e-3,
    )


def test_the_warning_of_skipped_views_tells_how_a_rig_is_named(tmp_path: Path) -> None:
    splats, cameras, features = write_scene(tmp_path, 3)
    records = json.loads(cameras.read_text())
    for record, name in zip(records, ("camA/0", "camA/1", "camB/0"), strict=True):
        record["img_name"] = name
    cameras.write_text(json.dumps(records))
    short = repacked(features, {"v0": "0", "v1": "1"}, tmp_path / "short.safetensors")
    made = lift_files(splats, cameras, [short], SETTINGS)
    assert (made.metadata.views, made.metadata.certificate["views_without_camera"]) == (("camA/1",), ["0"])
    [warning] = [text for text in made.metadata.certificate["warnings"] if "skipped" in text]
    assert warning.endswith(
        "skipped: 0; cameras are named with their folders here, such as camA/1: name views like them"
    )
