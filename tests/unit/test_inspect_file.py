"""Inspection of a file: its kind, its size and warnings; and reading of masks for an evaluation."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from liftcore.errors import InvalidInput, SplatliftError
from liftcore.evaluate.class_masks import read_masks
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.inria import write_inria_cameras
from liftcore.io.splats import write_splats
from liftcore.query.result import load_lift
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.values.lift_file import save_lift
from liftcore.values.pack import write_pack
from liftcore.values.views import FeatureGrid, Regions
from tests.labelled_scene import WORDS, write_lift

SPLATS = Path(__file__).parents[1] / "data" / "splats"


def inspected(path: Path) -> dict[str, Any]:
    """Return the report of a file after a round trip through strict JSON."""
    return json.loads(json.dumps(inspect_file(path), allow_nan=False))


def test_splats_are_described_and_their_faults_counted(tmp_path: Path) -> None:
    quats = torch.ones(4, 4)
    quats[1] = 0
    splats = Splats(
        means=torch.tensor([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [1e7, 0, 0]]),
        quats=quats,
        log_scales=torch.tensor([[0.0] * 3, [-40.0] * 3, [1e6, 0, 0], [0.0] * 3]),
        opacity_logits=torch.tensor([0.0, 1e4, -1e4, 2.0]),
    )
    write_splats(tmp_path / "s.ply", splats)
    report = inspected(tmp_path / "s.ply")
    assert (report["kind"], report["splats"], report["kernel"], report["sh_degree"]) == ("splats", 4, "3dgs", None)
    assert report["opacities"]["max"] == 1
    text = " | ".join(report["warnings"])
    for words in (
        "1 of 4 splats have a zero quaternion",
        "larger than",
        "smaller than",
        "lie further",
        "below 1/255",
    ):
        assert words in text


def test_splats_that_mean_something_else_are_noticed(tmp_path: Path) -> None:
    def warnings_of(splats: Splats) -> str:
        write_splats(tmp_path / "s.ply", splats)
        return " | ".join(inspected(tmp_path / "s.ply")["warnings"])

    opacities = torch.linspace(0.05, 1, 100)
    activated = Splats(torch.rand(100, 3), torch.ones(100, 4), torch.full((100, 3), 0.01), opacities)
    assert "as if they were no logits" in warnings_of(activated) and "as if they were no logarithms" in warnings_of(
        activated
    )
    opacities[7], activated.log_scales[7, 1] = 1.5, -0.5
    assert "as if" not in warnings_of(activated)
    millimetres = Splats(1e3 * torch.rand(100, 3), torch.ones(100, 4), torch.full((100, 3), 4.0), opacities)
    assert "as if" not in warnings_of(millimetres)
    flat = torch.tensor([[0.0, -1.0, -13.8], [1.0, 0.5, -13.8]])
    discs = Splats(torch.zeros(2, 3), torch.ones(2, 4), flat, torch.zeros(2))
    assert "kernel=2dgs" in warnings_of(discs)
    assert "kernel=2dgs" not in warnings_of(replace(discs, log_scales=flat.clamp(min=-4.0)))
    assert "motion_0" in warnings_of(replace(discs, extras={"motion_0": torch.zeros(2)}))  # moving splats stand still


@pytest.mark.parametrize("name", ["degree3.splat", "degree3.v4.spz", "degree3.sog", "degree3.compressed.ply"])
def test_formats_of_editors_are_described_by_their_names(name: str) -> None:
    report = inspected(SPLATS / name)
    dialect = {".ply": "compressed PLY"}.get(Path(name).suffix, Path(name).suffix)
    assert (report["kind"], report["splats"], report["dialect"]) == ("splats", 40, dialect)
    assert report["sh_degree"] == (0 if name == "degree3.splat" else 3)


def test_cameras_are_described(tmp_path: Path) -> None:
    views = tuple(Camera.pinhole(name, 40, 30, 5.0, 6.0, 20.0, 15.0, np.eye(4)) for name in "ab")
    write_inria_cameras(Cameras(views), tmp_path / "cameras.json")
    report = inspected(tmp_path)
    assert (report["kind"], report["views"], report["sizes"]) == ("cameras", 2, ["40x30"])
    assert report["focal_lengths"] == {"min": 5.0, "max": 6.0}
    assert report["box"] == [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert report["warnings"] == ["2 views share 1 places"]
    pose = np.eye(4)
    pose[:3, 3] = [1.0, -2.0, 3.0]  # of the world in the camera: its centre is the negative
    write_inria_cameras(Cameras((views[0], replace(views[1], viewmat=pose))), tmp_path / "cameras.json")
    assert inspected(tmp_path)["box"] == [[-1.0, 0.0, -3.0], [0.0, 2.0, 0.0]]


def test_features_are_described_and_their_faults_counted(tmp_path: Path) -> None:
    codebook = torch.tensor([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]])
    labels = torch.tensor([[[0, 1], [-1, -1]]], dtype=torch.int32)
    views = {"a": Regions(labels, codebook), "b": FeatureGrid(torch.ones(1, 2, 2))}
    write_pack(tmp_path / "p", views, {"normalised": "true"})
    report = inspected(tmp_path / "p")
    assert (report["kind"], report["views"], report["region_maps"], report["grids"]) == ("features", 2, 1, 1)
    assert (report["channels"], report["codebook_rows"], report["unlabelled"]) == (2, 5, 0.5)
    assert report["norms"] == {"min": 1.0, "max": 5.0}
    assert report["warnings"] == [
        "the pack says normalised, but its vectors have norms from 1 to 5",
        "1 of 5 codebook rows are zero",
        "1 of 5 codebook rows are read by no label",
        "the pack does not name its encoder",
    ]


def test_maps_in_another_order_and_masks_of_one_region_are_reported(tmp_path: Path) -> None:
    rows, columns = torch.meshgrid(torch.linspace(0, 3, 12), torch.linspace(0, 4, 16), indexing="ij")
    waves = torch.stack([torch.cos(k * rows + columns + k) for k in range(8)], dim=2)
    valid = {f"v{k}": FeatureGrid(waves.roll(k, 0)) for k in range(4)}
    transposed = {
        name: FeatureGrid(grid.grid.permute(2, 0, 1).contiguous().reshape(12, 16, 8)) for name, grid in valid.items()
    }
    single_region = {f"v{k}": Regions(torch.zeros(1, 4, 4, dtype=torch.int32), torch.eye(1, 8)) for k in range(4)}
    warnings = []
    for number, views in enumerate((valid, transposed, single_region)):
        write_pack(tmp_path / f"{number}.safetensors", views, {"encoder": "x", "normalised": "false"})
        warnings.append(inspected(tmp_path / f"{number}.safetensors")["warnings"])
    assert warnings[0] == [] and "read as [F, h, w]" in warnings[1][0] and "one region alone" in warnings[2][0]


def test_lift_is_described(tmp_path: Path) -> None:
    lift = load_lift(write_lift(tmp_path))
    count, unseen = len(lift.features), len(lift.features) // 2
    save_lift(replace(lift, has_feature=torch.arange(count) >= unseen), tmp_path / "l")
    (tmp_path / "splats.ply").unlink()
    report = inspected(tmp_path / "l")
    assert (report["kind"], report["splats"], report["channels"]) == ("lift", count, len(WORDS))
    assert report["feature_share"] == pytest.approx(1 - unseen / count)
    assert report["view_consistency"] and report["settings"]["preset"] == "row-sum"
    expected = f"{unseen} of {count} splats were reached by no labelled ray; they have no features of their own"
    assert report["warnings"][0] == expected and "no longer at" in report["warnings"][1]


def test_text_table_is_described(tmp_path: Path) -> None:
    save_file({"embeddings": torch.eye(2)}, str(tmp_path / "t"), metadata={"words": '["cat"]', "encoder": "clip"})
    report = inspected(tmp_path / "t")
    assert (report["kind"], report["rows"], report["channels"], report["words"]) == ("table", 2, 2, ["cat"])
    assert report["warnings"] == ["1 words for 2 rows"]


@pytest.mark.parametrize("content", [b"", b"ply\n", b"PK\x03\x04", b"\x08\0\0\0\0\0\0\0{broken}", b"{}"])
def test_what_is_nothing_of_ours_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(SplatliftError) as excinfo:
        inspect_file(tmp_path / "x")
    assert "\n" not in str(excinfo.value)
    with pytest.raises(InvalidInput, match="nothing of that name"):
        inspect_file(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("plush/point_cloud.ply", "splats"),
        ("plush", "cameras"),
        ("tabletop/features_hard.safetensors", "features"),
        ("text_tables/lvis_clip_vit_b_32.safetensors", "table"),
    ],
)
def test_real_files_are_recognised(name: str, kind: str, shared_data: Path) -> None:
    assert inspected(shared_data / name)["kind"] == kind


def test_masks_of_any_integers_are_read_and_described(tmp_path):
    stored = {
        "b/mask": torch.tensor([[255, 7, 0]], dtype=torch.uint8),  # 255 is none, as in feature packs
        "a/mask": torch.tensor([[-1], [3]], dtype=torch.int8),
        "c/mask": torch.full((2, 2), -1),
        "c/other": torch.zeros(1),
    }
    save_file(stored, tmp_path / "m.safetensors")
    masks = read_masks(tmp_path / "m.safetensors", 8)
    assert {view: mask.tolist() for view, mask in masks.items()} == {
        "a": [[-1], [3]], "b": [[-1, 7, 0]], "c": [[-1, -1], [-1, -1]],
    }  # fmt: skip
    report = inspect_file(tmp_path / "m.safetensors")
    assert (report["kind"], report["views"], report["names"], report["classes"]) == ("masks", 3, ["a", "b", "c"], 8)
    assert (report["sizes"], report["unlabelled"]) == (["1x2", "2x2", "3x1"], pytest.approx((1 / 2 + 1 / 3 + 1) / 3))
    assert report["warnings"] == ["1 of 3 masks name no class"]


@pytest.mark.parametrize("length", [640, 640 + (1 << 16), 19_280])  # as numbers they begin as pickles and zips do
def test_a_header_as_long_as_a_signature_reads_is_a_header(length, tmp_path):
    path = tmp_path / "m.safetensors"
    save_file({"a/mask": torch.tensor([[0, 1]])}, path)
    content = path.read_bytes()
    (header_length,) = struct.unpack("<Q", content[:8])
    header = content[8 : 8 + header_length].rstrip()
    path.write_bytes(struct.pack("<Q", length) + header.ljust(length) + content[8 + header_length :])
    assert path.read_bytes()[:2] in (b"PK", b"\x80\x02")
    assert read_masks(path, 2)["a"].tolist() == [[0, 1]]
