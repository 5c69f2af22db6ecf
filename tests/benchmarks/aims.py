"""What this machine does beside the project's aims: seconds a view, what channels cost, memory beyond inputs and X.

    python -m tests.benchmarks.aims [--scene DIR] [--splats N] [--size WxH] [--views N] [--preset NAME] [--threads N]

The workloads are those of ``splatlift bench``; its channels are these.
"""

import os
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import normalize

from liftcore.device import Device, choose_device
from liftcore.evaluate.bench import PASSES, Workload, weigh_regions, workload
from liftcore.evaluate.hardware import peak_memory
from liftcore.features.views import Regions
from liftcore.raster import open_raster
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook
from liftcore.warm_up import warm_up_lift
from tests.benchmarks.base import command_line, tell

CHANNELS = FEW, USUAL, MANY = 64, 512, 1024
# Aims of seconds a view, USUAL channels on two cores, by workload, splats and image.
VIEW_SECONDS = {("plush", 179_788, 990, 742): 0.15, ("synthetic room", 1_000_000, 986, 728): 0.30}
CHANNELS_RATIO = 1.1  # a view with MANY channels over one with FEW
BEYOND_BYTES = 1 << 30  # the most memory beside inputs and X


PAUSE = 0.003  # seconds between two looks at memory


@dataclass
class Most:
    """The most bytes of all looks; None where nothing tells them, as Linux alone does."""

    bytes: int | None = None

    def take(self, found: int | None) -> None:
        """Another look."""
        if found is not None:
            self.bytes = max(self.bytes or 0, found)


def anonymous_bytes(process: int | str = "self") -> int | None:
    """What a process holds now that is no file's; None where it has ended, or nothing tells.

    Mapped files count as resident, though the system takes their pages back.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:")), None)


@contextmanager
def watched() -> Iterator[Most]:
    """The most that this process holds while the block runs."""
    most, ended = Most(), threading.Event()

    def look() -> None:
        while not ended.wait(PAUSE):
            most.take(anonymous_bytes())

    watch = threading.Thread(target=look, daemon=True)
    most.take(anonymous_bytes())
    watch.start()
    try:
        yield most
    finally:
        most.take(anonymous_bytes())
        ended.set()
        watch.join()


def measure_aims(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """The figures that the project set itself as aims, beside what this machine does.

    One walk of all views a pass, and of its W the solution with few, usual and many channels: what a channel costs is
    then no matter of how busy the machine was between two runs.

    Returns:
        ``aims``, and the figures behind them: seconds a view of geometry, and of the solution by channels; bytes, the
        peak without pages of files where the system tells it.
    """
    settings, count = LiftSettings.of(preset=preset), work.splats.count
    looking, raster = (settings.lift_params, settings.weighting), open_raster(work.splats, device, threads)
    geometry, solution = [], {channels: [] for channels in CHANNELS}
    peaks: dict[int, int] = {}
    for _ in range(PASSES):
        start = time.perf_counter()
        with watched() as walking:
            W, codebook = weigh_regions(raster, work.views, looking, count, threads)
        geometry.append((time.perf_counter() - start) / len(work.views))
        for channels, seconds in solution.items():
            books = _with_channels(codebook, channels)
            start = time.perf_counter()
            with watched() as solving:
                solve(W, books, torch.float16, means=work.splats.means, threads=threads, device=device)
            seconds.append((time.perf_counter() - start) / len(work.views))
            if channels not in peaks:  # a process that has solved for more keeps some of what that took
                peaks[channels] = max(walking.bytes or peak_memory(), solving.bytes or peak_memory())
    walked = statistics.median(geometry)
    view = {channels: walked + statistics.median(seconds) for channels, seconds in solution.items()}
    held = {
        "inputs_bytes": inputs_bytes(work, USUAL),
        "features_bytes": 2 * count * USUAL,
        "peak_bytes": peaks[USUAL],
    }
    beyond = peaks[USUAL] - held["inputs_bytes"] - held["features_bytes"]
    targets = (
        (f"seconds a view, {USUAL} channels", view[USUAL], _view_seconds(work)),
        (f"a view with {MANY} channels over one with {FEW}", view[MANY] / view[FEW], CHANNELS_RATIO),
        ("MiB beyond inputs and X", beyond / 2**20, BEYOND_BYTES / 2**20),
    )
    return {
        "aims": [
            {"name": name, "found": found, "aim": aim} | ({} if aim is None else {"met": found <= aim})
            for name, found, aim in targets
        ],
        "geometry_s_per_view": walked,
        "solve_s_per_view": {str(channels): statistics.median(seconds) for channels, seconds in solution.items()},
        "load": os.getloadavg()[0],
        **held,
    }


def _view_seconds(work: Workload) -> float | None:
    camera = work.views[0][0]
    return VIEW_SECONDS.get((work.name, work.splats.count, camera.width, camera.height))


def inputs_bytes(work: Workload, channels: int) -> int:
    """Bytes of splats as a lift reads them (no colour), and of label maps and float16 codebooks of F channels."""
    splats = work.splats
    geometry = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits)
    maps = [observed for _, observed in work.views if isinstance(observed, Regions)]
    labels = sum(observed.labels.nbytes + 2 * observed.codebook.shape[0] * channels for observed in maps)
    return sum(part.nbytes for part in geometry) + labels


def _with_channels(codebook: Codebook, channels: int) -> Codebook:
    """The same regions over unit codebooks of so many channels: what they say is of no account here."""
    books = []
    for number, part in enumerate(codebook.views):
        drawn = torch.randn(part.rows.shape[0], channels, generator=torch.Generator().manual_seed(number))
        books.append(replace(part, rows=normalize(drawn, dim=1).half()))
    return Codebook(tuple(books))


def main() -> None:
    """Measure a workload."""
    sizes = [(f"--{name}", {"type": int}) for name in ("splats", "levels", "views", "threads")]
    names = [(f"--{name}", {}) for name in ("scene", "size")]
    preset = ("--preset", {"default": "row-sum"})
    options = vars(command_line("tests.benchmarks.aims", __doc__, *sizes, *names, preset).parse_args())
    work, device = workload(options | {"channels": 1}), choose_device("cpu")
    warm_up_lift(work.splats.kernel, device, LiftSettings.of(preset="row-sum"))
    found = measure_aims(work, LiftSettings.of(preset=options["preset"]).preset, device, options["threads"])
    told = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in found.items() if name != "aims")
    tell(found["aims"], as_json=options["json"], note=f"{work.name}, {work.splats.count} splats; {told}")


if __name__ == "__main__":
    main()
