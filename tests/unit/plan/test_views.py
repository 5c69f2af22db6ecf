"""Views and splats in the plan."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.lifting.planning.views import count_covering_views, view_order, visibility
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel
from tests.scenes import look_at, random_camera, random_regions, random_splats


def ring(count: int) -> list:
    """Return cameras on a ring around the origin."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [4 * np.array([np.cos(angle), 0.2, np.sin(angle)]) for angle in angles]
    return [look_at(f"v{k}", place, 40, 30, 40.0) for k, place in enumerate(places)]


@pytest.mark.parametrize("kernel", list(Kernel))
@pytest.mark.usefixtures("every_kernel")
def test_whatever_a_view_blends_is_in_its_field(kernel):
    splats, cameras = random_splats(3, 60, spread=2.0, kernel=kernel), [random_camera(k) for k in range(4)]
    visible = visibility(splats, cameras, CompositingParams())
    raster = CpuRaster(splats, threads=1)
    for k, camera in enumerate(cameras):
        hit = raster.region_weights(
            camera, random_regions(k), CompositingParams(), Weighting()
        ).total_weight_splats.numpy()
        assert hit.size
        assert visible.in_view[k][hit].all()
    assert not visible.in_view.all()
    assert visible.seen_share == visible.in_view.any(axis=0).mean()


def test_chosen_views_look_from_all_sides():
    visible = visibility(random_splats(0, 80, 0.3), ring(24), CompositingParams())
    order = list(view_order(visible))
    selection = sorted(order[: count_covering_views(visible, order, 6)])
    gaps = np.diff([*selection, selection[0] + 24])
    assert len(selection) == 6
    assert gaps.max() <= 8  # of 24; the first six in order would leave one of 19


def test_views_are_added_until_each_splat_is_shown_often_enough_and_the_choice_repeats():
    visible = visibility(random_splats(1, 80, 1.0), [random_camera(k) for k in range(12)], CompositingParams())
    order = list(view_order(visible))
    assert order == list(view_order(visible))
    in_view_rows = visible.in_view[:, visible.in_view.any(axis=0)]
    for times in (1, 3, 5):
        count = count_covering_views(visible, order, times)
        assert (
            in_view_rows[order[:count]].sum(axis=0).mean()
            >= times
            > in_view_rows[order[: count - 1]].sum(axis=0).mean()
        )
    assert count_covering_views(visible, order, 0) == 1
    assert count_covering_views(visible, order, 1_000) == 12
