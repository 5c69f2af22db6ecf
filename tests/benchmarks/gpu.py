"""What a card does: speed, agreement with the processor, accuracy, and gsplat beside it. ``make gpu`` runs it.

    python -m tests.benchmarks.gpu [--look] [--shared DIR]

``--look`` says only whether there is a card: a line, and status 2 where there is none. Status 1: two lifts differed.

gsplat (``pip install gsplat==1.5.3``, whose CUDA code is compiled at its first call) lifts as people do who have a
differentiable rasterizer: ``d/dX sum(render(X) B) = A^T B`` for a linear render, and ``A^T n`` of one channel more.
Its alphas are capped at 0.999 where ours are at 0.99, so the two agree but for splats that are nearly opaque.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

from liftcore.device import Device, choose_device
from liftcore.errors import SplatliftError
from liftcore.evaluate.bench import run_bench, weigh_regions
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.features.views import Regions, cells_under
from liftcore.io.lift_file import TENSORS, save_lift
from liftcore.io.scene_files import lift_files as lift_paths
from liftcore.raster import open_raster
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.result import LiftResult
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings
from liftcore.solve.closed_form import solve
from tests.benchmarks.base import lift_files, scene_files, table_of
from tests.benchmarks.scenes import Room, write_bench_room
from tests.benchmarks.tabletop import CASES, Tabletop

LARGE = Room(1_000_000, 300, (986, 728), 512)  # an H100 is to lift it in 5 s and to walk a view in 10 ms
SMALL = Room(200_000, 8, (640, 480), 512)  # to compare both devices on: the processor lifts it in seconds
Views = list[tuple[Camera, Regions]]


def whole_lift(size: Room, device: Device) -> tuple[list[dict[str, Any]], list[str]]:
    """Seconds of a lift from files to a file by stage, the second of two; the tensors that differ between the two."""
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        files = write_bench_room(Path(folder), size)
        settings, made = LiftSettings.of(preset="tikhonov", device=device.kind), []
        start = 0.0
        for _ in range(2):  # the first compiles kernels, and leaves the files in the memory of the machine
            if device.place.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device.place)
            start = time.perf_counter()
            made.append(lift_paths(files[0], files[1], [files[2]], settings))
        lifted = time.perf_counter()
        save_lift(made[1], Path(folder) / "lift.safetensors")
        saved = time.perf_counter()
    timings = made[1].metadata.timings
    rows = [{"stage": name, "seconds": value} for name, value in timings.items()]
    rows += [{"stage": "save", "seconds": saved - lifted}, {"stage": "total", "seconds": saved - start}]
    rows += [{"stage": "geometry, a view", "seconds": timings["geometry"] / size.views}]
    if device.place.type == "cuda":
        peak = torch.cuda.max_memory_allocated(device.place) / 2**20
        rows.append({"stage": f"peak on the card: {peak:.0f} MiB", "seconds": None})
    return rows, differing(*made)


def differing(one: LiftResult, other: LiftResult) -> list[str]:
    """The tensors of two lifts that are not the same to the bit."""

    def bits(lifted: LiftResult, name: str) -> Tensor:
        tensor = getattr(lifted, name)
        return torch.empty(0) if tensor is None else tensor.contiguous().view(torch.uint8)

    return [name for name in TENSORS if not torch.equal(bits(one, name), bits(other, name))]


def views_of(device: Device, shared: Path) -> Iterator[dict[str, Any]]:
    """What ``splatlift bench --device cuda`` says of the room and of plush."""
    for scene in (None, shared / "plush"):
        if scene is None or scene.is_dir():
            size = {"splats": LARGE.splats, "size": "x".join(map(str, LARGE.size)), "channels": LARGE.channels}
            found = run_bench({"device": device.kind, "scene": scene, "views": 12, **size})
            for preset, row in found["presets"].items():
                head = {"scene": found["workload"], "splats": found["splats"], "preset": preset}
                yield head | {f"{key}, ms a view": 1e3 * row[f"{key}_s_per_view"] for key in ("geometry", "solve")}


def beside_processor(files: Sequence[Path], device: Device) -> dict[str, Any]:
    """The same lift on both, over splats with evidence over a half. A ray at a cut-off may fall either way."""
    one, other = (lift_files(files, device=kind) for kind in ("cpu", device.kind))
    counted = one.evidence > 0.5
    first, second = one.features[counted].float(), other.features[counted].float()
    evidence = one.evidence[counted]
    return {
        "splats": int(counted.sum()),
        "least cosine": f"{float(cosine_similarity(first, second, dim=1).min()):.6f}",
        "largest difference / largest value": float((first - second).abs().max() / first.abs().max()),
        "evidence, relative": float(((evidence - other.evidence[counted]).abs() / evidence).max()),
        "seen by one": int((one.seen != other.seen).sum()),
    }


def tabletop_rows(folder: Path, device: Device) -> Iterator[dict[str, Any]]:
    """Accuracy of all of the scene's features, lifted on the device and judged on the processor."""
    scene = Tabletop(folder)
    for case in CASES:
        features = lift_files(scene_files(folder, case.pack), **case.values, device=device.kind).features
        found = scene.judge(features, case.settings)
        base = {"README accuracy": case.accuracy, "README mIoU": case.miou}
        yield {"features, weights": case.name, "accuracy": found.accuracy, "mIoU": found.miou, **base}


def beside_gsplat(size: Room, device: Device) -> dict[str, Any]:
    """Both lifts of the room in turns, from tensors to X: medians of three rounds after one that does not count."""
    rasterization, splats = import_module("gsplat").rasterization, room_splats(size.splats)
    views = [(camera, at_pixels(room_regions(camera, k, 4, size.channels), camera))
             for k, camera in enumerate(room_cameras(size.views, *size.size))]  # fmt: skip
    seconds: list[tuple[float, float]] = []
    ours = theirs = (torch.zeros(0), torch.zeros(0))
    for _ in range(4):
        start = time.perf_counter()
        ours = lift_ours(splats, views, device)
        middle = time.perf_counter()
        theirs = lift_theirs(rasterization, splats, views, device.place)
        seconds.append((middle - start, time.perf_counter() - middle))
    medians = [statistics.median(column) for column in zip(*seconds[1:], strict=True)]
    cosines = cosine_similarity(ours[0], theirs[0], dim=1).double()
    cosine = float((cosines * ours[1]).sum() / ours[1].sum())
    return {"splatlift s": medians[0], "gsplat s": medians[1], "times": medians[1] / medians[0], "cosine": cosine}


def lift_ours(splats: Splats, views: Views, device: Device) -> tuple[Tensor, Tensor]:
    """X [P, F] f32 and the totals [P] f64 of plain weights, by region weights and the closed form."""
    looking = CompositingParams(), Weighting()
    W, codebook = weigh_regions(open_raster(splats, device), views, looking, splats.count)
    X = solve(W, codebook, torch.float32, means=splats.means, device=device).features
    return X, W.row_sums().cpu()


def lift_theirs(rasterization: Any, splats: Splats, views: Views, place: torch.device) -> tuple[Tensor, Tensor]:
    """The same as a gradient through ``gsplat.rasterization``."""
    means, quats = splats.means.to(place), splats.quats.to(place)
    scales, opacities = splats.log_scales.exp().to(place), torch.sigmoid(splats.opacity_logits).to(place)
    channels = views[0][1].codebook.shape[1]
    X = torch.zeros(splats.count, channels + 1, device=place, requires_grad=True)
    for camera, regions in views:
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pose = torch.tensor(camera.viewmat, dtype=torch.float32)
        rendered, _, _ = rasterization(
            means, quats, scales, opacities, X, pose[None].to(place), intrinsics.float()[None].to(place),
            camera.width, camera.height, packed=False,
        )  # fmt: skip
        (rendered[0] * dense_target(regions, place)).sum().backward()  # adds to what the views before left
    assert X.grad is not None
    totals = X.grad[:, -1:]
    features = torch.where(totals > 0, X.grad[:, :-1] / totals.clamp_min(1e-30), 0.0)
    return features.cpu(), totals[:, 0].double().cpu()


def dense_target(regions: Regions, place: torch.device) -> Tensor:
    """B and n of every pixel, [H, W, F + 1] f32: the sum of the codebook rows of its labels, and their number."""
    book = regions.codebook.to(place).float()
    book = torch.cat([book, torch.ones(book.shape[0], 1, device=place)], dim=1)
    book = torch.cat([book, torch.zeros(1, book.shape[1], device=place)])  # the last is what no label reads
    labels = regions.labels.to(place).long()
    target = torch.zeros(*labels.shape[1:], book.shape[1], device=place)
    for level in torch.where(labels < 0, book.shape[0] - 1, labels):
        target += book[level]
    return target


def at_pixels(regions: Regions, camera: Camera) -> Regions:
    """The regions with a label a pixel."""
    height, width = regions.labels.shape[1:]
    y = cells_under(torch.arange(camera.height), camera.height, height)
    x = cells_under(torch.arange(camera.width), camera.width, width)
    return Regions(regions.labels[:, y][:, :, x].contiguous(), regions.codebook)


def main() -> int:
    """Print every table; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.gpu", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--look", action="store_true", help="only say whether there is a card")
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"), help="of plush and tabletop")
    options = parser.parse_args()
    try:
        device = choose_device("cuda")
    except SplatliftError as error:
        print(f"no figures: {error}", file=sys.stderr)
        return 2
    print(f"{device.name}, {(device.free_bytes() or 0) / 2**30:.1f} GiB free; {machine_line(hardware())}")
    if options.look:
        return 0
    rows, broken = whole_lift(LARGE, device)
    _section(f"A whole lift, files to file ({LARGE}); tensors that differ when repeated: {broken or 'none'}", rows)
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
