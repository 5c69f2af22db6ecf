"""Splats and cameras from arrays in memory, names of views, and pairs of names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidCameras, NotFound
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.scene.views import MAX_VIEWS, view_names

K = np.array([[50.0, 0.0, 32.0], [0.0, 51.0, 24.0], [0.0, 0.0, 1.0]])


def arrays(count: int = 3, scales: int = 3) -> dict[str, Any]:
    return {
        "means": torch.rand(count, 3),
        "quats": torch.ones(count, 4),
        "log_scales": torch.zeros(count, scales),
        "opacity_logits": torch.zeros(count),
    }


def test_splats_come_of_arrays_of_any_float_type_without_a_copy_of_float32() -> None:
    for dtype in (np.float16, np.float32, np.float64):
        columns: dict[str, Any] = {name: values.numpy().astype(dtype) for name, values in arrays().items()}
        splats = Splats(**columns)
        assert splats.kernel is Kernel.GAUSSIAN_3D
        for name, values in columns.items():
            tensor = getattr(splats, name)
            assert tensor.dtype == torch.float32 and np.array_equal(tensor.numpy(), values.astype(np.float32))
            assert np.shares_memory(tensor.numpy(), values) is (dtype == np.float32)
    means = torch.rand(3, 3, requires_grad=True)
    splats = Splats(**{**arrays(scales=2), "means": means}, kernel="2dgs")
    assert splats.means.data_ptr() == means.data_ptr() and not splats.means.requires_grad
    assert splats.kernel is Kernel.GAUSSIAN_2D
    assert Splats(**arrays(), kernel=Kernel.BETA, beta=torch.zeros(3)).kernel is Kernel.BETA


def test_arrays_of_any_order_and_opacities_in_a_column_are_splats() -> None:
    columns = {name: values.numpy() for name, values in arrays().items()}
    variants = {
        "means": columns["means"][::-1].copy()[::-1],
        "quats": np.asfortranarray(columns["quats"]),
        "log_scales": columns["log_scales"].astype(">f8"),
        "opacity_logits": columns["opacity_logits"][:, None],
    }
    variants["means"].setflags(write=False)
    expected, actual = Splats(**columns), Splats(**variants)
    for name in columns:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


@pytest.mark.parametrize("make", [np.asarray, torch.tensor, np.ndarray.tolist])
def test_cameras_come_of_numpy_torch_or_lists(make: Any) -> None:
    camera = Camera(make(np.eye(4)), make(K), 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 32.0, 24.0)
    assert camera.viewmat.dtype == camera.K.dtype == np.float64 and camera.lens is None
    copy = replace(camera.replace(cx=31.0), name="moved")
    assert (copy.name, copy.cx, copy.fx, copy.width) == ("moved", 31.0, 50.0, 64)
    wrong: list[tuple[Any, Any, str]] = [
        (np.eye(4) * 2, K, "pose: expected 0 0 0 1 as the last row"),
        (np.eye(4), K + np.eye(3, k=1), "without skew"),
        (np.eye(4) + 1e13 * np.eye(4, k=3), K, "pose: expected finite numbers within 1e[+]12, got 1e[+]13"),
        (np.eye(4), K + 1e10 * np.eye(3, k=2), "intrinsics: expected a principal point within 1e[+]09 pixels"),
    ]
    for viewmat, intrinsics, message in wrong:
        with pytest.raises(InvalidCameras, match=message):
            Camera(viewmat, intrinsics, 64, 48, name="v")


def test_cameras_are_a_mapping_whose_names_win() -> None:
    front = Camera(np.eye(4), K, 64, 48, name="img")
    cameras = Cameras({"a": front, "b": front})
    assert list(cameras) == ["a", "b"] and [view.name for view in cameras.values()] == ["a", "b"]
    assert ("a" in cameras, "img" in cameras, cameras.get("img")) == (True, False, None)
    assert dict(Cameras(cameras)) == dict(cameras)
    with pytest.raises(NotFound, match="nearest: "):
        cameras["img"]
    with pytest.raises(KeyError):
        cameras["img"]
    with pytest.raises(InvalidCameras, match="'img' twice"):
        Cameras([front, front])
    with pytest.raises(InvalidCameras, match="at least one view"):
        Cameras({})


def test_views_are_named_by_stem_and_all_by_path_where_any_stems_collide() -> None:
    images = ["a/001.jpg", "b\\002.png", "003.JPG", "./train/r_0", "frame.0001"]
    assert view_names(images) == ["001", "002", "003", "r_0", "frame.0001"]
    assert view_names([*images, "b/001.jpg"]) == ["a/001", "b/002", "003", "train/r_0", "frame.0001", "b/001"]


def test_more_views_than_a_scene_may_have_are_refused_by_their_names() -> None:
    names = [f"{k}.jpg" for k in range(MAX_VIEWS + 1)]
    with pytest.raises(InvalidCameras, match="at most 100000 views, got 100001; lift fewer photos"):
        view_names(names)


def test_a_view_is_found_by_its_last_part_and_else_its_neighbours_are_named() -> None:
    """Earlier lifts name a view of a rig without its folder where its number is unique."""

    def cameras_of(*names: str) -> Cameras:
        return Cameras([Camera.pinhole(name, 4, 4, 5.0, 5.0, 2.0, 2.0, np.eye(4)) for name in names])

    cameras = cameras_of("images/camA/000", "images/camB/000", "images/camA/001")
    assert cameras["001"].name == cameras["camA/001"].name == "images/camA/001"
    for unclear in ("000", "camB/001", "images/camB/001"):
        with pytest.raises(NotFound, match="nearest: images/cam"):
            cameras[unclear]
    with pytest.raises(NotFound, match="nearest:") as error:
        cameras_of(*(f"{k // 2:06}" + "x" * 300 + str(k) for k in range(20)))["000001" + "y" * 494]
    assert len(str(error.value)) < 500 and str(error.value).count("000001x") == 1
