"""The knobs that decide what a lift looks at: pixels, views and levels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidFeatures, InvalidSettings
from liftcore.features.pack import write_pack
from liftcore.features.views import Regions
from liftcore.io.cameras import read_cameras
from liftcore.io.scene_files import lift_files
from liftcore.raster.reference import dense_view, reading_matrix, strided_rays
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.geometry import strided
from tests.scenes import observed, random_camera, random_splats
from tests.unit.features.test_observations import dense_sums
from tests.unit.solve.test_lift_equals_dense import write_scene

ROW_SUM = {"preset": "row-sum", "dtype": "float32"}


def lifted(paths, **knobs):
    return lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(**{**ROW_SUM, **knobs}))


@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize("stride", [2, 3])
def test_a_strided_lift_is_that_of_its_rays_and_its_evidence_speaks_for_all_of_them(tmp_path, stride, grids):
    paths = write_scene(tmp_path, 2, grids)
    got = lifted(paths, stride=stride)
    settings, splats = LiftSettings.of(**ROW_SUM, stride=stride), random_splats(2, 50)
    numerator, denominator, evidence, cut = np.zeros((50, 6)), np.zeros(50), np.zeros(50), np.zeros(50, bool)
    for k, camera in enumerate(read_cameras(paths[1]).values()):
        observation = observed(2, k, grids)
        walk = strided(settings.lift_params, settings, camera, k)
        view, walked = dense_view(splats, camera, walk), strided_rays(camera, walk)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        weights = view.A[ray[walked[ray]]]
        numerator += weights.T @ (S[walked[ray]] @ observation.codebook.double().numpy())
        denominator += weights.sum(axis=0)
        evidence += stride**2 * view.A[walked].sum(axis=0)
        cut |= (view.A[view.cut] > 0).any(axis=0)
    X = np.divide(numerator, denominator[:, None], out=np.zeros((50, 6)), where=denominator[:, None] > 0)
    assert np.abs(got.features.numpy() - X)[~cut].max() < 1e-3
    assert np.abs(got.evidence.numpy() - evidence)[~cut].max() < 1e-3
    assert got.metadata.certificate["rays"] == sum(
        int(strided_rays(camera, strided(settings.lift_params, settings, camera, k)).sum())
        for k, camera in enumerate(read_cameras(paths[1]).values())
    )


def test_first_pixels_differ_between_views_and_repeat_with_the_seed():
    camera, settings = random_camera(0), LiftSettings.of(stride=4)
    offsets = [strided(settings.lift_params, settings, camera, k).offset for k in range(40)]
    assert len(set(offsets)) > 8
    assert offsets == [strided(settings.lift_params, settings, camera, k).offset for k in range(40)]
    other = LiftSettings.of(stride=4, seed=1)
    assert offsets != [strided(other.lift_params, other, camera, k).offset for k in range(40)]
    slim = camera.replace(width=2)
    assert all(strided(settings.lift_params, settings, slim, k).offset[0] < 2 for k in range(20))


def test_every_nth_view_is_lifted_from_the_first_on(tmp_path):
    paths = write_scene(tmp_path, 4)
    got = lifted(paths, view_stride=2)
    assert got.metadata.views == ("v0", "v2")
    write_pack(tmp_path / "two.safetensors", {name: observed(4, int(name[1])) for name in ("v0", "v2")}, {})
    two = lift_files(paths[0], paths[1], [tmp_path / "two.safetensors"], LiftSettings.of(**ROW_SUM))
    assert torch.equal(got.features, two.features)


def per_pixel(regions: Regions) -> Regions:
    """A row a pixel: the normalised sum of its levels, as released code builds its dense maps."""
    _, rows, columns = regions.labels.shape
    own = torch.arange(rows * columns, dtype=torch.int32).reshape(1, rows, columns)
    unlabelled = (regions.labels < 0).all(dim=0, keepdim=True)
    return Regions(own.masked_fill(unlabelled, -1), torch.tensor(dense_sums(regions), dtype=torch.float32))


def one_level(regions: Regions) -> Regions:
    return Regions(regions.labels[1:2], regions.codebook)


@pytest.mark.parametrize(("levels", "reference"), [("composite", per_pixel), (1, one_level)])
def test_levels_lift_and_certify_as_the_maps_that_they_stand_for(tmp_path, levels, reference):
    paths = write_scene(tmp_path, 6)
    write_pack(tmp_path / "other.safetensors", {f"v{k}": reference(observed(6, k)) for k in range(3)}, {})
    other = lift_files(paths[0], paths[1], [tmp_path / "other.safetensors"], LiftSettings.of(**ROW_SUM))
    got = lifted(paths, levels=levels)
    assert torch.equal(got.seen, other.seen)
    assert torch.allclose(got.features, other.features, atol=1e-5)
    assert torch.allclose(got.agreement, other.agreement, atol=1e-5)
    ours, theirs = got.metadata.certificate, other.metadata.certificate
    for name in ("rays", "rows", "row_sum_mean", "residual", "surrogate", "bound"):
        assert ours[name] == pytest.approx(theirs[name], rel=1e-4), name


def test_a_level_that_a_view_lacks_is_an_error_that_names_the_view(tmp_path):
    with pytest.raises(InvalidFeatures, match="v0"):
        lifted(write_scene(tmp_path, 0), levels=2)


@pytest.mark.parametrize("preset", list(Preset))
def test_a_preset_only_fills_what_is_not_said(preset):
    plain = LiftSettings.of(preset=preset)
    said = LiftSettings.of(preset=preset, power=1, weight_floor=0.25, selection="front-mass", mass=0.5)
    assert (said.power, said.weight_floor, said.selection, said.mass) == (1, 0.25, "front-mass", 0.5)
    assert said.render_gain == plain.render_gain
    assert LiftSettings.of(**plain.model_dump(mode="json")) == plain


@pytest.mark.parametrize(
    "knob",
    [
        {"levels": "all"}, {"levels": -1}, {"levels": True}, {"levels": 1.5}, {"k": 0}, {"k": 65}, {"mass": 0},
        {"mass": 1.1}, {"weight_floor": -0.1}, {"weight_floor": 1}, {"power": 3}, {"stride": 0}, {"view_stride": 0},
        {"selection": "some"}, {"weight_floor": float("nan")},
    ],
    ids=str,
)  # fmt: skip
def test_knobs_out_of_range_are_refused_by_name(knob):
    with pytest.raises(InvalidSettings, match=next(iter(knob))):
        LiftSettings.of(**knob)


@pytest.mark.parametrize(
    "knobs", [{"preset": "top-k", "k": 3}, {"preset": "centre", "stride": 2}, {"levels": "composite"}]
)
def test_the_number_of_threads_changes_no_bit_of_a_lift(tmp_path, knobs):
    paths = write_scene(tmp_path, 7)
    runs = [lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(**knobs), threads=n) for n in (1, 3)]
    assert torch.equal(runs[0].features, runs[1].features)
    assert torch.equal(runs[0].evidence, runs[1].evidence)
    assert runs[0].metadata.certificate == runs[1].metadata.certificate
