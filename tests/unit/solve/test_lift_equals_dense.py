"""The whole pipeline, from files to the lift file, against the dense definition of the paper; and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidFeatures, InvalidSplats
from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats, write_splats
from liftcore.lifting.files import lift_files
from liftcore.lifting.geometry import strided
from liftcore.query.result import load_lift
from liftcore.query.scene import Scene
from liftcore.raster.reference import dense_view, reading_matrix, selected_weights, strided_rays
from liftcore.scene.cameras import Cameras
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel, Splats
from liftcore.values.lift_file import save_lift
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, ViewFeatures
from tests.scenes import observed, random_camera, write_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("every_kernel")]
ROW_SUM = {"preset": "row-sum", "dtype": "float32"}


@dataclass(frozen=True)
class Case:
    """A lift, and what counts as a weight in it by the words of the documentation."""

    settings: dict[str, Any]
    params: CompositingParams
    weighting: Weighting
    kernel: Kernel = field(default=Kernel.GAUSSIAN_3D, kw_only=True)


UNSCALED, GAIN = CompositingParams(), CompositingParams(1.2)
CASES = {
    preset: Case({"preset": preset}, params, weighting)
    for preset, params, weighting in (
        ("row-sum", UNSCALED, Weighting(1)),
        ("tikhonov", GAIN, Weighting(2)),
        ("argmax", UNSCALED, Weighting(1, top_k=1)),
        ("top-k", UNSCALED, Weighting(1, top_k=40)),
    )
} | {
    "antialiased": Case({"preset": "tikhonov", "antialiased": True}, replace(GAIN, antialiased=True), Weighting(2)),
    # The gain of 1.2 acts on the logits of every kernel; the released code leaves DBS out.
    "2dgs": Case({"preset": "tikhonov"}, GAIN, Weighting(2), kernel=Kernel.GAUSSIAN_2D),
    "dbs": Case({"preset": "tikhonov"}, GAIN, Weighting(2), kernel=Kernel.BETA),
    "every second pixel": Case({"preset": "row-sum", "stride": 2}, UNSCALED, Weighting(1)),
    "every third pixel": Case({"preset": "row-sum", "stride": 3}, UNSCALED, Weighting(1)),
}


@dataclass
class Dense:
    """A lift by its definition, in float64; strided total weight speaks for all pixels."""

    X: np.ndarray  # [P, F]
    D: np.ndarray  # [P]
    total_weight: np.ndarray  # [P]
    undecided: np.ndarray  # [P] bool: some ray of the splat float32 may decide otherwise
    rays: int


def dense_lift(seed: int, grids: bool, case: Case, splats: Splats, cameras: Cameras) -> Dense:
    settings = LiftSettings.of(**case.settings)
    numerator, dense = np.zeros((50, 6)), Dense(np.zeros((50, 6)), np.zeros(50), np.zeros(50), np.zeros(50, bool), 0)
    for k, camera in enumerate(cameras.values()):
        observation, params = observed(seed, k, grids), strided(case.params, settings, camera, k)
        view, is_strided = dense_view(splats, camera, params), strided_rays(camera, params)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        selected, close = selected_weights(view.A, splats, camera, case.weighting)
        labels = is_strided[ray]
        weights = selected[ray[labels]]
        numerator += weights.T @ (S[labels] @ observation.codebook.double().numpy())
        dense.D += weights.sum(axis=0)
        baseline = dense_view(splats, camera, replace(params, opacity_logit_scale=1.0))
        dense.total_weight += settings.stride**2 * baseline.A[is_strided].sum(axis=0)
        dense.undecided |= (view.A[close | view.cut | baseline.cut] > 0).any(axis=0)
        dense.rays += int(is_strided.sum())
    dense.X = np.divide(numerator, dense.D[:, None], out=np.zeros((50, 6)), where=dense.D[:, None] > 0)
    return dense


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize("seed", [3])
def test_a_lift_equals_the_dense_definition(tmp_path, case, grids, seed):
    splats, cameras, features = write_scene(tmp_path, seed, grids, case.kernel)
    result = lift_files(splats, cameras, [features], LiftSettings.of(**case.settings))
    save_lift(result, tmp_path / "lift.safetensors")
    got = load_lift(tmp_path / "lift.safetensors")
    assert read_splats(splats).kernel is case.kernel
    exact = dense_lift(seed, grids, case, read_splats(splats), read_cameras(cameras))
    unambiguous, has_weight = ~exact.undecided, exact.D > 0
    assert np.array_equal(got.has_feature.numpy()[unambiguous], has_weight[unambiguous])
    error = np.linalg.norm(got.features.double().numpy() - exact.X, axis=1)
    assert (error <= 1e-3 * np.linalg.norm(exact.X, axis=1) + 1e-7)[unambiguous & (exact.D > 1e-6)].all()
    assert (unambiguous & has_weight).sum() > 10
    assert np.abs(got.total_weight.numpy() - exact.total_weight)[unambiguous].max() < 1e-3
    assert got.metadata.diagnostics["rays"] == exact.rays


def test_weights_in_files_give_the_same_lift_as_weights_in_memory(tmp_path, monkeypatch):
    paths = write_scene(tmp_path, 8)
    memory = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of())
    monkeypatch.setattr("liftcore.lifting.geometry.MEMORY_LIMIT", 0)
    monkeypatch.setattr("liftcore.values.region_weights.MEMORY_LIMIT", 0)
    files = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of())
    assert torch.equal(memory.features, files.features)


def lifted(paths, **knobs):
    return lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(**{**ROW_SUM, **knobs}))


def test_discs_written_with_three_scales_are_discs_where_the_settings_say_so(tmp_path):
    discs, cameras, features = write_scene(tmp_path, 3, kernel=Kernel.GAUSSIAN_2D)
    flat, solid = read_splats(discs), tmp_path / "three.ply"
    scales = torch.cat([flat.log_scales, torch.full((flat.count, 1), -1.0)], dim=1)  # of no account
    write_splats(solid, Splats(flat.means, flat.quats, scales, flat.opacity_logits, sh=flat.sh))
    expected, got = lifted((discs, cameras, features)), lifted((solid, cameras, features), kernel="2dgs")
    assert got.metadata.diagnostics["plan"]["kernel"] == "2dgs"
    assert torch.equal(got.features, expected.features)
    assert not torch.equal(lifted((solid, cameras, features)).features, expected.features)
    save_lift(got, tmp_path / "made.safetensors")
    assert Scene(tmp_path / "made.safetensors").splats.kernel is Kernel.GAUSSIAN_2D  # in pictures too
    with pytest.raises(InvalidSplats, match="'beta' of a dbs splat"):
        lifted((solid, cameras, features), kernel="dbs")


def test_first_pixels_differ_between_views_and_repeat_with_the_seed():
    camera = random_camera(0)

    def offsets(seed: int) -> list[tuple[int, int]]:
        settings = LiftSettings.of(stride=4, seed=seed)
        return [strided(settings.compositing, settings, camera, k).offset for k in range(40)]

    assert len(set(offsets(0))) > 8
    assert offsets(0) == offsets(0) != offsets(1)


def one_level(regions: ViewFeatures) -> Regions:
    assert isinstance(regions, Regions)
    return Regions(regions.labels[1:2], regions.codebook)


def test_one_level_lifts_and_certifies_as_a_map_of_it_alone(tmp_path):
    paths = write_scene(tmp_path, 6)
    write_pack(tmp_path / "other.safetensors", {f"v{k}": one_level(observed(6, k)) for k in range(3)}, {})
    other = lifted((*paths[:2], tmp_path / "other.safetensors"))
    got = lifted(paths, levels=1)
    assert torch.equal(got.has_feature, other.has_feature)
    assert torch.allclose(got.features, other.features, atol=1e-5)
    actual, stand_in = got.metadata.diagnostics, other.metadata.diagnostics
    for name in ("rays", "rows", "row_sum_mean", "residual", "surrogate", "bound"):
        assert actual[name] == pytest.approx(stand_in[name], rel=1e-4), name


def test_a_level_that_a_view_lacks_is_an_error_that_names_the_view(tmp_path):
    with pytest.raises(InvalidFeatures, match="v0"):
        lifted(write_scene(tmp_path, 0), levels=2)
