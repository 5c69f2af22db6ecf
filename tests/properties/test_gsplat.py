"""An anchor outside of this project: gsplat's own torch functions project as ours do, on random scenes.

gsplat's wheel is pure Python and imports on a CPU; its CUDA kernels are not needed for this.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs

from liftcore.raster.base import ALPHA_FLOOR, LOW_PASS, NEAR_PLANE, CompositingParams
from liftcore.raster.cpu.project import (
    COLUMNS,
    HALF_LOG2_E,
    KY,
    MX,
    MY,
    OPACITY,
    PLAIN,
    ROOT_X,
    SLOPE,
    Targets,
    activated,
    project,
    view_of,
)
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import disc_exponents, projected_gaussian
from liftcore.scene.cameras import Camera
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from tests.scenes import random_camera, random_splats

SEEDS = range(5)


def of_gsplat(splats: Splats, camera: Camera) -> dict[str, np.ndarray]:
    """What gsplat projects, in float64: means [P, 2] px, depths [P], conics [P, 3] px^-2, compensations [P]."""
    covariances = _quat_scale_to_covar_preci(splats.quats.double(), splats.log_scales.double().exp(), True, False)[0]
    assert covariances is not None
    pose, K = (torch.tensor(part, dtype=torch.float64)[None] for part in (camera.viewmat, camera.K))
    _, means, depths, conics, compensations = _fully_fused_projection(
        splats.means.double(), covariances, pose, K, camera.width, camera.height, LOW_PASS, calc_compensations=True
    )
    assert compensations is not None
    parts = {"mean": means, "depth": depths, "conic": conics, "compensation": compensations}
    return {name: part[0].numpy() for name, part in parts.items()}


def of_ours(splats: Splats, camera: Camera, antialiased: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The splats that the CPU raster projects, and the same of these."""
    rows, ids = np.zeros((splats.count, COLUMNS[splats.kernel])), np.zeros(splats.count, np.int32)
    targets = Targets(rows, np.zeros(splats.count, np.float32), ids)
    view, scene = view_of(camera, CompositingParams()), activated(splats, 1.0)
    count = project((0, splats.count), scene, view, splats.kernel, antialiased, targets)
    own, ids = rows[:count], ids[:count]
    kx, ky, slope = own[:, ROOT_X] ** 2 / HALF_LOG2_E, own[:, KY] / HALF_LOG2_E, own[:, SLOPE]
    conic = np.stack([kx, -kx * slope, kx * slope**2 + ky], axis=1)
    compensation = own[:, PLAIN] / scene.plain[ids]
    assert np.array_equal(own[:, PLAIN], own[:, OPACITY])
    depths = targets.depths[:count]
    return ids, {"mean": own[:, [MX, MY]], "depth": depths, "conic": conic, "compensation": compensation}


@pytest.mark.parametrize("seed", SEEDS)
def test_gaussians_are_projected_as_gsplat_projects_them(seed: int) -> None:
    splats, camera = random_splats(seed, 400), random_camera(seed, 90, 70)
    theirs = of_gsplat(splats, camera)
    for antialiased in (False, True):
        ids, ours = of_ours(splats, camera, antialiased)
        assert len(ids) > 20
        if not antialiased:
            ours.pop("compensation")
        for name, part in ours.items():
            scale = np.abs(theirs[name][ids]).max(axis=-1, keepdims=True) if name == "conic" else 1.0
            np.testing.assert_allclose(part / scale, theirs[name][ids] / scale, rtol=1e-6, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_reference_projects_gaussians_as_gsplat_does(seed: int) -> None:
    splats, camera = random_splats(seed, 50), random_camera(seed)
    theirs = of_gsplat(splats, camera)
    for j in np.flatnonzero(theirs["depth"] > NEAR_PLANE):
        mean, conic, compensation = projected_gaussian(splats, int(j), camera)
        np.testing.assert_allclose(mean, theirs["mean"][j], rtol=1e-9)
        np.testing.assert_allclose(conic.ravel()[[0, 1, 3]], theirs["conic"][j], rtol=1e-6, atol=1e-9)
        assert compensation == pytest.approx(theirs["compensation"][j], rel=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_discs_are_crossed_where_gsplats_ray_transforms_cross_them(seed: int) -> None:
    splats, camera = random_splats(seed, 40, kernel=Kernel.GAUSSIAN_2D), random_camera(seed)
    scales = torch.cat([splats.log_scales, torch.zeros(splats.count, 1)], dim=1).double().exp()
    pose, K = (torch.tensor(part, dtype=torch.float64)[None] for part in (camera.viewmat, camera.K))
    found = _fully_fused_projection_2dgs(
        splats.means.double(), splats.quats.double(), scales, pose, K, camera.width, camera.height
    )
    depths, transforms = (part[0].numpy() for part in found[2:4])
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    met = 0
    for j in np.flatnonzero(depths > NEAR_PLANE):
        u, v, w = transforms[j]
        cross = np.cross(pixels[:, :1] * w - u, pixels[:, 1:] * w - v)
        s, t = cross[:, 0] / cross[:, 2], cross[:, 1] / cross[:, 2]  # as gsplat's accumulate_2dgs has it
        centre = np.array([u[2], v[2]]) / w[2]
        crossing = np.where(s * w[0] + t * w[1] + w[2] > 0, s**2 + t**2, np.inf)
        exponents = np.minimum(crossing, 2 * ((pixels - centre) ** 2).sum(axis=1))
        ours, hard = disc_exponents(splats, int(j), camera, pixels)
        np.testing.assert_allclose(ours[~hard], exponents[~hard], rtol=1e-6, atol=1e-9)
        own = slice(int(j), int(j) + 1)
        alone = Splats(
            splats.means[own], splats.quats[own], splats.log_scales[own], splats.opacity_logits[own], splats.kernel
        )
        opacity = float(torch.sigmoid(splats.opacity_logits[j].double()))
        alpha = opacity * np.exp(-exponents / 2)
        clear = ~hard & (np.abs(alpha / ALPHA_FLOOR - 1) > 1e-4)
        expected = np.where(alpha < ALPHA_FLOOR, 0.0, np.minimum(alpha, 0.99))
        image = CpuRaster(alone, threads=1).row_sums(camera, CompositingParams()).numpy().ravel()
        assert np.abs(image - expected)[clear].max() < 1e-5
        met += int((expected > 0).sum())
    assert met > 300
