"""Views in work at the same time: in order, ended by the first error, awaited when nobody wants the rest."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import pytest
import torch

from liftcore.raster.base import ViewRequest
from liftcore.raster.cpu.raster import side_by_side, views_at_a_time
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.views import DENSE_ROWS, FeatureGrid
from tests.scenes import random_camera, random_regions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from liftcore.raster.base import Raster


class Staged:
    """A raster whose answers are the camera's names; what happens is noted, and a view may wait for it."""

    def __init__(self, waits: dict[str, str] | None = None) -> None:
        self.happened: list[str] = []
        self.forgotten = False
        self._waits = waits or {}
        self._changed = threading.Condition()

    def note(self, what: str) -> None:
        with self._changed:
            self.happened.append(what)
            self._changed.notify_all()

    def region_weights(self, camera: Any, *_: Any) -> str:
        self.note(f"{camera.name} begun")
        with self._changed:
            awaited = self._waits.get(camera.name)
            assert self._changed.wait_for(lambda: awaited is None or awaited in self.happened, timeout=60)
        self.note(f"{camera.name} ended")
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


def beside(raster: Staged, count: int) -> list[Raster]:
    return [cast("Raster", raster)] * count


def test_views_come_in_their_order_whichever_ends_first() -> None:
    names = [f"v{k}" for k in range(9)]
    raster = Staged({"v0": "v2 ended", "v1": "v2 ended"})  # all three are in work at the same time, or none ends
    assert [walked.weights for walked in side_by_side(beside(raster, 3), looks(*names))] == names
    assert raster.forgotten  # no view is kept
    assert [views_at_a_time(threads) for threads in (1, 2, 64)] == [1, 2, 4]


def test_of_dense_maps_one_is_in_work_wherever_they_come_among_the_views() -> None:
    raster = Staged({"d0": "v1 begun", "d1": "v1 begun"})  # which waits for neither
    dense = FeatureGrid(torch.zeros(1, DENSE_ROWS + 1, 1))
    requests = [replace(request, observation=dense) for request in looks("d0", "d1")]
    answers = side_by_side(beside(raster, 3), [*requests, *looks("v1")])
    assert [answer.weights for answer in answers] == ["d0", "d1", "v1"]
    begins, ends = ([raster.happened.index(f"d{k} {event}") for k in range(2)] for event in ("begun", "ended"))
    assert min(ends) < max(begins)


def test_an_error_comes_in_the_place_of_its_view() -> None:
    found = side_by_side(beside(Staged(), 2), looks("v0", "v1", "broken", "v3"))
    assert [next(found).weights, next(found).weights] == ["v0", "v1"]
    with pytest.raises(ValueError, match="broken"):
        next(found)


def test_closing_awaits_the_views_in_work_and_begins_no_other() -> None:
    raster = Staged({"v0": "v1 begun", "v1": "released"})
    found = side_by_side(beside(raster, 2), looks(*(f"v{k}" for k in range(50))))
    next(found)
    threading.Timer(0.05, raster.note, ["released"]).start()
    found.close()
    after = list(raster.happened)
    assert "v1 ended" in after
    assert sum(what.endswith("begun") for what in after) == sum(what.endswith("ended") for what in after) <= 3
