"""The whole pipeline, from files to the lift file, against the dense definition of the paper; and its settings."""

from __future__ import annotations

import pytest
import torch

from liftcore.errors import InvalidFeatures, InvalidSplats
from liftcore.io.splats import read_splats, write_splats
from liftcore.lifting.files import lift_files
from liftcore.lifting.geometry import strided
from liftcore.query.scene import Scene
from liftcore.scene.splats import Kernel, Splats
from liftcore.values.lift_file import save_lift
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, ViewFeatures
from tests.scenes import observed, random_camera, write_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("every_kernel")]
ROW_SUM = {"preset": "row-sum", "dtype": "float32"}


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
