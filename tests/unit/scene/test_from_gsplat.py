"""Splats from tensors of gsplat and nerfstudio, and cameras from camera-to-world poses."""

from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.scene.harmonics import SH_C0
from tests.scenes import random_camera

P = 120


def parameters() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    shapes = {"means": (P, 3), "quats": (P, 4), "scales": (P, 3), "opacities": (P,)}
    return {name: torch.tensor(rng.normal(-1, 2, shape), dtype=torch.float32) for name, shape in shapes.items()}


def test_parameters_of_a_training_are_taken_as_they_are() -> None:
    tensors = parameters()
    sh0, shN = torch.randn(P, 1, 3), torch.randn(P, 15, 3)
    splats = lc.Splats.from_gsplat(**tensors, sh0=sh0, shN=shN, activated=False)
    nerfstudio_tensors = {
        **tensors,
        "opacities": tensors["opacities"][:, None],
        "features_dc": sh0[:, 0],
        "features_rest": shN,
    }
    nerfstudio = lc.Splats.from_gsplat(**torch.nn.ParameterDict(nerfstudio_tensors), activated=False)
    assert torch.equal(splats.log_scales, tensors["scales"]) and torch.equal(
        splats.opacity_logits, tensors["opacities"]
    )
    assert splats.sh is not None and nerfstudio.sh is not None
    assert torch.equal(splats.sh, torch.cat([sh0, shN], dim=1)) and torch.equal(nerfstudio.sh, splats.sh)
    assert torch.equal(nerfstudio.opacity_logits, splats.opacity_logits) and not nerfstudio.means.requires_grad
    none = lc.Splats.from_gsplat(
        **tensors, features_dc=sh0[:, 0], features_rest=torch.zeros(P, 0, 3), activated=False
    )
    assert none.sh_degree == 0 and lc.Splats.from_gsplat(**tensors, activated=False).sh is None


def test_what_the_rasterizer_takes_is_activated_already() -> None:
    tensors = parameters()
    expected = lc.Splats.from_gsplat(**tensors, activated=False)
    active = {**tensors, "scales": tensors["scales"].exp(), "opacities": tensors["opacities"].sigmoid()}
    colours = torch.rand(P, 3)
    splats = lc.Splats.from_gsplat(**active, colors=colours, activated=True)
    assert torch.allclose(splats.log_scales, expected.log_scales, atol=1e-5)
    assert torch.allclose(splats.opacity_logits, expected.opacity_logits, atol=1e-3)
    assert splats.sh is not None and torch.allclose(splats.sh[:, 0] * SH_C0 + 0.5, colours, atol=1e-6)
    flat = lc.Splats.from_gsplat(**{**active, "opacities": np.ones(P)}, activated=True, kernel="2dgs")
    assert flat.log_scales.shape == (P, 2) and bool(flat.opacity_logits.isposinf().all()) and not flat.warnings


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"activated": True}, r"scales: expected lengths of zero or more, .*activated=False"),
        (
            {"activated": True, "scales": torch.ones(P, 3)},
            r"opacities: expected opacities in 0\.\.1, .*activated=False",
        ),
        ({"colors": torch.ones(P, 3), "sh0": torch.ones(P, 1, 3)}, "sh0: expected colours once, got colors and sh0"),
        ({"sh0": torch.ones(P, 1, 3), "shN": torch.ones(P - 1, 3, 3)}, r"sh0 and shN: expected shapes \[P, 1, 3\]"),
        ({"sh0": torch.ones(P, 1, 3), "shN": torch.ones(P, 4, 3)}, "sh: expected .* rows"),
    ],
)
def test_tensors_that_cannot_be_are_refused_by_their_name(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(lc.InvalidSplats, match=message):
        lc.Splats.from_gsplat(**{**parameters(), "activated": False, **overrides})


@pytest.mark.parametrize("rows", [3, 4])
def test_camera_to_world_poses_of_either_convention_give_the_camera(rows: int) -> None:
    for seed in range(3):
        camera = random_camera(seed)
        pose = np.linalg.inv(camera.viewmat)
        intrinsics = (camera.K, camera.width, camera.height)
        opengl_pose = pose * [1, -1, -1, 1]  # y up and z back
        for convention, matrix in (("opencv", pose), ("opengl", opengl_pose), ("blender", torch.tensor(opengl_pose))):
            actual = lc.Camera.from_camera_to_world(matrix[:rows], *intrinsics, convention=convention, name="v0")  # pyright: ignore
            np.testing.assert_allclose(actual.viewmat, camera.viewmat, atol=1e-12)
            np.testing.assert_allclose(actual.centre, pose[:3, 3], atol=1e-12)
