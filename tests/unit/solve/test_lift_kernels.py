"""A lift of every kernel, from files to the lift file, against the dense definition."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidSettings, InvalidSplats
from liftcore.features.pack import write_pack
from liftcore.io.cameras import read_cameras
from liftcore.io.inria import write_inria_cameras
from liftcore.io.lift_file import save_lift
from liftcore.io.ply import write_splats
from liftcore.io.scene_files import lift_files
from liftcore.io.splats import read_splats
from liftcore.query.scene import QueryScene
from liftcore.raster.base import CompositingParams
from liftcore.raster.reference import dense_view, reading_matrix
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import LiftSettings
from tests.scenes import centred, random_camera, random_regions, random_splats

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("every_kernel")]


def write_scene(folder: Path, kernel: Kernel) -> tuple[Path, Path, Path]:
    """A scene of the kernel in three views on disk: splats, cameras, features."""
    views = tuple(centred(random_camera(k, 32 + 5 * k, 24 + 3 * k, name=f"v{k}")) for k in range(3))
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(random_splats(3, 50, kernel=kernel), paths[0])
    write_inria_cameras(Cameras(views), paths[1])
    write_pack(paths[2], {camera.name: random_regions(k) for k, camera in enumerate(views)}, {})
    return paths


def test_discs_written_with_three_scales_are_discs_where_the_settings_say_so(tmp_path):
    discs, cameras, features = write_scene(tmp_path, Kernel.GAUSSIAN_2D)
    flat, solid = read_splats(discs), tmp_path / "three.ply"
    scales = torch.cat([flat.log_scales, torch.full((flat.count, 1), -1.0)], dim=1)  # of no account
    write_splats(Splats(flat.means, flat.quats, scales, flat.opacity_logits, sh=flat.sh), solid)
    settings = LiftSettings.of(kernel="2dgs")
    wanted = lift_files(discs, cameras, [features], LiftSettings.of())
    got = lift_files(solid, cameras, [features], settings)
    assert got.metadata.certificate["plan"]["kernel"] == "2dgs"
    assert torch.equal(got.features, wanted.features)
    assert not torch.equal(lift_files(solid, cameras, [features], LiftSettings.of()).features, wanted.features)
    save_lift(got, tmp_path / "made.safetensors")
    assert QueryScene.open(tmp_path / "made.safetensors").splats.kernel is Kernel.GAUSSIAN_2D  # in pictures too
    with pytest.raises(InvalidSplats, match="'beta' of a dbs splat"):
        lift_files(solid, cameras, [features], LiftSettings.of(kernel="dbs"))


@pytest.mark.parametrize(
    ("kernel", "antialiased"),
    [(Kernel.GAUSSIAN_3D, True), (Kernel.GAUSSIAN_2D, False), (Kernel.BETA, False)],
)
def test_a_lift_of_any_kernel_equals_the_dense_definition(tmp_path, kernel, antialiased):
    paths = write_scene(tmp_path, kernel)
    settings = LiftSettings.of(preset="tikhonov", antialiased=antialiased, dtype="float32")
    got = lift_files(paths[0], paths[1], [paths[2]], settings)
    splats = read_splats(paths[0])
    assert splats.kernel is kernel
    numerator, denominator = np.zeros((50, 6)), np.zeros(50)
    for k, camera in enumerate(read_cameras(paths[1]).values()):
        observation = random_regions(k)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        # The gain of 1.2 acts on the logits of every kernel; the released code leaves DBS out.
        weights = dense_view(splats, camera, CompositingParams(1.2, antialiased=antialiased)).A[ray] ** 2
        numerator += weights.T @ (S @ observation.codebook.double().numpy())
        denominator += weights.sum(axis=0)
    clear = denominator > 1e-6
    assert clear.sum() > 20
    X = numerator[clear] / denominator[clear, None]
    assert np.abs(got.features.double().numpy()[clear] - X).max() < 1e-3
    assert got.metadata.settings.antialiased is antialiased


def test_a_lift_refuses_compensation_for_other_kernels_before_it_reads_features(tmp_path):
    paths = write_scene(tmp_path, Kernel.BETA)
    with pytest.raises(InvalidSettings, match="3D Gaussians"):
        lift_files(paths[0], paths[1], [tmp_path / "missing.safetensors"], LiftSettings.of(antialiased=True))


def test_the_compensation_changes_the_lift_of_small_splats(tmp_path):
    paths = write_scene(tmp_path, Kernel.GAUSSIAN_3D)
    plain, faded = (
        lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(antialiased=on)) for on in (False, True)
    )
    assert not torch.equal(plain.evidence, faded.evidence)
    assert float(faded.evidence.sum()) != float(plain.evidence.sum())
