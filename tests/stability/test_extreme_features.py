"""The solution at its extremes: any length and size of vectors, any map, any number of labels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.features.pack import write_pack
from liftcore.features.views import FeatureGrid, Regions, ViewFeatures
from liftcore.io.inria import write_inria_cameras
from liftcore.io.lift_file import load_lift, save_lift
from liftcore.io.ply import write_splats
from liftcore.io.scene_files import lift_files
from liftcore.raster.base import CompositingParams
from liftcore.raster.reference import reading_matrix
from liftcore.result import LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings
from tests.benchmarks.extreme_measures import exact_view
from tests.benchmarks.extremes import checkerboard
from tests.scenes import random_splats, splats_at

if TYPE_CHECKING:
    from pathlib import Path

WIDTH, HEIGHT = 16, 12
SCENE = random_splats(11, 30)


def camera(name: str = "v0", back: float = 4.0) -> Camera:
    pose = np.eye(4)
    pose[2, 3] = back
    return Camera.pinhole(name, WIDTH, HEIGHT, 16.0, 16.0, WIDTH / 2, HEIGHT / 2, pose)


def lifted(folder: Path, views: dict[str, ViewFeatures], splats: Splats = SCENE, **values: object) -> LiftResult:
    """Through the files and back; a view named ``away`` looks where nothing is."""
    write_splats(splats, folder / "splats.ply")
    cameras = Cameras(tuple(camera(name, back=-1e6 if name == "away" else 4.0) for name in views))
    write_inria_cameras(cameras, folder / "cameras.json")
    write_pack(folder / "pack.safetensors", views, {})
    paths = folder / "splats.ply", folder / "cameras.json", folder / "pack.safetensors"
    save_lift(lift_files(paths[0], paths[1], paths[2:], LiftSettings.of(**values)), folder / "lift.safetensors")
    return load_lift(folder / "lift.safetensors")


def assert_sound(got: LiftResult, observation: ViewFeatures, splats: Splats = SCENE, stop: float = 1e-4) -> None:
    """Row-sum features equal the dense definition, relative to the longest input; everything is finite."""
    S, ray = reading_matrix(observation, WIDTH, HEIGHT)
    A = exact_view(splats, camera(), CompositingParams(transmittance_stop=stop)).A[ray]
    total = A.sum(axis=0)
    book = observation.codebook.double().numpy()
    X = np.divide(
        A.T @ (S @ book), total[:, None], out=np.zeros((splats.count, book.shape[1])), where=total[:, None] > 0
    )
    assert np.array_equal(got.seen.numpy(), total > 0)
    error = np.abs(got.features.double().numpy() - X).max()
    assert error <= 1e-3 * max(np.abs(book).max(), 1e-300)
    for tensor in (got.features, got.evidence, got.agreement):
        assert bool(torch.isfinite(tensor).all())
    assert 0 <= float(got.agreement.min()) <= float(got.agreement.max()) <= 1
    assert not got.features[~got.seen].any()
    certificate = got.metadata.certificate
    assert all(np.isfinite(certificate[key]) for key in ("row_sum_mean", "residual", "surrogate", "bound"))


@pytest.mark.parametrize("channels", [2, 31, 33])
def test_any_number_of_channels_equals_the_dense_definition(tmp_path, channels):
    observation = checkerboard(5, channels)
    assert_sound(lifted(tmp_path, {"v0": observation}, preset="row-sum"), observation)


def test_agreement_is_the_same_at_any_length_of_the_vectors(tmp_path):
    runs = [lifted(tmp_path, {"v0": checkerboard(5, 40, scale)}).agreement for scale in (1.0, 1e14, 1e-25)]
    assert torch.allclose(runs[0], runs[1], atol=1e-5)
    assert torch.allclose(runs[0], runs[2], atol=1e-5)


def maps() -> dict[str, ViewFeatures]:
    large = torch.arange(100 * 130, dtype=torch.int32).reshape(1, 100, 130) % 4
    rng = np.random.default_rng(0)
    return {
        "1x1 labels": Regions(torch.full((2, 1, 1), 2, dtype=torch.int32), torch.eye(4, 6)),
        "labels larger than the image": Regions(large, torch.eye(4, 6)),
        "grid of one row": FeatureGrid(torch.tensor(rng.uniform(size=(1, 9, 6)), dtype=torch.float32)),
    }


@pytest.mark.parametrize("name", list(maps()))
def test_maps_of_any_size_equal_the_dense_definition(tmp_path, name):
    observation = maps()[name]
    assert_sound(lifted(tmp_path, {"v0": observation}, preset="row-sum"), observation)


def without_plan(result: LiftResult) -> dict[str, object]:
    return {key: value for key, value in result.metadata.certificate.items() if key != "plan"}


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (12, 16), (50, 70)])
def test_the_nearest_reading_of_a_grid_takes_the_cell_under_the_pixel(tmp_path, size):
    vectors = np.random.default_rng(1).uniform(size=(*size, 6))
    grid = FeatureGrid(torch.tensor(vectors, dtype=torch.float32))
    cells = Regions(torch.arange(size[0] * size[1], dtype=torch.int32).reshape(1, *size), grid.codebook)
    got = lifted(tmp_path, {"v0": grid}, preset="row-sum", grid_reading="nearest")
    assert_sound(got, cells)
    as_regions = lifted(tmp_path, {"v0": cells}, preset="row-sum")
    assert torch.equal(got.features, as_regions.features)
    assert without_plan(got) == without_plan(as_regions)  # the plan's memory is an upper bound of each reading


def test_a_view_that_sees_nothing_changes_nothing(tmp_path):
    observation = checkerboard(5, 9)
    alone = lifted(tmp_path, {"v0": observation})
    both = lifted(tmp_path, {"away": observation, "v0": observation})
    assert torch.equal(alone.features, both.features)
    assert torch.equal(alone.evidence, both.evidence)


@pytest.mark.parametrize("preset", ["row-sum", "tikhonov"])
def test_splats_behind_forty_opaque_ones_stay_finite_without_a_stop(tmp_path, preset):
    splats = splats_at([(0.0, 0.0, 0.1 * k) for k in range(40)], log_scales=0.5, logits=1e4)
    got = lifted(tmp_path, {"v0": checkerboard(5, 9)}, splats, preset=preset, transmittance_stop=0)
    for tensor in (got.features, got.evidence, got.agreement):
        assert bool(torch.isfinite(tensor).all())
    assert float(got.features.abs().max()) <= 1.001
    assert int(got.seen.sum()) > 5
