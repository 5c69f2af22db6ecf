"""Measurements of a GPU: speed, agreement with the processor, accuracy, and gsplat beside it. ``make gpu`` runs it.

    python -m tests.benchmarks.gpu [--look] [--shared DIR]

``--look`` says only whether there is a card: a line, and status 2 where there is none. Status 1: two lifts differed.

gsplat (``pip install gsplat==1.5.3``, whose CUDA code is compiled at its first call) lifts as people do who have a
differentiable rasterizer: ``d/dX sum(render(X) B) = A^T B`` for a linear render, and ``A^T n`` of one channel more.
Its alphas are capped at 0.999 where ours are at 0.99, so the two agree but for splats that are nearly opaque.
"""

import statistics
import sys
import tempfile
import time
from argparse import ArgumentParser, RawTextHelpFormatter
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity, embedding_bag

import liftcore as lc
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.lifting.files import lift_files
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.values.lift_file import TENSORS, save_lift
from liftcore.values.settings import Preset
from liftcore.values.views import cells_under
from tests.benchmarks.base import read_pack, read_scene, scene_files, table_of
from tests.benchmarks.room import room_cameras, room_regions, room_splats
from tests.benchmarks.scenes import RoomSpec, write_voronoi_room
from tests.benchmarks.tabletop import CASES, tabletop

LARGE = RoomSpec(1_000_000, 300, (986, 728), 512)  # docs/results.md has it on an H100
SMALL = RoomSpec(200_000, 8, (640, 480), 512)  # to compare both devices on: the processor lifts it in seconds


def whole_lift(size: RoomSpec, device: Device, preset: str) -> tuple[list[dict[str, Any]], list[str]]:
    """Seconds of a lift from files to a file by stage, the second of two; the tensors that differ between the two."""
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        files = write_voronoi_room(Path(folder), size)
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


Views = Sequence[tuple[lc.Camera, lc.Regions]]


def beside_gsplat(size: RoomSpec, device: Device) -> dict[str, Any]:
    """Both lifts of the room in turns, from tensors to X: medians of three rounds after one that does not count.

    The cosine of a splat's two features is a mean by total weight.
    """
    rasterization, splats = import_module("gsplat").rasterization, room_splats(size.splats)
    cameras = room_cameras(size.views, *size.size)
    views = [
        (camera, at_pixels(room_regions(camera, k, 4, size.channels), camera)) for k, camera in enumerate(cameras)
    ]
    seconds: dict[str, list[float]] = {"splatlift": [], "gsplat": []}
    features, expected, total_weight = torch.empty(0), torch.empty(0), torch.empty(0)
    for _ in range(4):
        start = time.perf_counter()
        features, total_weight = splatlift_features(splats, views, device)
        middle = time.perf_counter()
        expected = gsplat_features(rasterization, device.place, splats, views)
        seconds["splatlift"].append(middle - start)
        seconds["gsplat"].append(time.perf_counter() - middle)
    own_s, gsplat_s = (statistics.median(rounds[1:]) for rounds in seconds.values())
    cosines = cosine_similarity(features, expected, dim=1).double()
    cosine = float((cosines * total_weight).sum() / total_weight.sum())
    return {"splatlift s": own_s, "gsplat s": gsplat_s, "times": gsplat_s / own_s, "cosine": cosine}


def at_pixels(regions: lc.Regions, camera: lc.Camera) -> lc.Regions:
    """The regions with a label a pixel."""
    rows, columns = regions.labels.shape[1:]
    y = cells_under(torch.arange(camera.height), camera.height, rows)
    x = cells_under(torch.arange(camera.width), camera.width, columns)
    return lc.Regions(regions.labels[:, y][:, :, x].contiguous(), regions.codebook)


def splatlift_features(splats: lc.Splats, views: Views, device: Device) -> tuple[Tensor, Tensor]:
    """X [P, F] f32 and total weights [P] f64, by ``row-sum``."""
    cameras = {camera.name: camera for camera, _ in views}
    observed = {camera.name: regions for camera, regions in views}
    settings = {"dtype": "float32", "diagnostic_rays": 0, "device": device.kind}
    lifted = lc.lift(splats, cameras, observed, "row-sum", **settings).to(CPU.place)
    return lifted.features, lifted.total_weight.double()


def gsplat_features(rasterization: Any, place: torch.device, splats: lc.Splats, views: Views) -> Tensor:
    """X [P, F] f32 by a gradient through ``gsplat.rasterization``, zero where no ray met the splat."""
    means, quats = splats.means.to(place), splats.quats.to(place)
    scales, opacities = splats.log_scales.exp().to(place), torch.sigmoid(splats.opacity_logits).to(place)
    X = torch.zeros(splats.count, views[0][1].codebook.shape[1] + 1, device=place, requires_grad=True)
    for camera, regions in views:
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pose = torch.tensor(camera.viewmat, dtype=torch.float32)
        rendered, _, _ = rasterization(
            means, quats, scales, opacities, X, pose[None].to(place), intrinsics.float()[None].to(place),
            camera.width, camera.height, packed=False,
        )  # fmt: skip
        (rendered[0] * dense_target(regions, place)).sum().backward()  # adds to what the views before left
    assert X.grad is not None
    sums = X.grad.cpu()
    totals = sums[:, -1:]
    return torch.where(totals > 0, sums[:, :-1] / totals, 0.0)


def dense_target(regions: lc.Regions, place: torch.device) -> Tensor:
    """B and n of every pixel, [H, W, F + 1] f32, n last: levels are added up, a quarter of gsplat's work."""
    count, channels = regions.codebook.shape
    book = torch.zeros(count + 1, channels + 1, device=place)  # its last row is what an unlabelled level reads
    book[:count, :channels] = regions.codebook.to(place)
    book[:count, channels] = 1.0
    labels = regions.labels.to(place).flatten(1).T
    target = embedding_bag(torch.where(labels >= 0, labels, count), book, mode="sum")
    return target.reshape(*regions.labels.shape[1:], channels + 1)


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
    if (options.shared / "plush").is_dir():
        _section("A view of plush", views_of(device, options.shared / "plush"))
    with tempfile.TemporaryDirectory(prefix="splatlift-room-") as folder:
        near = [{"scene": "room", **beside_processor(write_voronoi_room(Path(folder), SMALL), device)}]
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
