"""``python -m tests.benchmarks.gpu docs/benchmarks_gpu.md``: measure the card that is here, and write the page.

``--look`` says only whether there is one: a line, and status 2 where there is none. ``make gpu`` does both.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from liftcore.device import Device, choose_device
from liftcore.errors import SplatliftError
from liftcore.evaluate.bench import run_bench
from liftcore.io.whole_file import whole_file
from tests.benchmarks.gpu.figures import both_ways, room_both_ways, tabletop_accuracy, view_in_pieces, whole_lift
from tests.benchmarks.gpu.gsplat_lift import beside_gsplat
from tests.benchmarks.gpu.page import Findings, page
from tests.benchmarks.gpu.room_files import AGREEING, BAR

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tests.benchmarks.gpu.room_files import RoomSize

SHARED = Path("../shared/data")
BENCH_VIEWS = 12
NO_CARD = 2


def measure(device: Device, sizes: tuple[RoomSize, RoomSize], shared: Path, command: str) -> Findings:
    """All measurements, of the scenes that are here.

    Args:
        sizes: of the whole lift, and of what both devices and the peer lift.
        shared: the folder of ``plush`` and ``tabletop``.
    """
    large, small = sizes
    scenes = {name: shared / name for name in ("plush", "tabletop") if (shared / name).is_dir()}
    benches = {"room": _bench(device, large, None)}
    if "plush" in scenes:
        benches["plush"] = _bench(device, large, scenes["plush"])
    agreements = {"room": room_both_ways(small, device)}
    for name, folder in scenes.items():
        packs = [folder / f"{pack}.safetensors" for pack in ("features", "regions")]
        pack = next(pack for pack in packs if pack.is_file())
        agreements[name] = both_ways([folder / "point_cloud.ply", folder / "cameras.json", pack], device)
    return Findings(
        device=device,
        sizes=sizes,
        whole=whole_lift(large, device),
        benches=benches,
        agreements=agreements,
        tabletop=tabletop_accuracy(scenes["tabletop"], device) if "tabletop" in scenes else None,
        peer=beside_gsplat(small, device),
        pieces=None if device.kind == "cpu" else view_in_pieces(large, device),
        command=command,
    )


def _bench(device: Device, size: RoomSize, scene: Path | None) -> Mapping[str, object]:
    options = {
        "device": device.kind,
        "scene": scene,
        "splats": size.splats,
        "size": f"{size.width}x{size.height}",
        "channels": size.channels,
        "levels": size.levels,
        "views": min(size.views, BENCH_VIEWS),
    }
    return run_bench(options)


def main() -> int:
    """Write the page whole or not at all; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gpu", description=__doc__)
    parser.add_argument("page", type=Path, nargs="?", metavar="FILE", help="the Markdown to write")
    parser.add_argument("--look", action="store_true", help="only say whether there is a card")
    parser.add_argument("--shared", type=Path, default=SHARED, metavar="DIR", help="of plush and tabletop")
    options = parser.parse_args()
    try:
        device = choose_device("cuda")
    except SplatliftError as error:
        print(f"no figures: {error}", file=sys.stderr)
        return NO_CARD
    if options.look or options.page is None:
        print(f"{device.name}, {(device.free_bytes() or 0) / 2**30:.1f} GiB free, torch {torch.__version__}")
        return 0
    found = measure(device, (BAR, AGREEING), options.shared, "make gpu")
    with whole_file(options.page) as handle:
        handle.write(page(found).encode())
    print(f"wrote {options.page}")
    broken = [*found.whole["differing"], *(found.pieces.broken if found.pieces else ())]
    if broken:
        print(f"not as promised: {', '.join(broken)}", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
