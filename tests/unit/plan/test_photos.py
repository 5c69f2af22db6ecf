"""The order in which to encode photos, as the dense definition gives it, and the report on it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore import cli
from liftcore.lifting.planning.photos import VISIBLE_SHARE
from liftcore.lifting.planning.views import WELL_COVERED
from liftcore.raster.reference import dense_view
from liftcore.scene.cameras import Cameras
from liftcore.scene.compositing import CompositingParams
from tests.scenes import random_camera, random_splats, write_scene


def cameras_of(count: int) -> Cameras:
    return Cameras(tuple(random_camera(k, 34, 26, name=f"v{k}") for k in range(count)))


def test_order_and_shares_are_those_of_the_dense_definition():
    splats, cameras = random_splats(3, 60, spread=1.5), cameras_of(9)
    total_weight = np.stack(
        [dense_view(splats, camera, CompositingParams()).A.sum(axis=0) for camera in cameras.values()]
    )
    weight, weighted = (
        total_weight.sum(axis=0),
        total_weight >= np.maximum(VISIBLE_SHARE * total_weight.max(axis=0), 1e-12),
    )
    order, hits, shares = [], np.zeros(splats.count), []
    while len(order) < 9:
        gains = weighted @ (weight / 2 ** (hits + 1))
        gains[order] = -1.0
        order.append(int(np.argmax(gains)))
        hits += weighted[order[-1]]
        shares.append([weight[hits >= times].sum() / weight.sum() for times in (1, 2)])
    plan = lc.plan_photos(splats, cameras, threads=1)
    assert plan.order == tuple(f"v{k}" for k in order) != tuple(cameras)
    assert [row.photos for row in plan.coverage] == [4, 8, 9]
    shares_of_plan = [[row.once, row.twice] for row in plan.coverage]
    assert np.allclose(shares_of_plan, [shares[3], shares[7], shares[8]], atol=1e-6)
    assert 0.5 < plan.coverage[0].twice < plan.coverage[0].once <= plan.coverage[-1].once
    threaded = lc.plan_photos(splats, cameras, threads=2)
    assert (threaded.order, threaded.spare, threaded.seen_share) == (plan.order, plan.spare, plan.seen_share)


def test_photos_that_repeat_others_or_see_nothing_are_named_last():
    splats, first_camera = random_splats(3, 60), random_camera(0, 34, 26)
    away = first_camera.replace(viewmat=np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 1e4, name="away")
    copies = [first_camera.replace(name=f"same{k:02}") for k in range(WELL_COVERED + 2)]
    plan = lc.plan_photos(splats, Cameras((away, *copies)))
    assert plan.order == (*(camera.name for camera in copies), "away")
    assert plan.spare == ("same08", "same09", "away")
    assert any("8 before them do not show" in line and "away" in line for line in plan.lines(verbose=True))


def test_command_without_features_tells_what_to_encode_first(tmp_path, capsys):
    paths = write_scene(tmp_path, 2)
    assert cli.main(["plan", *map(str, paths[:2]), "--json"]) == 0
    reply = json.loads(capsys.readouterr().out)
    plan = lc.plan_photos(lc.read_splats(paths[0]), lc.read_cameras(paths[1]))
    assert reply["order"] == list(plan.order) and reply["photos"] == 3
    [first, *_] = reply["coverage"]
    assert first["once"] == pytest.approx(plan.coverage[0].once) and first["seconds"] > 0
    assert cli.main(["plan", *map(str, paths[:2])]) == 0
    assert f"encode first: {', '.join(plan.order)}" in capsys.readouterr().out


def test_splats_that_no_photo_sees_give_a_warning():
    splats = random_splats(3, 60)
    far = replace(splats, means=splats.means + torch.tensor([0.0, 0.0, 1e4]))
    (warning,) = lc.plan_photos(far, cameras_of(4)).warnings
    assert "no camera can see 100.0% of the splats" in warning
