"""Values check themselves, and views are read alike from memory, from iterators and from packs."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from liftcore.errors import InvalidFeatures
from liftcore.features.pack import Views, as_views, pair, read_features, write_pack
from liftcore.features.views import FeatureGrid, Regions, ViewFeatures
from liftcore.io.safetensors_file import write_tensors
from liftcore.scene.cameras import Camera, Cameras

MAP = np.arange(24, dtype=np.float32).reshape(3, 2, 4)  # [F, h, w]
REGIONS: Any = Regions  # by what types do not allow
GRID: Any = FeatureGrid
LABELS = np.array([[0, -1], [1, 1]])


def values() -> dict[str, ViewFeatures]:
    return {"b": FeatureGrid(MAP.transpose(1, 2, 0)), "a": Regions(LABELS, np.eye(2, 3, dtype=np.float16))}


@pytest.mark.parametrize("kind", ["int64", "int16", "int32", "int8", ">i4"])
@pytest.mark.parametrize("floats", ["float16", "float32", "float64", ">f4"])
def test_arrays_of_numpy_become_tensors(kind: str, floats: str) -> None:
    found = Regions(LABELS.astype(kind), np.eye(2, 3).astype(floats))
    assert found.labels.dtype == torch.int32 and found.labels.tolist() == [LABELS.tolist()]
    assert found.codebook.dtype == (torch.float16 if floats == "float16" else torch.float32)
    assert found.codebook.tolist() == np.eye(2, 3).tolist()


def test_arrays_that_fit_are_not_copied() -> None:
    codebook, labels = torch.eye(2, 3, requires_grad=True), torch.zeros(1, 2, 2, dtype=torch.int32)
    found = Regions(labels, codebook)
    assert found.codebook.data_ptr() == codebook.data_ptr() and not found.codebook.requires_grad
    assert found.labels.data_ptr() == labels.data_ptr()
    grid = np.ones((2, 3, 4), np.float16)
    grid.flags.writeable = False  # as mapped files are
    assert FeatureGrid(grid).grid.data_ptr() == grid.ctypes.data


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: REGIONS([[0, 2]], np.eye(2)), r"labels: expected rows of its codebook \(0\.\.1\).*the label 2"),
        (lambda: REGIONS([[0, -2]], np.eye(2)), "the label -2"),
        (lambda: REGIONS([[0.5]], np.eye(2)), r"integers \[L, h, w\]"),
        (lambda: REGIONS([0], np.eye(2)), r"labels: .*int64 \[1\]"),
        (lambda: REGIONS([[0]], np.ones(2)), r"codebook: expected floats \[M, F\]"),
        (lambda: REGIONS([[0]], np.full((1, 2), np.nan), where="view 'a'"), "view 'a' codebook: .*got 2 of 2"),
        (lambda: GRID(np.ones((2, 3))), r"grid: expected floats \[h, w, F\]"),
        (lambda: GRID(np.ones((2, 0, 3))), "no side empty"),
        (lambda: GRID(torch.ones(1, 2, 3, dtype=torch.int32)), "int32"),
        (lambda: GRID(np.full((1, 1, 2), 1e16)), "finite values"),
        (lambda: GRID(None), r"grid: expected floats \[h, w, F\], got NoneType"),
        (lambda: GRID([["x"]]), "floats"),
    ],
)
def test_values_that_cannot_be_right_are_refused(make, message: str) -> None:
    with pytest.raises(InvalidFeatures, match=message):
        make()


def test_transposed_arrays_read_back_as_they_are(tmp_path) -> None:
    write_pack(tmp_path / "p", {"v": FeatureGrid.unchecked(torch.from_numpy(MAP.transpose(1, 2, 0)))}, {})
    found = read_features(tmp_path / "p")["v"]
    assert isinstance(found, FeatureGrid) and np.array_equal(found.grid.numpy(), MAP.transpose(1, 2, 0))


def test_tensors_of_any_order_are_stored_in_row_order(tmp_path) -> None:
    turned = torch.from_numpy(MAP).permute(1, 2, 0)
    write_tensors(tmp_path / "t", {"turned": turned, "every other": turned[:, ::2]}, {})
    found = load_file(tmp_path / "t")
    assert torch.equal(found["turned"], turned) and torch.equal(found["every other"], turned[:, ::2])


def sources(tmp_path) -> dict[str, Views]:
    write_pack(tmp_path / "p", values(), {})
    taken: list[str] = []

    def pairs() -> Iterator[tuple[str, ViewFeatures]]:
        for name, value in values().items():
            taken.append(name)
            yield name, value

    found = {
        "pack": read_features(tmp_path / "p"),
        "dict": as_views(values()),
        "iterator": as_views(pairs(), tmp_path),
    }
    assert taken == ["b", "a"] and [path.name for path in tmp_path.iterdir()] == ["p"]
    return found


@pytest.mark.parametrize("kind", ["pack", "dict", "iterator"])
def test_views_are_the_same_from_every_source(kind: str, tmp_path) -> None:
    views, expected = sources(tmp_path)[kind], values()
    assert (list(views), len(views), views.channels, "c" in views) == (["a", "b"], 2, 3, False)
    assert as_views(views) is views
    cameras = Cameras((Camera.pinhole("b", 4, 4, 5.0, 5.0, 2.0, 2.0, np.eye(4)),))
    assert pair(views, cameras)[1] == ["a"]
    assert (views.is_regions("a"), views.map_size("b")) == (True, (4, 2))
    assert {part: spec.dtype for part, spec in views.specs("a").items()} == {"labels": "I16", "codebook": "F16"}
    for name, value in expected.items():
        assert torch.equal(views[name].codebook, value.codebook)
    read, given = views["a"], expected["a"]
    assert isinstance(read, Regions) and isinstance(given, Regions) and torch.equal(read.labels, given.labels)


@pytest.mark.parametrize(
    ("views", "message"),
    [
        ({}, "at least one view"),
        (iter(()), "at least one view"),
        ({"a": MAP}, r"view 'a': expected Regions or FeatureGrid, got ndarray; make FeatureGrid"),
        (iter([("a", MAP)]), "view 'a': expected Regions"),
        (iter([("a", FeatureGrid(MAP)), ("a", FeatureGrid(MAP))]), "'a' twice"),
        ({"a": FeatureGrid(MAP), "b": FeatureGrid(MAP[..., :1])}, "the same channels"),
        (iter([("a", FeatureGrid(MAP)), ("b", FeatureGrid(MAP[..., :1]))]), "the same channels"),
    ],
)
def test_views_that_cannot_be_right_are_refused(views, message: str) -> None:
    with pytest.raises(InvalidFeatures, match=message):
        as_views(views)
