"""Regions that cover a pixel, and the pixels that a region covers."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.regions import region_mask, regions_at
from liftcore.query.scene import Scene
from liftcore.query.terms import Region
from liftcore.values.pack import as_views
from liftcore.values.views import FeatureGrid, Regions
from tests.tiny_scene import CHANNELS, HEIGHT, WIDTH, codebook


@pytest.fixture
def levels(scene: Scene) -> Scene:
    """The tiny lift with other packs: a map of half the size, its left half on one level, a cell on another."""
    labels = np.full((3, HEIGHT // 2, WIDTH // 2), -1, np.int32)
    labels[0, :, : WIDTH // 4], labels[2, 3, 5] = 0, 2
    grid = FeatureGrid(np.ones((2, 2, CHANNELS), np.float32))
    packs = as_views({"left": Regions(labels, codebook()), "middle": grid})
    return Scene(scene.lift, scene.splats, scene.cameras, packs)


def test_regions_of_a_pixel_come_with_the_smallest_first(levels: Scene) -> None:
    regions = regions_at(levels, "left", 11, 6)
    assert [region.example for region in regions] == ["region:left:2:2", "region:left:0:0"]
    assert [region.share for region in regions] == [4 / (WIDTH * HEIGHT), 0.5]
    assert regions_at(levels, "left", WIDTH - 1, 0) == ()
    mask = region_mask(levels, Region("left", 2, 2))
    assert mask.shape == (HEIGHT, WIDTH) and np.argwhere(mask).tolist() == [[6, 10], [6, 11], [7, 10], [7, 11]]
    for y, x in np.ndindex(mask.shape):  # each says what the other does
        assert mask[y, x] == ("region:left:2:2" in [region.example for region in regions_at(levels, "left", x, y)])


@pytest.mark.parametrize(
    ("view", "x", "error", "message"),
    [
        ("left", WIDTH, InvalidQuery, f"x in 0..{WIDTH - 1}"),
        ("middle", 0, InvalidQuery, "a view with regions"),
        ("right", 0, NotFound, "a view of the lift's feature packs"),
        ("nowhere", 0, NotFound, "a view of the lift's feature packs"),
    ],
)
def test_a_pixel_without_regions_is_an_error(
    levels: Scene, view: str, x: int, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        regions_at(levels, view, x, 0)
