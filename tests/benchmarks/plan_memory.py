"""The plan of a lift against the lift: entries of W, and memory at the peak, for settings that change them.

    python -m tests.benchmarks.plan_memory SPLATS CAMERAS FEATURES... [--json]

Each lift runs in a process of its own, for every pack alone. ``entries`` are those of W for a splat that a view can
see, before occlusion. ``planned`` is the plan's sum in MiB with as many views in work as the lift has; ``anonymous``
the most that the process held which is no file, looked at from outside every few milliseconds (only Linux tells it);
``resident`` its peak with the pages of files: libraries, and codebooks, which are read where they lie.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.device import choose_device
from liftcore.evaluate.anonymous_memory import PAUSE, Most, anonymous_bytes
from liftcore.evaluate.hardware import hardware, machine_line, peak_memory
from liftcore.features.pack import open_packs
from liftcore.io.lift_file import save_lift
from liftcore.lift import lift, open_sources, planned
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.process import BaseProcess

REGIONS = (
    {},
    {"dtype": "float32"},
    {"levels": 0},
    {"robust_steps": 1},
    {"aggregation": True},
    {"cg_steps": 1, "cg_basis": 32},
)
GRIDS = ({}, {"grid_reading": "nearest"}, {"aggregation": True}, {"cg_steps": 1, "cg_basis": 32})
ANSWER = "answer.json"
MIB = 2**20


def measure_pack(splats: Path, cameras: Path, pack: Path) -> Iterator[dict[str, Any]]:
    """One row a setting."""
    packs = open_packs([pack])
    for own in REGIONS if packs.is_regions(packs.views[0]) else GRIDS:
        yield {"features": pack.stem, "settings": own} | measure_lift(splats, cameras, pack, own)


def measure_lift(splats: Path, cameras: Path, pack: Path, own: dict[str, Any]) -> dict[str, Any]:
    """What the plan of a lift said and what the lift took, in a process of its own.

    Raises:
        RuntimeError: the process ended without an answer.
    """
    with tempfile.TemporaryDirectory() as folder:
        child = multiprocessing.get_context("spawn").Process(
            target=_lift, args=((splats, cameras, pack), own, Path(folder))
        )
        child.start()
        most = _watched(child)
        answer = Path(folder, ANSWER)
        if not answer.is_file():
            raise RuntimeError(f"the lift of {pack} with {own} ended with the code {child.exitcode}")
        return json.loads(answer.read_text(encoding="ascii")) | {"anonymous_bytes": most}


def _watched(child: BaseProcess) -> int | None:
    """The most anonymous bytes that the process had until it ended; None where nothing tells them."""
    most = Most()
    while child.is_alive():
        most.take(anonymous_bytes(child.pid or 0))
        child.join(PAUSE)
    return most.bytes


def _lift(paths: tuple[Path, Path, Path], own: dict[str, Any], folder: Path) -> None:
    """In the process of its own: lift, and write what is known of it."""
    splats, cameras, pack = paths
    settings = LiftSettings.of(**own, device="cpu")
    lifted = lift(splats, cameras, [pack], settings)
    save_lift(lifted, folder / "lift.safetensors")
    certificate, peak = lifted.metadata.certificate, peak_memory()
    plan = planned(open_sources(splats, cameras, [pack], settings), settings, choose_device("cpu"))
    seen = max(len(plan.views) * plan.splats_a_view, 1.0)
    found = {
        "entries_planned": plan.entries_a_splat,
        "entries": certificate["weights_entries"] / seen,
        "planned_bytes": sum(plan.in_work.values()),
        "resident_bytes": peak,
        "parts": plan.in_work,
    }
    Path(folder, ANSWER).write_text(json.dumps(found), encoding="ascii")


def table_of(document: dict[str, Any]) -> str:
    """The rows and the machine, for people."""
    lines = [
        f"{'':<44}{'entries':>20}{'MiB':>30}",
        f"{'features, settings':<44}{'planned':>10}{'found':>10}{'planned':>10}{'anonymous':>10}{'resident':>10}",
    ]
    for row in document["rows"]:
        own = ", ".join(f"{name}={value}" for name, value in row["settings"].items()) or "as they come"
        sizes = (row[f"{name}_bytes"] for name in ("planned", "anonymous", "resident"))
        told = "".join(f"{'-' if size is None else round(size / MIB):>10}" for size in sizes)
        entries = f"{row['entries_planned']:>10.2f}{row['entries']:>10.2f}"
        lines.append(f"{row['features'] + ', ' + own:<44}{entries}{told}")
    return "\n".join([*lines, machine_line(document["hardware"])])


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.plan_memory", description=__doc__)
    parser.add_argument("splats", type=Path, metavar="SPLATS", help="PLY")
    parser.add_argument("cameras", type=Path, metavar="CAMERAS", help="COLMAP, transforms.json or cameras.json")
    parser.add_argument("features", type=Path, nargs="+", metavar="FEATURES", help="packs, lifted one at a time")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args()
    rows = [row for pack in options.features for row in measure_pack(options.splats, options.cameras, pack)]
    document = {"rows": rows, "hardware": hardware()}
    print(json.dumps(document) if options.json else table_of(document))


if __name__ == "__main__":
    main()
