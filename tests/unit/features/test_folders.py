"""Field formats become packs with nothing lost; damaged or dangerous files are refused by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import array_views, langsplat_views
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions
from liftcore.io.npy import open_npy

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
        (np.full((1, 2, 2), 4), r"ids in -1\.\.3, got ids from 4 to 4.*counted on over the levels"),
        (np.full((1, 2, 2), -2), r"ids in -1\.\.3"),
        (np.full((1, 2, 2), np.nan), r"ids from nan"),
        (np.full((1, 2, 2), 0.5), "whole numbers"),
        (np.zeros((2, 2, 2, 2)), r"\[L, H, W\]"),
    ],
)
def test_wrong_ids_are_refused(ids: np.ndarray, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFeatures, match=message):
        langsplat_views(langsplat(tmp_path, ids))["frame_1"]


def test_embeddings_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidFeatures, match=r"floats \[M, F\]"):
        langsplat_views(langsplat(tmp_path, codebook=IDS))["frame_1"]
    (tmp_path / "frame_1_f.npy").unlink()
    with pytest.raises(InvalidFeatures, match=r"frame_1_f\.npy, got frame_1_s\.npy alone"):
        langsplat_views(tmp_path)


@pytest.mark.parametrize("layout", ["hwc", "chw"])
def test_array_folder_becomes_a_pack(layout, tmp_path: Path) -> None:
    grid = np.arange(24, dtype=np.float16).reshape(2, 3, 4)
    folder = tmp_path / "dino"
    folder.mkdir()
    np.save(folder / "a.npy", grid if layout == "hwc" else grid.transpose(2, 0, 1))
    np.save(folder / "b.npy", np.asfortranarray(grid if layout == "hwc" else grid.transpose(2, 0, 1)))
    write_pack(tmp_path / "pack", array_views(folder, layout), {})
    packs = read_features(tmp_path / "pack")
    assert packs.channels == 4
    for view in ("a", "b"):
        assert np.array_equal(packs[view].codebook.numpy(), grid.reshape(6, 4))


def test_arrays_that_are_no_maps_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((1, 2, 3, 4), np.float32))
    np.save(tmp_path / "b.npy", np.zeros((2, 3, 4), np.int32))
    for view in ("a", "b"):
        with pytest.raises(InvalidFeatures, match=r"floats \[h, w, F\]"):
            array_views(tmp_path)[view]
    np.save(tmp_path / "a.npy", np.array([[[1.0, 1e300]]]))
    with pytest.raises(InvalidFeatures, match=r"'a' grid: expected finite values .*got 1 of 2"):
        write_pack(tmp_path / "pack", array_views(tmp_path), {})


def test_folder_without_arrays_says_why(tmp_path: Path) -> None:
    with pytest.raises(InvalidFeatures, match="no such folder"):
        array_views(tmp_path / "nowhere")
    with pytest.raises(InvalidFeatures, match="0 other files"):
        array_views(tmp_path)
    (tmp_path / "a.pt").write_bytes(b"never opened")
    with pytest.raises(InvalidFeatures, match=r"1 pickles \(a\.pt\), which may run code.*numpy\.save"):
        array_views(tmp_path)


def test_array_of_objects_is_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object))
    with pytest.raises(InvalidFeatures, match="which may run code"):
        open_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(1 << 40,), (1 << 20, 1 << 20, 1 << 20), (0, 4), (-4,)])
def test_array_header_is_believed_only_as_far_as_the_file_goes(shape: tuple[int, ...], tmp_path: Path) -> None:
    path = tmp_path / "bomb.npy"
    with path.open("wb") as handle:
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f4", "fortran_order": False, "shape": shape})
        handle.write(b"16 bytes of data")
    with pytest.raises(InvalidFeatures, match="as its header says, got a file of"):
        open_npy(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x93NUMPY",
        b"not an array",
        b"\x93NUMPY\x01\x00\x05\x00{'x':",
        b"\x93NUMPY\x03\x00\x00\x00\x00\x00",
    ],
)
def test_broken_array_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(InvalidFeatures, match=r"a \.npy file") as caught:
        open_npy(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)
    with pytest.raises(InvalidFeatures, match="No such file"):
        open_npy(tmp_path / "nowhere.npy")
