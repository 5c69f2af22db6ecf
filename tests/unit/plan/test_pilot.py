"""How many views a pilot asks for, and whether it is right."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from liftcore.lift import lift
from liftcore.measure.room_scene import Room, write_room
from liftcore.measure.tradeoff.judge import cosine_figures
from liftcore.observe.observation import RegionMap
from liftcore.observe.pack import open_packs
from liftcore.observe.write_pack import write_pack
from liftcore.plan.pilot import FEW_VIEWS, LEAST_COSINE, Pilot, _mean_cosine, fly_pilot
from liftcore.scene.cameras import Cameras
from liftcore.scene.inria import write_inria_cameras
from liftcore.scene.load import load_cameras
from liftcore.scene.ply import write_splats
from liftcore.solve.settings import LiftSettings
from tests.scenes import centred, random_splats
from tests.unit.plan.test_views import ring

VIEWS, CHANNELS = FEW_VIEWS + 8, 48


def disagreeing(folder, error: float, gap: bool = False):
    """A cloud on a ring of cameras; each view says one vector, with an error of its own of so much of its length."""
    folder.mkdir()
    generator = torch.Generator().manual_seed(3)
    truth, labels = torch.eye(CHANNELS)[:1], torch.zeros(1, 6, 8, dtype=torch.int32)
    if gap:
        labels[:, :, 4:] = -1
    errors = torch.randn(VIEWS, CHANNELS, generator=generator)
    errors *= error / CHANNELS**0.5
    cameras = [centred(camera) for camera in ring(VIEWS)]
    observed = {camera.name: RegionMap(labels, truth + one) for camera, one in zip(cameras, errors, strict=True)}
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(random_splats(1, 80, 0.4), paths[0])
    write_inria_cameras(Cameras(tuple(cameras)), paths[1])
    write_pack(paths[2], observed, {})
    return paths


@pytest.mark.parametrize("error", [0.3, 1.0, 2.0])
def test_a_pilot_foresees_how_near_fewer_views_come(tmp_path, error):
    splats, cameras, pack = disagreeing(tmp_path / "scene", error)
    whole = lift(splats, cameras, [pack], LiftSettings.of())
    fewer = lift(splats, cameras, [pack], LiftSettings.of(view_cosine=0.98))
    expected = fewer.metadata.certificate["plan"]["view_cosine"]
    found = cosine_figures(fewer.features, whole.features, whole.evidence)["cosine"]
    assert expected >= 0.98
    assert found == pytest.approx(expected, abs=0.02)
    assert whole.metadata.certificate["plan"]["view_cosine"] is None


def test_the_more_views_disagree_the_more_are_lifted(tmp_path):
    counts = []
    for error in (0.0, 0.5, 1.0, 4.0):
        splats, cameras, pack = disagreeing(tmp_path / str(error), error)
        lifted = lift(splats, cameras, [pack], LiftSettings.of(view_cosine=0.99))
        counts.append(len(lifted.metadata.views))
    assert counts == sorted(set(counts))
    assert counts[0] <= 2
    assert counts[-1] > 0.9 * VIEWS


def test_views_follow_from_the_variance():
    pilot = Pilot(2.0)
    for total in (30, 100, 1_000):
        count = pilot.views_for(0.99, total)
        assert pilot.cosine_of(count, total) >= 0.99 > pilot.cosine_of(count - 1, total)
    assert pilot.views_for(0.999_999, 30) == 30
    assert Pilot(0.0).views_for(0.99, 30) == 1


def test_any_cosine_asks_for_a_view_at_least_and_views_that_share_nothing_are_all_needed():
    assert Pilot(2.0).views_for(1e-200, 100) == 1
    assert Pilot(math.inf).views_for(0.9, 100) == 81  # n of N have the cosine sqrt(n / N)
    assert Pilot(0.0).cosine_of(1, 100) == 1.0


def test_rays_without_labels_are_no_disagreement(tmp_path):
    counts = []
    for gap in (False, True):
        splats, cameras, pack = disagreeing(tmp_path / str(gap), 0.5, gap)
        lifted = lift(splats, cameras, [pack], LiftSettings.of(view_cosine=0.98))
        counts.append(len(lifted.metadata.views))
    assert abs(counts[0] - counts[1]) <= 3


def test_a_pilot_that_learns_nothing_leaves_nothing_out():
    assert _mean_cosine(torch.zeros(3, 2), torch.zeros(3, 2), torch.ones(3)) == LEAST_COSINE


def test_few_views_are_all_taken(tmp_path):
    splats, cameras, pack = disagreeing(tmp_path / "scene", 0.0)
    lifted = lift(splats, cameras, [pack], LiftSettings.of(view_cosine=0.5, view_stride=2))
    assert len(lifted.metadata.views) == VIEWS // 2 <= FEW_VIEWS


def test_a_room_is_written_the_same_twice_and_its_views_disagree_as_told(tmp_path):
    for name in ("one", "two"):
        write_room(tmp_path / name, Room(splats=2_000, views=3, size=(64, 48), channels=16))
    files = [(tmp_path / name / "features.safetensors").read_bytes() for name in ("one", "two")]
    assert files[0] == files[1]
    packs = open_packs([tmp_path / "one" / "features.safetensors"])
    cameras = load_cameras(tmp_path / "one" / "cameras.json")
    assert set(packs.views) == set(cameras.by_name)
    for view in packs.views:
        observed = packs.observation(view)
        assert isinstance(observed, RegionMap)
        labels = observed.labels
        sizes = [len(level.unique()) for level in labels]
        assert labels.shape == (4, 24, 32)
        assert sizes == sorted(sizes)  # from coarse to fine
        for coarse, fine in pairwise(labels):
            pairs = torch.stack([coarse.flatten(), fine.flatten()]).unique(dim=1)
            assert pairs.shape[1] == len(fine.unique())  # a part lies in one whole


def test_a_pilot_repeats(tmp_path):
    from liftcore.lift import open_sources

    splats, cameras, pack = disagreeing(tmp_path / "scene", 1.0)
    sources = open_sources(splats, cameras, [pack], LiftSettings.of())
    opened = sources.splats, sources.cameras, sources.packs, sources.views
    before = sources.splats.log_scales.clone()
    assert fly_pilot(*opened, LiftSettings.of()) == fly_pilot(*opened, LiftSettings.of())
    assert torch.equal(before, sources.splats.log_scales)
