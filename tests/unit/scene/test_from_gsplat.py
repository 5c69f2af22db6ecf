"""Splats of gsplat's and nerfstudio's tensors, and cameras of camera-to-world poses."""

from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.scene.harmonics import SH_C0
from tests.scenes import random_camera

P = 120


def parameters(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    named = {"means": (P, 3), "quats": (P, 4), "scales": (P, 3), "opacities": (P,)}
    return {name: torch.tensor(rng.normal(-1, 2, shape), dtype=torch.float32) for name, shape in named.items()}


def test_parameters_of_a_training_are_taken_as_they_are() -> None:
    given = parameters()
    sh0, shN = torch.randn(P, 1, 3), torch.randn(P, 15, 3)
    ours = lc.Splats.from_gsplat(**given, sh0=sh0, shN=shN, activated=False)
    theirs = {**given, "opacities": given["opacities"][:, None], "features_dc": sh0[:, 0], "features_rest": shN}
    nerfstudio = lc.Splats.from_gsplat(**torch.nn.ParameterDict(theirs), activated=False)
    assert torch.equal(ours.log_scales, given["scales"]) and torch.equal(ours.opacity_logits, given["opacities"])
    assert ours.sh is not None and nerfstudio.sh is not None
    assert torch.equal(ours.sh, torch.cat([sh0, shN], dim=1)) and torch.equal(nerfstudio.sh, ours.sh)
    assert torch.equal(nerfstudio.opacity_logits, ours.opacity_logits) and not nerfstudio.means.requires_grad
    none = lc.Splats.from_gsplat(**given, features_dc=sh0[:, 0], features_rest=torch.zeros(P, 0, 3), activated=False)
    assert none.sh_degree == 0 and lc.Splats.from_gsplat(**given, activated=False).sh is None


def test_what_the_rasterizer_takes_is_activated_already() -> None:
    given = parameters()
    plain = lc.Splats.from_gsplat(**given, activated=False)
    active = {**given, "scales": given["scales"].exp(), "opacities": given["opacities"].sigmoid()}
    colours = torch.rand(P, 3)
    found = lc.Splats.from_gsplat(**active, colors=colours, activated=True)
    assert torch.allclose(found.log_scales, plain.log_scales, atol=1e-5)
    assert torch.allclose(found.opacity_logits, plain.opacity_logits, atol=1e-3)
    assert found.sh is not None and torch.allclose(found.sh[:, 0] * SH_C0 + 0.5, colours, atol=1e-6)
    flat = lc.Splats.from_gsplat(**{**active, "opacities": np.ones(P)}, activated=True, kernel="2dgs")
    assert flat.log_scales.shape == (P, 2) and bool(flat.opacity_logits.isposinf().all()) and not flat.warnings


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"activated": True}, r"scales: expected lengths of zero or more, .*activated=False"),
        (
            {"activated": True, "scales": torch.ones(P, 3)},
            r"opacities: expected opacities in 0\.\.1, .*activated=False",
        ),
        ({"scales": torch.ones(P, 2)}, r"scales: expected floats of shape \[120, 3\], got shape \[120, 2\]"),
        ({"opacities": torch.ones(P, 2)}, r"opacities: expected floats of shape \[120\]"),
        ({"quats": torch.ones(P, 3)}, r"quats: expected floats of shape \[120, 4\]"),
        ({"colors": torch.ones(P, 3), "sh0": torch.ones(P, 1, 3)}, "sh0: expected colours once, got colors and sh0"),
        ({"sh0": torch.ones(P, 1, 3), "shN": torch.ones(P - 1, 3, 3)}, r"sh0 and shN: expected shapes \[P, 1, 3\]"),
        ({"sh0": torch.ones(P, 1, 3), "shN": torch.ones(P, 4, 3)}, "sh: expected .* rows"),
    ],
)
def test_tensors_that_cannot_be_are_refused_by_their_name(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(lc.InvalidSplats, match=message):
        lc.Splats.from_gsplat(**{**parameters(), "activated": False, **changed})


def test_numbers_that_look_activated_are_told_where_splats_are_made() -> None:
    given = parameters()
    active = {**given, "scales": given["scales"].exp(), "opacities": given["opacities"].sigmoid()}
    told = lc.Splats.from_gsplat(**active, activated=False).warnings
    assert any("no logits" in text for text in told) and any("no logarithms" in text for text in told)
    assert not lc.Splats.from_gsplat(**given, activated=False).warnings
    assert not lc.Splats.from_gsplat(**active, activated=True).warnings


@pytest.mark.parametrize("rows", [3, 4])
def test_camera_to_world_poses_of_either_convention_give_the_camera(rows: int) -> None:
    for seed in range(3):
        camera = random_camera(seed)
        pose = np.linalg.inv(camera.viewmat)
        own = (camera.K, camera.width, camera.height)
        turned = pose * [1, -1, -1, 1]  # y up and z back
        for convention, given in (("opencv", pose), ("opengl", turned), ("blender", torch.tensor(turned))):
            found = lc.Camera.from_camera_to_world(given[:rows], *own, convention=convention, name="v0")  # pyright: ignore
            np.testing.assert_allclose(found.viewmat, camera.viewmat, atol=1e-12)
            np.testing.assert_allclose(found.centre, pose[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("pose", "convention", "message"),
    [
        (np.eye(4), "colmap", "convention: expected 'opencv' or 'opengl' or 'blender', got 'colmap'"),
        (np.eye(4), None, "convention: expected 'opencv'"),
        (np.eye(3), "opencv", r"pose: expected a finite 4x4 or 3x4 matrix, got shape \[3, 3\]"),
        (np.eye(4)[[3, 1, 2, 0]], "opencv", "pose: expected 0 0 0 1 as the last row"),
        (2 * np.eye(4)[:3], "opengl", "pose: expected a proper rotation, got a rotation scaled by 2"),
    ],
)
def test_wrong_poses_are_refused(pose: Any, convention: Any, message: str) -> None:
    with pytest.raises(lc.InvalidCameras, match=message):
        lc.Camera.from_camera_to_world(pose, np.eye(3), 4, 4, convention=convention)
