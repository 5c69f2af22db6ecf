"""The whole pipeline, from files to the lift file, against the dense definition of the paper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.features.pack import write_pack
from liftcore.features.views import Regions
from liftcore.io.cameras import read_cameras
from liftcore.io.inria import write_inria_cameras
from liftcore.io.lift_file import load_lift, save_lift
from liftcore.io.ply import write_splats
from liftcore.io.scene_files import lift_files
from liftcore.raster.base import CompositingParams, Selection, Weighting
from liftcore.raster.reference import counted_weights, dense_view, reading_matrix
from liftcore.scene.cameras import Cameras
from liftcore.settings import LiftSettings
from tests.scenes import centred, observed, random_camera, random_splats

pytestmark = pytest.mark.slow

PRESETS = {  # lambda, and what counts as a weight
    "row-sum": (1.0, Weighting(1)),
    "tikhonov": (1.2, Weighting(2)),
    "argmax": (1.0, Weighting(1, Selection.TOP_K, count=1)),
    "top-k": (1.0, Weighting(1, Selection.TOP_K, count=40)),
    "front-mass": (1.0, Weighting(1, Selection.FRONT_MASS, mass=0.75)),
    "centre": (1.0, Weighting(1, Selection.CENTRE)),
    "mean": (1.0, Weighting(0, Selection.CENTRE, floor=0.05)),
}


def write_scene(folder: Path, seed: int, grids: bool = False) -> tuple[Path, Path, Path]:
    """A random scene of three views on disk: splats, cameras, features."""
    views = tuple(centred(random_camera(seed + k, 32 + 5 * k, 24 + 3 * k, name=f"v{k}")) for k in range(3))
    observations = {camera.name: observed(seed, k, grids) for k, camera in enumerate(views)}
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(random_splats(seed, 50), paths[0])
    write_inria_cameras(Cameras(views), paths[1])
    write_pack(paths[2], observations, {"encoder": "random"})
    return paths


def dense_lift(
    seed: int, cameras: Cameras, preset: str, grids: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """X, evidence, seen, and whose rays float32 may decide otherwise, by the definitions, in float64."""
    gain, weighting = PRESETS[preset]
    splats, walk = random_splats(seed, 50), CompositingParams(gain)
    numerator, denominator, evidence, undecided = np.zeros((50, 6)), np.zeros(50), np.zeros(50), np.zeros(50, bool)
    for k, camera in enumerate(cameras.values()):
        observation = observed(seed, k, grids)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        B = S @ observation.codebook.double().numpy()
        A = dense_view(splats, camera, walk).A
        chosen, close = counted_weights(A, splats, camera, walk, weighting)
        undecided |= (A[close] > 0).any(axis=0)
        weights = chosen[ray]
        numerator += weights.T @ B
        denominator += weights.sum(axis=0)
        evidence += dense_view(splats, camera, CompositingParams()).A.sum(axis=0)
    seen = denominator > 0
    X = np.divide(numerator, denominator[:, None], out=np.zeros_like(numerator), where=seen[:, None])
    return X, evidence, seen, undecided


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_lift_equals_the_dense_definition(tmp_path, preset, grids, seed):
    splats, cameras, features = write_scene(tmp_path, seed, grids)
    save_lift(lift_files(splats, cameras, [features], LiftSettings.of(preset=preset)), tmp_path / "lift.safetensors")
    got = load_lift(tmp_path / "lift.safetensors")
    X, evidence, seen, undecided = dense_lift(seed, read_cameras(cameras), preset, grids)
    assert np.array_equal(got.seen.numpy()[~undecided], seen[~undecided])
    error = np.linalg.norm(got.features.double().numpy() - X, axis=1)
    assert (error <= 1e-3 * np.linalg.norm(X, axis=1) + 1e-7)[~undecided].all()
    assert (~undecided & seen).sum() > 10
    assert np.abs(got.evidence.numpy() - evidence).max() < 1e-4


@pytest.mark.parametrize("preset", ["row-sum", "tikhonov"])
def test_agreement_is_the_norm_of_the_mean_of_unit_inputs(tmp_path, preset):
    splats, cameras, features = write_scene(tmp_path, 5)
    got = lift_files(splats, cameras, [features], LiftSettings.of(preset=preset, dtype="float32"))
    norms = torch.linalg.vector_norm(got.features, dim=1)  # the codebooks are unit vectors
    assert torch.allclose(got.agreement, norms, atol=1e-5)
    assert float(got.agreement.max()) <= 1.0


def test_agreement_does_not_depend_on_the_length_of_inputs(tmp_path):
    splats, cameras, features = write_scene(tmp_path, 6)
    plain = lift_files(splats, cameras, [features], LiftSettings.of(preset="row-sum"))
    maps = [observed(6, k) for k in range(3)]
    regions = [own for own in maps if isinstance(own, Regions)]
    longer = {f"v{k}": Regions(own.labels, own.codebook * 7.0) for k, own in enumerate(regions)}
    write_pack(tmp_path / "longer.safetensors", longer, {})
    scaled = lift_files(splats, cameras, [tmp_path / "longer.safetensors"], LiftSettings.of(preset="row-sum"))
    assert torch.allclose(plain.agreement, scaled.agreement, atol=1e-4)


def test_the_number_of_threads_changes_no_bit_of_a_lift(tmp_path):
    paths = write_scene(tmp_path, 7)
    runs = [lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(), threads=n) for n in (1, 2, 5)]
    for other in runs[1:]:
        assert torch.equal(runs[0].features, other.features)
        assert torch.equal(runs[0].agreement, other.agreement)
        assert torch.equal(runs[0].evidence, other.evidence)
        assert runs[0].metadata.certificate == other.metadata.certificate


def test_weights_in_files_give_the_same_lift_as_weights_in_memory(tmp_path, monkeypatch):
    paths = write_scene(tmp_path, 8)
    memory = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of())
    monkeypatch.setattr("liftcore.solve.geometry.MEMORY_LIMIT", 0)
    monkeypatch.setattr("liftcore.solve.weights.MEMORY_LIMIT", 0)
    files = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of())
    assert torch.equal(memory.features, files.features)
