"""A whole lift by the card's code, on a card where there is one and in Triton's interpreter elsewhere."""

from __future__ import annotations

import weakref
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore import lift as lifting
from liftcore.device import CPU, Device
from liftcore.errors import Unavailable
from liftcore.io.input_files import input_files
from liftcore.io.lift_file import TENSORS, LiftResult
from liftcore.io.ply import read_splats
from liftcore.lift import Run, lift_sources, open_sources, planned
from liftcore.listener import NOBODY
from liftcore.plan import plan
from liftcore.plan.on_device import ROOM_SPARE
from liftcore.progress import silent
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.splats import Kernel
from liftcore.settings import LiftSettings
from liftcore.solve.accumulate import Geometry, accumulate
from liftcore.solve.totals import Totals
from liftcore.solve.view_weights import WeightStore
from liftcore.timings import Timings
from tests.backends import needs_triton

from .test_lift_equals_dense import write_scene

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from liftcore.raster.base import ViewRequest, ViewWeights

pytestmark = needs_triton

CARD = Device("cuda", torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu"))
SETTINGS = LiftSettings.of(certificate_rays=20, view_stride=2, robust_steps=1)  # two views of three


def lifted(scene: tuple[Path, Path, Path], device: Device, settings: LiftSettings = SETTINGS) -> LiftResult:
    sources = open_sources(scene[0], scene[1], [scene[2]], settings)
    run = Run(settings, 1, NOBODY, Timings(), device)
    return lift_sources(run, sources, input_files(scene[0], scene[1], [scene[2]]))


def test_lift_of_the_card_is_the_lift_of_the_processor(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, 3)
    ours, theirs = lifted(scene, CPU), lifted(scene, CARD)
    assert torch.equal(theirs.seen, ours.seen)
    torch.testing.assert_close(theirs.evidence, ours.evidence, rtol=1e-4, atol=1e-4)
    counted = ours.evidence > 1e-2
    assert counted.sum() > 10 and theirs.features.dtype == ours.features.dtype == torch.float16
    torch.testing.assert_close(theirs.features[counted], ours.features[counted], rtol=0, atol=2e-3)
    torch.testing.assert_close(theirs.agreement[counted], ours.agreement[counted], rtol=0, atol=1e-3)
    told = theirs.metadata.certificate
    assert told["device"] == CARD.facts() and "triton" in told["device"]["versions"]
    assert told["plan"]["device"] == "cuda" and told["plan"]["device_memory"]["least_bytes"] > 0
    assert told["row_sum_mean"] == pytest.approx(ours.metadata.certificate["row_sum_mean"], rel=1e-4)
    again = lifted(scene, CARD)
    for name in TENSORS:
        first, second = getattr(theirs, name), getattr(again, name)
        assert torch.equal(first.view(torch.uint8), second.view(torch.uint8)), name
    assert again.metadata.certificate == told


def test_tuples_of_labels_on_the_card_give_what_they_give_on_the_processor(tmp_path: Path) -> None:
    scene, settings = write_scene(tmp_path, 3), LiftSettings.of(certificate_rays=2)
    ours, theirs = lifted(scene, CPU, settings), lifted(scene, CARD, settings)
    assert theirs.metadata.certificate["weights_entries"] == ours.metadata.certificate["weights_entries"]
    counted = ours.evidence > 1e-2
    torch.testing.assert_close(theirs.features[counted], ours.features[counted], rtol=0, atol=2e-3)


def test_solution_has_the_memory_of_the_last_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, opened, told = write_scene(tmp_path, 3), [], []
    open_raster, closed_form = lifting.open_raster, lifting.closed_form

    def opening(*given: Any) -> Any:
        opened.append(open_raster(*given))
        return opened[-1]

    def solving(*given: Any) -> Any:
        told.append(opened[-1]._kept)
        return closed_form(*given)

    monkeypatch.setattr(lifting, "open_raster", opening)
    monkeypatch.setattr(lifting, "closed_form", solving)
    lifted(scene, CARD, LiftSettings.of(certificate_rays=2, view_stride=3))
    assert told == [None]


def geometry_of(scene: tuple[Path, Path, Path], store: WeightStore, raster: Any = None) -> Geometry:
    """ViewWeights on the processor."""
    sources = open_sources(scene[0], scene[1], [scene[2]], SETTINGS)
    seen = sources.splats.count, sources.cameras
    raster = raster or CpuRaster(sources.splats, threads=1)
    return accumulate(raster, seen, sources.packs, sources.views, SETTINGS, store, silent)


def test_sums_without_room_beside_the_weights_bring_them_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_scene(tmp_path, 3)
    with WeightStore() as plain:
        ours = geometry_of(scene, plain)
    add = Totals.add

    def crowded(self: Totals, *given: Any) -> None:
        if store.card_bytes > enough:
            raise torch.OutOfMemoryError
        add(self, *given)

    monkeypatch.setattr(Totals, "add", crowded)
    with WeightStore(card=(CPU.place, 1 << 40)) as store:
        enough = 0
        theirs = geometry_of(scene, store)
        assert store.card_bytes == 0 < store.bytes
    assert (theirs.denominators == ours.denominators).all() and (theirs.evidence == ours.evidence).all()
    with WeightStore(card=(CPU.place, 1 << 40)) as store, pytest.raises(torch.OutOfMemoryError):
        enough = -1  # nothing is left to bring home
        geometry_of(scene, store)


def test_a_views_weights_are_let_go_before_the_next_view_is_walked(tmp_path: Path) -> None:
    scene, gone = write_scene(tmp_path, 3), []

    class Watching:
        def iterate_views(self, looks: Iterable[ViewRequest]) -> Iterator[ViewWeights]:
            for walked in CpuRaster(read_splats(scene[0]), threads=1).iterate_views(looks):
                own = replace(walked, weights=replace(walked.weights))
                known = weakref.ref(own.weights)
                yield own
                del own
                gone.append(known() is None)

    with WeightStore(memory_limit=0) as store:  # all of them go to files
        geometry_of(scene, store, Watching())
    assert gone == [True, True]


def test_card_without_room_leaves_an_auto_lift_to_the_processor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from liftcore.raster.gpu import room
    from liftcore.raster.gpu.memory import least_raster_bytes, raster_bytes

    scene = write_scene(tmp_path, 3)
    sources = open_sources(scene[0], scene[1], [scene[2]], SETTINGS)
    made = planned(sources, SETTINGS, CARD)
    assert made.device == CARD and made.on_device is not None and made.on_device.fits
    assert any(CARD.name in line for line in made.lines())
    assert ROOM_SPARE == room.SPARE  # what the plan says of views is what the raster does
    assert made.on_device.view == made.on_device.least_view > 0 and made.kept_on_card == made.on_device.weights > 0
    large = (10_000_000, 1_600, 1_200, Kernel.GAUSSIAN_3D, 4)
    assert least_raster_bytes(*large) < raster_bytes(*large) / 5
    assert "device_memory" in made.facts() and "free_bytes" in made.on_device.today()
    scarce = replace(made.on_device, free=made.on_device.least - 1)
    monkeypatch.setattr(plan, "device_plan", lambda *_: scarce)
    left = planned(sources, SETTINGS, CARD)
    assert left.device == CPU and left.on_device is None
    assert "the processor lifts" in left.warnings[0]
    assert lifted(scene, CARD).metadata.certificate["device"] == CPU.facts()
    with pytest.raises(Unavailable, match="device"):
        planned(sources, SETTINGS.model_copy(update={"device": "cuda"}), CARD)
