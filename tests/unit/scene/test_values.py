"""Splats and cameras made of arrays in memory."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidCameras, InvalidSplats, NotFound
from liftcore.io.inspect import describe_splats
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats

K = np.array([[50.0, 0.0, 32.0], [0.0, 51.0, 24.0], [0.0, 0.0, 1.0]])


def arrays(count: int = 3, scales: int = 3) -> dict[str, Any]:
    return {
        "means": torch.rand(count, 3),
        "quats": torch.ones(count, 4),
        "log_scales": torch.zeros(count, scales),
        "opacity_logits": torch.zeros(count),
    }


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_splats_come_of_numpy_of_any_float_type(dtype: Any) -> None:
    given: dict[str, Any] = {name: values.numpy().astype(dtype) for name, values in arrays().items()}
    splats = Splats(**given)
    assert splats.kernel is Kernel.GAUSSIAN_3D
    for name, values in given.items():
        found = getattr(splats, name)
        assert found.dtype == torch.float32 and np.array_equal(found.numpy(), values.astype(np.float32))


def test_float32_arrays_are_taken_without_a_copy_or_gradient() -> None:
    given = arrays()
    means = given["means"].requires_grad_()
    splats = Splats(**given)
    assert splats.means.data_ptr() == means.data_ptr() and not splats.means.requires_grad
    own = np.zeros((3, 3), np.float32)
    assert np.shares_memory(Splats(**{**given, "means": own}).means.numpy(), own)


def test_kernel_is_a_string_or_one_of_the_kernels() -> None:
    assert Splats(**arrays(scales=2), kernel="2dgs").kernel is Kernel.GAUSSIAN_2D
    assert Splats(**arrays(), kernel=Kernel.BETA, beta=torch.zeros(3)).kernel is Kernel.BETA
    with pytest.raises(InvalidSplats, match="kernel: expected 3dgs or 2dgs or dbs, got '4dgs'"):
        Splats(**arrays(), kernel="4dgs")


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("means", torch.zeros(3, 3, dtype=torch.int32), "means: expected floats, got int32"),
        ("means", torch.zeros(0, 3), "at least one splat"),
        ("means", torch.tensor(1.0), "at least one splat"),
        ("means", "a string", "means: expected an array of torch or numpy, got str"),
        ("quats", torch.zeros(3, 3), r"quats: expected floats of shape \[3, 4\], got shape \[3, 3\]"),
        ("log_scales", torch.zeros(3, 2), r"log_scales: expected floats of shape \[3, 3\]"),
        ("opacity_logits", torch.zeros(3, 1), r"opacity_logits: .* got shape \[3, 1\]"),
        ("sh", torch.zeros(3, 5, 3), "sh: expected .* rows"),
        ("sb_params", torch.zeros(3, 2, 5), r"sb_params: expected floats of shape \[3, any, 6\]"),
        ("beta", torch.zeros(3), "beta: expected one value a splat for DBS and none"),
        ("means", torch.tensor([[0.0] * 3, [0.0, np.nan, 0.0], [0.0] * 3]), "1 that are NaN .* splat 1"),
        ("log_scales", torch.full((3, 3), np.inf), "log_scales: expected finite values, got 9"),
        ("quats", np.full((3, 4), 1e300), "quats: expected finite values, got 12"),
    ],
)
def test_wrong_arrays_are_refused_by_their_name(name: str, values: Any, message: str) -> None:
    with pytest.raises(InvalidSplats, match=message):
        Splats(**{**arrays(), name: values})


@pytest.mark.parametrize("logit", [-np.inf, np.inf])
def test_all_logits_and_scales_may_be_infinite(logit: float) -> None:
    opacities, flat = torch.full((3,), logit), torch.full((3, 3), -np.inf)
    splats = Splats(**{**arrays(), "opacity_logits": opacities, "log_scales": flat})
    assert describe_splats(splats)["opacities"]["max"] == float(logit > 0)


@pytest.mark.parametrize("make", [np.asarray, torch.tensor, np.ndarray.tolist])
def test_cameras_come_of_numpy_torch_or_lists(make: Any) -> None:
    camera = Camera(make(np.eye(4)), make(K), 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 32.0, 24.0)
    assert camera.viewmat.dtype == camera.K.dtype == np.float64 and camera.lens is None
    moved = replace(camera.replace(cx=31.0), name="moved")
    assert (moved.name, moved.cx, moved.fx, moved.width) == ("moved", 31.0, 50.0, 64)


@pytest.mark.parametrize(
    ("viewmat", "intrinsics", "message"),
    [
        (np.eye(3), K, "pose: expected a finite 4x4 matrix"),
        (np.eye(4) * 2, K, "pose: expected 0 0 0 1 as the last row"),
        ("no matrix", K, "pose: expected a finite 4x4 matrix"),
        (np.eye(4), K[:2], "K: expected a 3x3 matrix"),
        (np.eye(4), K.T, "K: expected a 3x3 matrix"),
        (np.eye(4), K + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]]), "without skew"),
        (np.eye(4), K * np.nan, "K: expected"),
    ],
)
def test_wrong_matrices_of_a_camera_are_refused(viewmat: Any, intrinsics: Any, message: str) -> None:
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
