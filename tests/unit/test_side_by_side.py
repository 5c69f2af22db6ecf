"""Views in work at the same time: in order, ended by the first error, awaited when nobody wants the rest."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, cast

import pytest
import torch

from liftcore.raster.base import CompositingParams, ViewRequest, Weighting
from liftcore.raster.cpu.raster import side_by_side, views_at_a_time
from tests.scenes import random_camera, random_regions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from liftcore.raster.base import Raster


class Slow:
    """A raster whose answers are the camera's names; the earlier a view, the longer it takes."""

    def __init__(self) -> None:
        self.at_work, self.most, self.walked = 0, 0, []
        self.forgotten = False
        self._lock = threading.Lock()

    def region_weights(self, camera: Any, *_: Any) -> str:
        with self._lock:
            self.at_work += 1
            self.most = max(self.most, self.at_work)
        time.sleep(0.05 if camera.name == "v0" else 0.01)
        with self._lock:
            self.at_work -= 1
            self.walked.append(camera.name)
        if camera.name == "broken":
            raise ValueError(camera.name)
        return camera.name

    def forget(self) -> None:
        self.forgotten = True


def looks(*names: str) -> Iterator[ViewRequest]:
    nowhere = torch.empty(0, 2, dtype=torch.int32)
    return (
        ViewRequest(random_camera(1, name=name), random_regions(1), CompositingParams(), Weighting(), nowhere)
        for name in names
    )


def beside(raster: Slow, count: int) -> list[Raster]:
    return [cast("Raster", raster)] * count


def test_views_come_in_their_order_and_as_many_are_in_work_as_there_are_rasters() -> None:
    raster, names = Slow(), [f"v{k}" for k in range(9)]
    assert [walked.weights for walked in side_by_side(beside(raster, 3), looks(*names))] == names
    assert raster.most == 3


def test_an_error_comes_in_the_place_of_its_view() -> None:
    found = side_by_side(beside(Slow(), 2), looks("v0", "v1", "broken", "v3"))
    assert [next(found).weights, next(found).weights] == ["v0", "v1"]
    with pytest.raises(ValueError, match="broken"):
        next(found)


def test_closing_awaits_the_views_in_work_and_begins_no_other() -> None:
    raster = Slow()
    found = side_by_side(beside(raster, 2), looks(*(f"v{k}" for k in range(50))))
    next(found)
    found.close()
    assert raster.at_work == 0
    assert len(raster.walked) <= 4


def test_no_view_is_kept_when_the_walks_end() -> None:
    rasters = [Slow() for _ in range(3)]
    assert len(list(side_by_side([cast("Raster", raster) for raster in rasters], looks("v0", "v1")))) == 2
    assert all(raster.forgotten for raster in rasters)


@pytest.mark.parametrize(("threads", "views"), [(1, 1), (2, 2), (64, 4)])
def test_many_threads_share_a_few_views(threads: int, views: int) -> None:
    assert views_at_a_time(threads) == views
