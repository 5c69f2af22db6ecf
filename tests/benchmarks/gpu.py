"""Measurements of a GPU: speed, agreement with the processor, and accuracy. ``make gpu`` runs it.

    python -m tests.benchmarks.gpu [--look] [--shared DIR]

``--look`` says only whether there is a card: a line, and status 2 where there is none. Status 1: two lifts differed.
"""

import statistics
import sys
import tempfile
import time
from argparse import ArgumentParser, RawTextHelpFormatter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

import liftcore as lc
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.lifting.files import lift_files
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.values.lift_file import TENSORS, save_lift
from liftcore.values.settings import Preset
from tests.benchmarks.base import read_pack, read_scene, scene_files, table_of
from tests.benchmarks.scenes import RoomSpec, write_room
from tests.benchmarks.tabletop import CASES, tabletop

LARGE = RoomSpec(1_000_000, 300, (986, 728), 512)  # docs/results.md has it on an H100
SMALL = RoomSpec(200_000, 8, (640, 480), 512)  # to compare both devices on: the processor lifts it in seconds


def whole_lift(size: RoomSpec, device: Device, preset: str) -> tuple[list[dict[str, Any]], list[str]]:
    """Seconds of a lift from files to a file by stage, the second of two; the tensors that differ between the two."""
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        write_room(Path(folder), size)
        files = scene_files(Path(folder))
        settings, lifts = lc.LiftSettings.of(preset=preset, device=device.kind), []
        start = 0.0
        for _ in range(2):  # the first compiles kernels, and leaves the files in the memory of the machine
            if device.place.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device.place)
            start = time.perf_counter()
            lifts.append(lift_files(files[0], files[1], files[2:], settings))
        lifted = time.perf_counter()
        save_lift(lifts[1], Path(folder) / "lift.safetensors")
        saved = time.perf_counter()
    timings = lifts[1].metadata.timings
    rows = [{"stage": name, "seconds": value} for name, value in timings.items()]
    rows += [{"stage": "save", "seconds": saved - lifted}, {"stage": "total", "seconds": saved - start}]
    rows += [{"stage": "geometry, a view", "seconds": timings["geometry"] / size.views}]
    if device.place.type == "cuda":
        peak = torch.cuda.max_memory_allocated(device.place) / 2**20
        rows.append({"stage": f"peak on the card: {peak:.0f} MiB", "seconds": None})
    return rows, differing(*lifts)


def differing(a: lc.LiftResult, b: lc.LiftResult) -> list[str]:
    """The tensors of two lifts that are not the same to the bit."""

    def bits(lifted: lc.LiftResult, name: str) -> Tensor:
        tensor = getattr(lifted, name)
        return torch.empty(0) if tensor is None else tensor.contiguous().view(torch.uint8)

    return [name for name in TENSORS if not torch.equal(bits(a, name), bits(b, name))]


def views_of(device: Device, plush: Path) -> Iterator[dict[str, Any]]:
    """Milliseconds a view of plush by every preset: medians of three lifts after one that compiles."""
    splats, cameras = read_scene(plush)
    views = read_pack(plush, "regions")
    for preset in Preset:
        lifts = [lc.lift(splats, cameras, views, preset, device=device.kind).metadata for _ in range(4)][1:]
        figures = {
            f"{stage}, ms a view": 1e3 * statistics.median(each.timings[stage] for each in lifts) / len(views)
            for stage in ("geometry", "solve")
        }
        yield {"preset": preset, **figures}


def beside_processor(files: Sequence[Path], device: Device) -> dict[str, Any]:
    """The same lift on both, over splats with total weight over a half. A ray at a cut-off may fall either way."""
    settings = (lc.LiftSettings.of(diagnostic_rays=0, device=kind) for kind in ("cpu", device.kind))
    a, b = (lift_files(files[0], files[1], files[2:], each).to(CPU.place) for each in settings)
    has_weight = a.total_weight > 0.5
    first, second = a.features[has_weight].float(), b.features[has_weight].float()
    total_weight = a.total_weight[has_weight]
    return {
        "splats": int(has_weight.sum()),
        "least cosine": f"{float(cosine_similarity(first, second, dim=1).min()):.6f}",
        "largest difference / largest value": float((first - second).abs().max() / first.abs().max()),
        "total weight, relative": float(((total_weight - b.total_weight[has_weight]).abs() / total_weight).max()),
        "seen by one": int((a.has_feature != b.has_feature).sum()),
    }


def tabletop_rows(folder: Path, device: Device) -> Iterator[dict[str, Any]]:
    """Accuracy of all of the scene's features, lifted on the device and judged on the processor."""
    scene = tabletop(folder)
    for case in CASES:
        figures = scene.evaluate(scene.lift(read_pack(folder, case.pack), **case.values, device=device.kind))
        base = {"README accuracy": case.accuracy, "README mIoU": case.miou}
        yield {"features, weights": case.name, "accuracy": figures.accuracy, "mIoU": figures.miou, **base}


def main() -> int:
    """Print every table; the exit status."""
    names = {"prog": "python -m tests.benchmarks.gpu", "description": __doc__}
    parser = ArgumentParser(**names, formatter_class=RawTextHelpFormatter)
    parser.add_argument("--look", action="store_true", help="only say whether there is a card")
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"), help="of plush and tabletop")
    options = parser.parse_args()
    try:
        device = choose_device("cuda")
    except lc.SplatliftError as error:
        print(f"no figures: {error}", file=sys.stderr)
        return 2
    print(f"{device.name}, {(device.free_bytes() or 0) / 2**30:.1f} GiB free; {machine_line(hardware())}")
    if options.look:
        return 0
    broken = list[str]()
    for preset in ("tikhonov", "default"):  # the latter has the stages of masks: objects, consensus, reweight
        rows, differences = whole_lift(LARGE, device, preset)
        broken += differences
        title = f"A whole lift by {preset}, files to file ({LARGE}); tensors that differ when repeated"
        _section(f"{title}: {differences or 'none'}", rows)
    if (options.shared / "plush").is_dir():
        _section("A view of plush", views_of(device, options.shared / "plush"))
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        write_room(Path(folder), SMALL)
        near = [{"scene": "room", **beside_processor(scene_files(Path(folder)), device)}]
    for name, pack in (("plush", "regions"), ("tabletop", "features")):
        if (options.shared / name).is_dir():
            near.append({"scene": name, **beside_processor(scene_files(options.shared / name, pack), device)})
    _section("Beside the processor", near)
    if (options.shared / "tabletop").is_dir():
        _section("Accuracy on tabletop", tabletop_rows(options.shared / "tabletop", device))
    return 1 if broken else 0


def _section(title: str, rows: Any) -> None:
    print(f"\n## {title}\n\n{table_of(rows)}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
