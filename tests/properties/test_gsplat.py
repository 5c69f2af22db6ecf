"""A reference outside of this project: gsplat's torch functions give the same projection, on random scenes.

gsplat's wheel is pure Python and imports on a CPU; its CUDA kernels are not needed for this.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import disc_exponents, projected_gaussian
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import ALPHA_FLOOR, LOW_PASS, NEAR_PLANE, CompositingParams
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from tests.properties.oracle import pixels_of
from tests.scenes import random_camera, random_splats

SEEDS = range(5)


def of_gsplat(splats: Splats, camera: Camera) -> dict[str, np.ndarray]:
    """Return gsplat's projection in float64: means [P, 2] px, depths [P], conics [P, 3] px^-2, compensations [P]."""
    covariances = _quat_scale_to_covar_preci(splats.quats.double(), splats.log_scales.double().exp(), True, False)[0]
    assert covariances is not None
    pose, K = (torch.tensor(part, dtype=torch.float64)[None] for part in (camera.viewmat, camera.K))
    _, means, depths, conics, compensations = _fully_fused_projection(
        splats.means.double(), covariances, pose, K, camera.width, camera.height, LOW_PASS, calc_compensations=True
    )
    assert compensations is not None
    parts = {"mean": means, "depth": depths, "conic": conics, "compensation": compensations}
    return {name: part[0].numpy() for name, part in parts.items()}


def check_alpha(
    splats: Splats, j: int, camera: Camera, exponents: np.ndarray, hard: np.ndarray, compensation: float | None = None
) -> int:
    """Check that the CPU raster draws a single splat with ``alpha = opacity exp(-exponent / 2)``; count its rays."""
    rows = slice(j, j + 1)
    single = Splats(
        splats.means[rows], splats.quats[rows], splats.log_scales[rows], splats.opacity_logits[rows], splats.kernel
    )
    opacity = float(torch.sigmoid(splats.opacity_logits[j].double()))
    alpha = opacity * (1.0 if compensation is None else compensation) * np.exp(-exponents / 2)
    clear = ~hard & (np.abs(alpha / ALPHA_FLOOR - 1) > 1e-4)
    expected = np.where(alpha < ALPHA_FLOOR, 0.0, np.minimum(alpha, 0.99))
    params = CompositingParams(antialiased=compensation is not None)
    image = CpuRaster(single, threads=1).row_sums(camera, params).numpy().ravel()
    assert np.abs(image - expected)[clear].max(initial=0) < 1e-5
    return int((expected > 0).sum())


@pytest.mark.parametrize("seed", SEEDS)
def test_gaussians_are_projected_and_drawn_as_gsplat_projects_them(seed: int) -> None:
    splats, camera = random_splats(seed, 50), random_camera(seed)
    projection, pixels, ray_count = of_gsplat(splats, camera), pixels_of(camera).double().numpy() + 0.5, 0
    for j in np.flatnonzero(projection["depth"] > NEAR_PLANE).tolist():
        mean, conic, compensation = projected_gaussian(splats, j, camera)
        a, b, c = projection["conic"][j]
        np.testing.assert_allclose(mean, projection["mean"][j], rtol=1e-9)
        np.testing.assert_allclose(conic.ravel()[[0, 1, 3]], [a, b, c], rtol=1e-6, atol=1e-9)
        assert compensation == pytest.approx(projection["compensation"][j], rel=1e-5)
        x, y = (pixels - projection["mean"][j]).T
        exponents, easy = a * x * x + 2 * b * x * y + c * y * y, np.zeros(len(pixels), bool)
        for share in (None, projection["compensation"][j]):
            ray_count += check_alpha(splats, j, camera, exponents, easy, share)
    assert ray_count > 300


@pytest.mark.parametrize("seed", SEEDS)
def test_discs_are_crossed_where_gsplats_ray_transforms_cross_them(seed: int) -> None:
    splats, camera = random_splats(seed, 40, kernel=Kernel.GAUSSIAN_2D), random_camera(seed)
    scales = torch.cat([splats.log_scales, torch.zeros(splats.count, 1)], dim=1).double().exp()
    pose, K = (torch.tensor(part, dtype=torch.float64)[None] for part in (camera.viewmat, camera.K))
    projection = _fully_fused_projection_2dgs(
        splats.means.double(), splats.quats.double(), scales, pose, K, camera.width, camera.height
    )
    depths, transforms = (part[0].numpy() for part in projection[2:4])
    pixels, ray_count = pixels_of(camera).double().numpy() + 0.5, 0
    for j in np.flatnonzero(depths > NEAR_PLANE).tolist():
        u, v, w = transforms[j]
        cross = np.cross(pixels[:, :1] * w - u, pixels[:, 1:] * w - v)
        s, t = cross[:, 0] / cross[:, 2], cross[:, 1] / cross[:, 2]  # as gsplat's accumulate_2dgs has it
        centre = np.array([u[2], v[2]]) / w[2]
        crossing = np.where(s * w[0] + t * w[1] + w[2] > 0, s**2 + t**2, np.inf)
        exponents = np.minimum(crossing, 2 * ((pixels - centre) ** 2).sum(axis=1))
        actual, hard = disc_exponents(splats, j, camera, pixels)
        np.testing.assert_allclose(actual[~hard], exponents[~hard], rtol=1e-6, atol=1e-9)
        ray_count += check_alpha(splats, j, camera, exponents, hard)
    assert ray_count > 300
