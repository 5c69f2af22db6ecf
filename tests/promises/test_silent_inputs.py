"""Inputs that would give a wrong lift without a word: each is read right, or refused with what to do."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
import torch
from PIL import Image

from tests.promises.bad_files import npy
from tests.tiny_scene import PROPERTIES, ply, splat_rows

PANORAMA = "1 EQUIRECTANGULAR 64 32 32 16\n"
PINHOLE = "1 PINHOLE 64 48 50 50 32 24\n"
TURNED = 6  # EXIF's orientation of a camera that was held upright: a quarter turn


def write_model(folder: Path, camera: str, *names: str) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(camera)
    lines = [f"{number} 1 0 0 0 0 0 {number} 1 {name}\n\n" for number, name in enumerate(names, start=1)]
    (folder / "images.txt").write_text("".join(lines))


@pytest.mark.parametrize("other", ["sparse/1", "dense/0/sparse", "colmap/sparse/0"])
def test_one_of_several_models_is_read_by_its_folder(other: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    write_model(scene / "sparse/0", PINHOLE, "a.png", "b.png")
    write_model(scene / other, PINHOLE, "c.png")
    with pytest.raises(lc.InvalidCameras) as error:
        lc.read_cameras(scene)
    assert "sparse/0 (2 images)" in error.value.got and f"{other} (1 images)" in error.value.got
    assert error.value.hint.startswith("name the folder") and str(scene / "sparse/0") in error.value.hint
    assert list(lc.read_cameras(scene / "sparse/0")) == ["a", "b"] and list(lc.read_cameras(scene / other)) == ["c"]


def test_a_zip_of_several_models_says_to_unzip_it(tmp_path: Path) -> None:
    for number in (0, 1):
        write_model(tmp_path / f"sparse/{number}", PINHOLE, "a.png")
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        for path in (tmp_path / "sparse").rglob("*.txt"):
            archive.write(path, path.relative_to(tmp_path))
    with pytest.raises(lc.InvalidCameras) as error:
        lc.read_cameras(tmp_path / "scene.zip")
    assert error.value.hint.startswith("unzip it, and name the folder") and "as sparse/0" in error.value.hint


def test_a_panorama_is_refused_with_how_to_make_pinholes(tmp_path: Path) -> None:
    write_model(tmp_path / "model", PANORAMA, "a.png")
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "fl_x": 32, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    for path in (tmp_path / "model", tmp_path / "transforms.json"):
        with pytest.raises(lc.InvalidCameras, match="make pinhole photos of it"):
            lc.read_cameras(path)


def test_one_rank_of_a_training_is_no_scene(tmp_path: Path) -> None:
    tensors = {
        "means": torch.rand(3, 3),
        "quats": torch.rand(3, 4),
        "scales": torch.zeros(3, 3),
        "opacities": torch.zeros(3),
    }
    for rank in (0, 1):
        torch.save({"splats": tensors}, tmp_path / f"ckpt_29999_rank{rank}.pt")
    for rank in (0, 1):
        with pytest.raises(lc.InvalidSplats, match="one of several GPUs"):
            lc.read_splats(tmp_path / f"ckpt_29999_rank{rank}.pt")
    (tmp_path / "ckpt_29999_rank1.pt").rename(tmp_path / "alone_rank1.pt")
    assert lc.read_splats(tmp_path / "ckpt_29999_rank0.pt").count == 3  # nothing says that it is a part
    with pytest.raises(lc.InvalidSplats, match="one of several GPUs"):
        lc.read_splats(tmp_path / "alone_rank1.pt")


@pytest.mark.parametrize("column", ["x", "scale_1", "rot_2", "opacity"])
def test_a_row_with_nan_stays_unseen_and_is_counted(column: str, tmp_path: Path) -> None:
    rows = splat_rows()
    rows[4, PROPERTIES.index(column)] = np.nan
    (tmp_path / "s.ply").write_bytes(ply(rows))
    splats = lc.read_splats(tmp_path / "s.ply")
    assert splats.count == len(rows) and splats.opacity_logits[4] == -np.inf
    assert splats.warnings and torch.isfinite(splats.means).all()


def test_map_coordinates_keep_the_digits_of_the_file(tmp_path: Path) -> None:
    rows = splat_rows()
    quats, log_scales = torch.from_numpy(rows[:, 10:]), torch.from_numpy(rows[:, 7:10])
    far = rows[:, :3] + np.array([500_000.0, 5_400_000.0, 300.0])
    splats = lc.Splats(far, quats, log_scales, torch.from_numpy(rows[:, 6]))
    assert "float32" in lc.Splats(far.astype(np.float32), quats, log_scales, splats.opacity_logits).warnings[0]
    lc.write_splats(tmp_path / "far.ply", splats)
    read = lc.read_splats(tmp_path / "far.ply")
    assert np.abs(read.positions() - far).max() < 1e-6 and float(read.means.abs().max()) < 1e4


def test_size_of_a_turned_photo_is_as_it_is_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = TURNED
    Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg", exif=exif)
    frame = {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}
    for centre, size in (({}, (64, 48)), ({"cx": 32, "cy": 24}, (64, 48)), ({"cx": 24, "cy": 32}, (48, 64))):
        (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "frames": [frame], **centre}))
        camera = lc.read_cameras(tmp_path / "transforms.json")["a"]
        assert (camera.width, camera.height) == size


def coco(counts: str) -> bytes:
    """Return a data set of COCO with a mask of 2 x 3 pixels by its run lengths."""
    mask = {"image_id": 1, "category_id": 1, "segmentation": {"size": [2, 3], "counts": counts}}
    images = [{"id": 1, "file_name": "é.png", "height": 2, "width": 3}]
    return json.dumps({"images": images, "annotations": [mask], "categories": [{"id": 1, "name": "mug"}]}).encode()


MAP = np.arange(60, dtype=np.float32).reshape(5, 3, 4)  # [F, h, w]
VECTORS, MASKS = np.eye(2, dtype=np.float32), np.eye(2, dtype=bool)[:, None].repeat(2, axis=1)  # [M, F], [M, h, w]
ODD_FORMS: dict[str, tuple[dict[str, bytes], dict[str, bytes], dict[str, Any]]] = {  # plain files, odd files, options
    "run lengths as Python's text of bytes": (
        {"m.json": coco("123")}, {"m.json": coco("b'123'")}, {"kind": "prompts"},
    ),
    "name in another form of Unicode": (
        {"é.npy": npy(MAP)}, {"e\u0301.npy": npy(MAP)}, {"kind": "npy", "layout": "chw"},
    ),
    "files of an operating system": (
        {"é.npy": npy(MAP)},
        {"é.npy": npy(MAP), "._é.npy": b"x", "Thumbs.db": b"x"}, {"kind": "npy", "layout": "chw"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", ODD_FORMS)
def test_an_odd_form_makes_the_pack_of_the_plain_one(form: str, tmp_path: Path) -> None:
    *contents, options = ODD_FORMS[form]
    views = []
    for number, files in enumerate(contents):
        folder, pack = tmp_path / str(number), tmp_path / f"{number}.safetensors"
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_bytes(content)
        lc.pack_folder(folder, pack, progress=False, **options)
        views.append(lc.read_features(pack)["é"])
    usual, odd = views
    assert usual.codebook.equal(odd.codebook)
    assert isinstance(usual, lc.FeatureGrid) or usual.labels.equal(odd.labels)


def test_a_frame_in_which_nothing_was_found_has_no_label(tmp_path: Path) -> None:
    for name, count in (("a", 2), ("b", 0)):
        (tmp_path / f"{name}.npy").write_bytes(npy(VECTORS[:count]))
        (tmp_path / f"{name}_masks.npy").write_bytes(npy(MASKS[:count]))
    lc.pack_folder(tmp_path, tmp_path / "out.safetensors", "masks", progress=False)
    views: Any = lc.read_features(tmp_path / "out.safetensors")
    assert (views["a"].labels >= 0).any() and (views["b"].labels == -1).all()


def test_remarks_of_a_ply_are_kept_and_not_understood(tmp_path: Path) -> None:
    content, remarks = ply(splat_rows()), b"comment d\xe9j\xe0 vu, element vertex 3\nobj_info end of 7\nelement"
    (tmp_path / "s.ply").write_bytes(content.replace(b"element", remarks, 1))
    splats = lc.read_splats(tmp_path / "s.ply")
    lc.write_splats(tmp_path / "copy.ply", splats)
    assert (tmp_path / "copy.ply").read_bytes() == (tmp_path / "s.ply").read_bytes()
    assert splats.means.equal(torch.from_numpy(splat_rows()[:, :3])) and not splats.warnings
