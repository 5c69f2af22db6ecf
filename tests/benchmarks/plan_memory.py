"""The plan of a lift against the lift: memory at the peak, for settings that change it.

    python -m tests.benchmarks.plan_memory SPLATS CAMERAS FEATURES... [--json]

Each lift runs in a process of its own, for every pack alone. ``entries`` are those of W for a splat that a view can
see, before occlusion. ``planned`` is the plan's sum in MiB; ``anonymous`` the most that the process held which is no
file, looked at from outside every few milliseconds (only Linux tells it); ``resident`` its peak with the pages of
files: libraries, and codebooks, which are read where they lie.
"""

import json
import multiprocessing
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from liftcore.device import choose_device
from liftcore.evaluate.hardware import PAUSE, Most, anonymous_bytes, peak_memory
from liftcore.features.pack import read_features
from liftcore.io.lift_file import save_lift
from liftcore.lift import lift, open_sources, planned
from liftcore.settings import LiftSettings
from tests.benchmarks.base import command_line, tell

REGIONS = (
    {}, {"dtype": "float32"}, {"levels": 0}, {"robust_steps": 1}, {"aggregation": True},
    {"cg_steps": 1, "cg_basis": 32},
)  # fmt: skip
GRIDS = ({}, {"grid_reading": "nearest"}, {"aggregation": True}, {"cg_steps": 1, "cg_basis": 32})
MIB = 2**20


def rows_of(splats: Path, cameras: Path, pack: Path) -> Iterator[dict[str, Any]]:
    """One row a setting."""
    packs = read_features(pack)
    for own in REGIONS if packs.is_regions(packs.views[0]) else GRIDS:
        name = ", ".join(f"{key}={value}" for key, value in own.items()) or "as they come"
        yield {"features": pack.stem, "settings": name} | measure((splats, cameras, pack), own)


def measure(paths: tuple[Path, Path, Path], own: dict[str, Any]) -> dict[str, Any]:
    """What the plan of a lift said and what the lift took, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        child = multiprocessing.get_context("spawn").Process(target=_lift, args=(paths, own, Path(folder)))
        child.start()
        most = Most()
        while child.is_alive():
            most.take(anonymous_bytes(child.pid or 0))
            child.join(PAUSE)
        answer = Path(folder, "answer.json")
        if not answer.is_file():
            raise RuntimeError(f"the lift of {paths[2]} with {own} ended with the code {child.exitcode}")
        return json.loads(answer.read_text()) | {"anonymous MiB": None if most.bytes is None else most.bytes // MIB}


def _lift(paths: tuple[Path, Path, Path], own: dict[str, Any], folder: Path) -> None:
    splats, cameras, pack = paths
    settings = LiftSettings.of(**own, device="cpu")
    lifted = lift(splats, cameras, [pack], settings)
    save_lift(lifted, folder / "lift.safetensors")
    peak = peak_memory()
    plan = planned(open_sources(splats, cameras, [pack], settings), settings, choose_device("cpu"))
    seen = max(len(plan.views) * plan.splats_a_view, 1.0)
    found = {
        "entries planned": plan.entries_a_splat,
        "entries": lifted.metadata.certificate["weights_entries"] / seen,
        "planned MiB": sum(plan.in_work.values()) // MIB,
        "resident MiB": peak // MIB,
    }
    Path(folder, "answer.json").write_text(json.dumps(found))


def main() -> None:
    """Print the table, or one JSON object."""
    files = [(name, {"type": Path}) for name in ("splats", "cameras")]
    packs = {"type": Path, "nargs": "+", "help": "packs, lifted one at a time"}
    options = command_line("tests.benchmarks.plan_memory", __doc__, *files, ("features", packs)).parse_args()
    rows = (row for pack in options.features for row in rows_of(options.splats, options.cameras, pack))
    tell(rows, as_json=options.json)


if __name__ == "__main__":
    main()
