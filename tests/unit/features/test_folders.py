"""Formats of other projects become packs without loss; damaged or dangerous files are refused by name."""

from __future__ import annotations

import io
import zipfile
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import Layout, array_views, langsplat_views
from liftcore.io.photo_zip import describe_photos
from liftcore.values.pack import read_features, write_pack
from liftcore.values.views import Regions

if TYPE_CHECKING:
    from pathlib import Path

IDS = np.array([[[-1, 0], [1, 1]], [[2, 2], [-1, 3]]])  # two levels, counted on
CODEBOOK = np.arange(8, dtype=np.float32).reshape(4, 2)


def langsplat(folder: Path, ids: np.ndarray = IDS, codebook: np.ndarray = CODEBOOK) -> Path:
    np.save(folder / "frame_1_s.npy", ids)
    np.save(folder / "frame_1_f.npy", codebook)
    return folder


@pytest.mark.parametrize(("ids", "features"), [("float32", "float32"), ("int64", "float64"), ("int16", "float16")])
def test_langsplat_folder_becomes_a_pack(ids: str, features: str, tmp_path: Path) -> None:
    folder = tmp_path / "language_features"
    for camera in ("camA", "camB"):
        (folder / camera).mkdir(parents=True)
        langsplat(folder / camera, IDS.astype(ids), CODEBOOK.astype(features))
    write_pack(tmp_path / "pack", langsplat_views(folder), {})
    packs = read_features(tmp_path / "pack")
    assert packs.views == ("camA/frame_1", "camB/frame_1")
    view = packs["camB/frame_1"]
    assert isinstance(view, Regions)
    assert view.labels.tolist() == IDS.tolist()
    assert torch.equal(view.codebook.float(), torch.from_numpy(CODEBOOK))
    assert view.codebook.dtype == (torch.float16 if features == "float16" else torch.float32)


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (np.full((1, 2, 2), 4), r"\(0\.\.3\) or -1 for none, got the label 4.*through all levels"),
        (np.full((1, 2, 2), 0.5), "whole numbers"),
        (np.zeros((2, 2, 2, 2)), r"\[L, h, w\]"),
    ],
)
def test_wrong_ids_are_refused(ids: np.ndarray, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFeatures, match=message):
        langsplat_views(langsplat(tmp_path, ids))["frame_1"]


def test_what_systems_put_beside_photos_in_zips_is_left_out(tmp_path: Path) -> None:
    photo = io.BytesIO()
    Image.new("RGB", (4, 3)).save(photo, format="PNG")
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        for name in ("a/IMG.png", "a/._IMG.png", "__MACOSX/a/._IMG.png", "__MACOSX\\a\\IMG.png", "a/Thumbs.db"):
            archive.writestr(name, photo.getvalue() if name == "a/IMG.png" else b"no photo")
    assert describe_photos(tmp_path / "photos.zip")["names"] == ["IMG"]


GRID = np.arange(24, dtype=np.float32).reshape(2, 3, 4)  # [h, w, F], whole numbers that bfloat16 has too


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "bfloat16"])
@pytest.mark.parametrize("axes", [(), (1, 1)])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".pt"])
@pytest.mark.parametrize("layout", ["hwc", "chw"])
def test_maps_may_have_unit_axes_and_any_floats(
    layout: Layout, suffix: str, axes: tuple[int, ...], dtype: str, tmp_path: Path
) -> None:
    grid = GRID if layout == "hwc" else GRID.transpose(2, 0, 1)
    tensor = torch.from_numpy(grid.reshape(*axes, *grid.shape).copy()).to(getattr(torch, dtype))
    # numpy.save writes the bfloat16 of other packages as plain bytes
    array = tensor.view(torch.uint16).numpy().view("V2") if dtype == "bfloat16" else tensor.numpy()
    if suffix == ".npy":
        np.save(tmp_path / "a.npy", array)
    elif suffix == ".npz":
        np.savez_compressed(tmp_path / "a.npz", array)
    else:
        torch.save(tensor, tmp_path / f"a{suffix}")
    view = array_views(tmp_path, layout)["a"]
    assert view.grid.tolist() == GRID.tolist()
    assert view.grid.dtype == (torch.float16 if dtype == "float16" else torch.float32)


def test_maps_of_feature_3dgs_are_of_their_images_and_channels_first(tmp_path: Path) -> None:
    torch.save(torch.from_numpy(GRID.transpose(2, 0, 1).copy()), tmp_path / "IMG_0_fmap_CxHxW.pt")
    assert array_views(tmp_path)["IMG_0"].grid.tolist() == GRID.tolist()


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        (np.ones((8, 6), np.float32), r"floats \[F, h, w\].*got float32 \[8, 6\]; .*reshape\(F, h, w\)"),
        (np.ones((5, 2, 3, 4), np.float32), r"got float32 \[5, 2, 3, 4\]; a file is of one view: save each of the 5"),
        (np.ones((5, 2, 3, 1), np.float32), r"save each of the 5 .*or take the last axis off: array\[\.\.\., 0\]"),
    ],
)
def test_other_axes_are_refused_with_a_remedy(stored: np.ndarray, message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", stored)
    with pytest.raises(InvalidFeatures, match=message):
        array_views(tmp_path, "chw")["a"]


class _Code:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("run",)


@pytest.mark.parametrize(
    "stored",
    [
        _Code(), {"a": torch.ones(2, 3, 4)}, torch.ones(1).expand(1 << 10, 1 << 10, 1 << 10),
        torch.ones(2, 3, 4).to_sparse(), torch.ones(2, 3, 4, dtype=torch.int64),
    ],
)  # fmt: skip
def test_tensors_that_are_no_maps_are_refused_and_no_code_runs(
    stored: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.save(stored, tmp_path / "a.pt")
    with pytest.raises(InvalidFeatures, match=r"a\.pt"):
        array_views(tmp_path)["a"]
    assert capsys.readouterr().out == ""
