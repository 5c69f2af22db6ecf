"""Measurements of a GPU: speed, agreement with the processor, accuracy, and gsplat beside it. ``make gpu`` runs it.

    python -m tests.benchmarks.gpu [--look] [--shared DIR]

``--look`` says only whether there is a card: a line, and status 2 where there is none. Status 1: two lifts differed.

gsplat (``pip install gsplat==1.5.3``, whose CUDA code is compiled at its first call) lifts as people do who have a
differentiable rasterizer: ``d/dX sum(render(X) B) = A^T B`` for a linear render, and ``A^T n`` of one channel more.
Its alphas are capped at 0.999 where ours are at 0.99, so the two agree but for splats that are nearly opaque.
"""

import sys
import tempfile
import time
from argparse import ArgumentParser, RawTextHelpFormatter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

import liftcore as lc
from liftcore.evaluate.bench import run_bench
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.lifting.files import lift_files
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.values.lift_file import TENSORS, save_lift
from tests.benchmarks.base import read_pack, scene_files, table_of
from tests.benchmarks.peers import (
    Answer,
    Work,
    answer_of,
    at_pixels,
    dense_target,
    room_work,
    side_by_side,
    splatlift_answer,
)
from tests.benchmarks.scenes import RoomSpec, write_bench_room
from tests.benchmarks.tabletop import CASES, tabletop

LARGE = RoomSpec(1_000_000, 300, (986, 728), 512)  # docs/results.md has it on an H100
SMALL = RoomSpec(200_000, 8, (640, 480), 512)  # to compare both devices on: the processor lifts it in seconds


def whole_lift(size: RoomSpec, device: Device, preset: str) -> tuple[list[dict[str, Any]], list[str]]:
    """Seconds of a lift from files to a file by stage, the second of two; the tensors that differ between the two."""
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        files = write_bench_room(Path(folder), size)
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


def views_of(device: Device, shared: Path) -> Iterator[dict[str, Any]]:
    """Run ``splatlift bench`` on the device for the room and for plush."""
    for scene in (None, shared / "plush"):
        if scene is None or scene.is_dir():
            size: dict[str, Any] = {
                "splats": LARGE.splats,
                "size": "x".join(map(str, LARGE.size)),
                "channels": LARGE.channels,
            }
            figures = run_bench(scene, device=device.kind, views=12, **size)
            for preset, row in figures["presets"].items():
                head = {"scene": figures["workload"], "splats": figures["splats"], "preset": preset}
                yield head | {f"{key}, ms a view": 1e3 * row[f"{key}_s_per_view"] for key in ("geometry", "solve")}


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


def beside_gsplat(size: RoomSpec, device: Device) -> dict[str, Any]:
    """Both lifts of the room in turns, from tensors to X: medians of three rounds after one that does not count."""
    rasterization, work_room = import_module("gsplat").rasterization, room_work(size)
    work = replace(
        work_room, views=tuple((camera, at_pixels(regions, camera)) for camera, regions in work_room.views)
    )
    peers = {
        "splatlift": partial(splatlift_answer, device=device),
        "gsplat": partial(gsplat, rasterization, device.place),
    }
    for rounds in (1, 3):
        a, b = side_by_side(size, work, peers, rounds)
    seconds = {"splatlift s": a["seconds"], "gsplat s": b["seconds"]}
    return seconds | {"times": b["times ours"], "cosine": b["cosine"]}


def gsplat(rasterization: Any, place: torch.device, work: Work) -> Answer:
    """A lift as a gradient through ``gsplat.rasterization``."""
    splats = work.splats
    means, quats = splats.means.to(place), splats.quats.to(place)
    scales, opacities = splats.log_scales.exp().to(place), torch.sigmoid(splats.opacity_logits).to(place)
    X = torch.zeros(splats.count, work.channels + 1, device=place, requires_grad=True)
    for camera, regions in work.views:
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pose = torch.tensor(camera.viewmat, dtype=torch.float32)
        rendered, _, _ = rasterization(
            means, quats, scales, opacities, X, pose[None].to(place), intrinsics.float()[None].to(place),
            camera.width, camera.height, packed=False,
        )  # fmt: skip
        (rendered[0] * dense_target(regions, place)).sum().backward()  # adds to what the views before left
    assert X.grad is not None
    return answer_of(X.grad.cpu())


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
    for preset in ("tikhonov", "default"):  # the latter has the stages of masks: objects, consensus, robust
        rows, differences = whole_lift(LARGE, device, preset)
        broken += differences
        title = f"A whole lift by {preset}, files to file ({LARGE}); tensors that differ when repeated"
        _section(f"{title}: {differences or 'none'}", rows)
    _section("A view", views_of(device, options.shared))
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        near = [{"scene": "room", **beside_processor(write_bench_room(Path(folder), SMALL), device)}]
    for name, pack in (("plush", "regions"), ("tabletop", "features")):
        if (options.shared / name).is_dir():
            near.append({"scene": name, **beside_processor(scene_files(options.shared / name, pack), device)})
    _section("Beside the processor", near)
    if (options.shared / "tabletop").is_dir():
        _section("Accuracy on tabletop", tabletop_rows(options.shared / "tabletop", device))
    try:
        _section(f"gsplat by autograd ({SMALL})", [beside_gsplat(SMALL, device)])
    except (RuntimeError, OSError, ImportError, AttributeError, TypeError) as error:
        # What its compiler, its version or the card's memory says; a figure is not put in its place.
        print(f"gsplat did not run: {type(error).__name__}: {' '.join(str(error).split())[:300]}")
    return 1 if broken else 0


def _section(title: str, rows: Any) -> None:
    print(f"\n## {title}\n\n{table_of(rows)}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
