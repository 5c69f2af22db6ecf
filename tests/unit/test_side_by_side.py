"""Views rasterized concurrently: results in order, stopped by the first error, awaited when the iterator closes."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import torch

from liftcore.raster.base import ViewRequest
from liftcore.raster.cpu.raster import side_by_side
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.views import DENSE_ROWS, FeatureGrid
from tests.scenes import random_camera, random_regions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from liftcore.raster.base import Raster


class Staged:
    """A raster that returns names of cameras and records its events; a view may wait for an event."""

    def __init__(self, waits: dict[str, str] | None = None) -> None:
        self.events: list[str] = []
        self._waits = waits or {}
        self._condition = threading.Condition()

    def note(self, event: str) -> None:
        with self._condition:
            self.events.append(event)
            self._condition.notify_all()

    def region_weights(self, camera: Any, *_: Any) -> str:
        self.note(f"{camera.name} begun")
        with self._condition:
            awaited = self._waits.get(camera.name)
            assert self._condition.wait_for(lambda: awaited is None or awaited in self.events, timeout=60)
        self.note(f"{camera.name} ended")
        if camera.name == "broken":
            raise ValueError(camera.name)
        return camera.name

    def ray_rows(self, *_: Any) -> None:
        """Return nothing."""

    def forget(self) -> None:
        """Have no view to forget."""


def requests_of(*names: str) -> Iterator[ViewRequest]:
    no_pixels = torch.empty(0, 2, dtype=torch.int32)
    return (
        ViewRequest(random_camera(1, name=name), random_regions(1), CompositingParams(), Weighting(), no_pixels)
        for name in names
    )


def copies_of(raster: Staged, count: int) -> list[Raster]:
    return [cast("Raster", raster)] * count


def test_of_dense_maps_one_is_in_work_wherever_they_come_among_the_views() -> None:
    raster = Staged({"d0": "v1 begun", "d1": "v1 begun"})  # which waits for neither
    dense = FeatureGrid(torch.zeros(1, DENSE_ROWS + 1, 1))
    requests = [replace(request, observation=dense) for request in requests_of("d0", "d1")]
    answers = side_by_side(copies_of(raster, 3), [*requests, *requests_of("v1")])
    assert [answer.weights for answer in answers] == ["d0", "d1", "v1"]
    begins, ends = ([raster.events.index(f"d{k} {event}") for k in range(2)] for event in ("begun", "ended"))
    assert min(ends) < max(begins)


def test_closing_awaits_the_views_in_work_and_begins_no_other() -> None:
    raster = Staged({"v0": "v1 begun", "v1": "released"})
    answers = side_by_side(copies_of(raster, 2), requests_of(*(f"v{k}" for k in range(50))))
    next(answers)
    threading.Timer(0.05, raster.note, ["released"]).start()
    answers.close()
    after = list(raster.events)
    assert "v1 ended" in after
    assert sum(event.endswith("begun") for event in after) == sum(event.endswith("ended") for event in after) <= 3
