"""The figures of a card: whole lifts, and how near the processor's answer they are."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.io.lift_file import TENSORS, save_lift
from liftcore.lift import lift
from liftcore.raster.base import CompositingParams, RegionWeights, Weighting
from liftcore.settings import LiftSettings
from tests.benchmarks.gpu.room_files import write_room
from tests.benchmarks.tabletop import CASES, Tabletop

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.device import Device
    from liftcore.io.lift_file import LiftResult
    from tests.benchmarks.gpu.room_files import RoomSize

SEEN = 0.5  # evidence from which a splat counts


@dataclass(frozen=True)
class Agreement:
    """Two lifts of the same inputs beside each other, over the splats with evidence over SEEN in the first."""

    splats: int
    least_cosine: float
    largest_difference: float  # of a channel, over the largest value of any
    largest_evidence_difference: float  # relative
    only_one_sees: int  # splats of the scene that one lift has a feature for, and the other has not


def whole_lift(size: RoomSize, device: Device) -> dict[str, Any]:
    """Seconds of a lift from files to a file, by stage, after one of the same scene that is not counted.

    The first lift compiles the card's kernels, and leaves the files in the memory of the machine. The second must be
    the same to the bit: ``differing`` names the tensors that are not.
    """
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        paths = write_room(Path(folder), size)
        settings, out = LiftSettings.of(device=device.kind), Path(folder) / "room.lift.safetensors"
        first = lift(paths[0], paths[1], [paths[2]], settings)
        _forget_peak(device)
        start = time.perf_counter()
        made = lift(paths[0], paths[1], [paths[2]], settings)
        lifted = time.perf_counter()
        save_lift(made, out)
        saved = time.perf_counter()
    told = made.metadata.certificate
    return {
        "total_s": saved - start,
        "stages_s": {**made.metadata.timings, "save": saved - lifted},
        "geometry_ms_a_view": 1e3 * made.metadata.timings["geometry"] / len(made.metadata.views),
        "planned": told["plan"]["device_memory"],
        "peak_device_bytes": peak_bytes(device),
        "device": told["device"],
        "differing": differing(first, made),
    }


def differing(one: LiftResult, other: LiftResult) -> list[str]:
    """The tensors of two lifts that are not the same to the bit."""
    pairs = {name: (getattr(one, name), getattr(other, name)) for name in TENSORS}
    return [name for name, (first, second) in pairs.items() if not _same_bits(first, second)]


@dataclass(frozen=True)
class Pieces:
    """A view walked in one piece, and again with little memory."""

    differing: list[str]  # parts of its region weights that are not the same to the bit
    whole: int  # bytes that the plan says of the one piece
    free: int  # bytes that the other walk was given: a tenth of that, or what the smallest pieces take
    peak: int | None  # bytes that it took at its peak by torch's count; None off a card

    @property
    def broken(self) -> list[str]:
        """What is not as promised, in words for people."""
        over = self.peak is not None and self.peak > self.free
        return self.differing + (["the memory of a view in strips, which is more than it was given"] if over else [])


def view_in_pieces(size: RoomSize, device: Device) -> Pieces:
    """CompositingParams a view in one piece and with little memory."""
    from liftcore.raster.gpu.memory import least_raster_bytes, raster_bytes
    from liftcore.raster.gpu.raster import GpuRaster

    splats, camera = room_splats(size.splats), room_cameras(size.views, size.width, size.height)[0]
    regions, shape = room_regions(camera, 0, size.levels, size.channels), (size.width, size.height)
    sizes = [find(size.splats, *shape, splats.kernel, size.levels) for find in (raster_bytes, least_raster_bytes)]
    least = max(sizes[0] // 10, sizes[1])

    def walked(free: int | None) -> tuple[RegionWeights, int | None]:
        before = _forget_peak(device)
        made = GpuRaster(splats, device.place, free).region_weights(camera, regions, CompositingParams(), Weighting())
        peak = peak_bytes(device)
        return made, None if peak is None else peak - before

    (whole, _), (cut, peak) = walked(None), walked(least)
    names = [field.name for field in fields(RegionWeights)]
    parts = [name for name in names if not _same_bits(getattr(whole, name), getattr(cut, name))]
    return Pieces(parts, sizes[0], least, peak)


def _forget_peak(device: Device) -> int:
    """Forget what `peak_bytes` tells; the bytes that are taken now."""
    if device.place.type != "cuda":
        return 0
    torch.cuda.reset_peak_memory_stats(device.place)
    return torch.cuda.memory_allocated(device.place)


def _same_bits(one: Tensor | None, other: Tensor | None) -> bool:
    if one is None or other is None:
        return one is other
    alike = one.dtype == other.dtype and one.shape == other.shape
    return alike and torch.equal(one.contiguous().view(torch.uint8), other.contiguous().view(torch.uint8))


def peak_bytes(device: Device) -> int | None:
    """The most that torch has taken on the card since it was last asked to forget; None off a card."""
    return torch.cuda.max_memory_allocated(device.place) if device.place.type == "cuda" else None


def both_ways(paths: Sequence[Path], device: Device, **values: Any) -> Agreement:
    """A scene lifted on the processor and on the device."""
    lifts = [
        lift(paths[0], paths[1], list(paths[2:]), LiftSettings.of(device=kind, certificate_rays=0, **values))
        for kind in ("cpu", device.kind)
    ]
    return agreement(lifts[0], lifts[1])


def agreement(one: LiftResult, other: LiftResult) -> Agreement:
    """How near the other is to the one."""
    counted = one.evidence > SEEN
    first, second = one.features[counted].float(), other.features[counted].float()
    evidence = one.evidence[counted]
    return Agreement(
        splats=int(counted.sum()),
        least_cosine=_least(torch.nn.functional.cosine_similarity(first, second, dim=1)),
        largest_difference=_most((first - second).abs()) / max(_most(first.abs()), 1e-30),
        largest_evidence_difference=_most((evidence - other.evidence[counted]).abs() / evidence),
        only_one_sees=int((one.seen != other.seen).sum()),
    )


def room_both_ways(size: RoomSize, device: Device) -> Agreement:
    """The same of a synthetic room."""
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        return both_ways(write_room(Path(folder), size), device)


def tabletop_accuracy(folder: Path, device: Device) -> list[dict[str, Any]]:
    """Splat accuracy and mIoU of all of the scene's features, lifted on the device and judged as on the processor."""
    scene, rows = Tabletop(folder), []
    for case in CASES:
        settings = case.settings.model_copy(update={"device": device.kind})
        paths = [folder / name for name in ("point_cloud.ply", "cameras.json", f"{case.pack}.safetensors")]
        start = time.perf_counter()
        features = lift(paths[0], paths[1], paths[2:], settings).features
        figures = scene.judge(features, settings, time.perf_counter() - start)
        rows.append({"name": case.name, "base": case.accuracy, "base_miou": case.miou, "figures": figures})
    return rows


def _least(values: Tensor) -> float:
    return float(values.min()) if values.numel() else 1.0


def _most(values: Tensor) -> float:
    return float(values.max()) if values.numel() else 0.0
