"""Validation of values; views from packs, memory and iterators are the same; errors name the view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import Camera, Cameras
from liftcore.values.pack import read_features
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures

MAP = np.arange(24, dtype=np.float32).reshape(3, 2, 4)  # [F, h, w]


LABELS = np.array([[0, -1], [1, 1]])


def values() -> dict[str, ViewFeatures]:
    return {"b": FeatureGrid(MAP.transpose(1, 2, 0)), "a": Regions(LABELS, np.eye(2, 3, dtype=np.float16))}


@pytest.mark.parametrize(("kind", "floats"), [("int64", "float64"), ("int8", "float16"), (">i4", ">f4")])
def test_arrays_of_numpy_become_tensors(kind: str, floats: str) -> None:
    observation = Regions(LABELS.astype(kind), np.eye(2, 3).astype(floats))
    assert observation.labels.dtype == torch.int32 and observation.labels.tolist() == [LABELS.tolist()]
    assert observation.codebook.dtype == (torch.float16 if floats == "float16" else torch.float32)
    assert observation.codebook.tolist() == np.eye(2, 3).tolist()


def test_arrays_that_fit_are_not_copied() -> None:
    codebook, labels = torch.eye(2, 3, requires_grad=True), torch.zeros(1, 2, 2, dtype=torch.int32)
    observation = Regions(labels, codebook)
    assert observation.codebook.data_ptr() == codebook.data_ptr() and not observation.codebook.requires_grad
    assert observation.labels.data_ptr() == labels.data_ptr()
    grid = np.ones((2, 3, 4), np.float16)
    grid.flags.writeable = False  # as mapped files are
    assert FeatureGrid(grid).grid.data_ptr() == grid.ctypes.data


CODEBOOK = torch.arange(12.0).reshape(4, 3)


def labels(*values: int, dtype: torch.dtype = torch.int16) -> torch.Tensor:
    return torch.tensor(values, dtype=dtype).reshape(1, 1, -1)


def regions(*values: int) -> dict[str, torch.Tensor]:
    return {"a/labels": labels(*values), "a/codebook": CODEBOOK}


def saved(path: Path, tensors: dict[str, torch.Tensor], **metadata: str) -> Path:
    save_file(tensors, str(path), metadata=metadata or None)
    return path


def cameras(*names: str) -> Cameras:
    return Cameras(tuple(Camera.pinhole(name, 4, 4, 5.0, 5.0, 2.0, 2.0, np.eye(4)) for name in names))


def test_all_types_of_labels_and_floats_mean_the_same(tmp_path: Path) -> None:
    kinds = {"u8": torch.uint8, "i16": torch.int16, "i32": torch.int32}
    for name, dtype in kinds.items():
        none = 255 if name == "u8" else -1
        tensors = {"a/labels": labels(none, 2, dtype=dtype)[0], "a/codebook": CODEBOOK.bfloat16()}
        view = read_features(saved(tmp_path / name, tensors))["a"]
        assert isinstance(view, Regions)
        assert view.labels.tolist() == [[[-1, 2]]]  # [h, w] is one level
        assert view.codebook.dtype == torch.float32 and torch.equal(view.codebook, CODEBOOK)


def test_packs_that_do_not_fit_together_are_refused(tmp_path: Path) -> None:
    clip = saved(tmp_path / "one", regions(0), encoder="clip")
    wide = saved(tmp_path / "wide", {"b/grid": torch.ones(1, 1, 4)})
    dino = saved(tmp_path / "dino", {"b/grid": torch.ones(1, 1, 3)}, encoder="dino")
    with pytest.raises(InvalidFeatures, match=r"each view in one pack, got 'a' in"):
        read_features(clip, clip)
    with pytest.raises(InvalidFeatures, match="the same channels"):
        read_features(clip, wide)
    with pytest.raises(InvalidFeatures, match="one encoder in all packs"):
        read_features(clip, dino)
    with pytest.raises(InvalidFeatures, match="at least one view"):
        read_features()
    with pytest.raises(InvalidFeatures, match="No such file"):
        read_features(tmp_path / "nowhere")
