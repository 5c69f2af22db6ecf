"""One run of the trade-off, in a process of its own so that its memory is its own: an order on stdin, JSON on stdout.

python -m liftcore.evaluate.tradeoff.child < order.json
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from liftcore.device import choose_device
from liftcore.errors import SplatliftError
from liftcore.evaluate.hardware import peak_memory
from liftcore.evaluate.tradeoff.judge import judge
from liftcore.evaluate.tradeoff.order import Order
from liftcore.io.input_files import input_files
from liftcore.lift import Run, lift_sources, open_sources
from liftcore.listener import NOBODY
from liftcore.settings import LiftSettings
from liftcore.timings import Timings
from liftcore.warm_up import warm_up_lift

if TYPE_CHECKING:
    import torch

    from liftcore.io.lift_file import LiftResult

APART = ("read", "digest", "compile")  # stages that the seconds of a lift leave out
BAD_INPUT = 2


def measured(order: Order) -> dict[str, Any]:
    """Lift as ordered, and give the figures of the run and of its features."""
    settings = LiftSettings.of(**order.settings)
    run = Run(settings, order.threads, NOBODY, Timings(), choose_device(settings.device))
    cpu, wall = time.process_time(), time.perf_counter()
    with run.timings.stage("read"):
        sources = open_sources(order.scene.splats, order.scene.cameras, order.scene.features, settings)
    wanted = set(order.lifted)
    sources = replace(sources, views=[view for view in sources.views if view in wanted])
    read = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    with run.timings.stage("digest"):
        inputs = input_files(order.scene.splats, order.scene.cameras, order.scene.features)
    with run.timings.stage("compile"):
        warm_up_lift(sources.splats.kernel, run.device, settings)  # the lift's own then takes no time
    cpu, wall = time.process_time(), time.perf_counter()
    made = lift_sources(run, sources, inputs)
    seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    figures = {
        "cpu_s": seconds["cpu"],
        "wall_s": seconds["wall"],
        "cpu_with_reading_s": seconds["cpu"] + read["cpu"],
        "wall_with_reading_s": seconds["wall"] + read["wall"],
        "peak_memory_bytes": peak_memory(),
        "load": os.getloadavg()[0],
        "views": len(made.metadata.views),
        "settings": made.metadata.settings.model_dump(mode="json"),
        "seen_share": float(made.seen.float().mean()),
        "timings": {name: value for name, value in made.metadata.timings.items() if name not in APART},
    }
    return figures | judge(order, sources, _reference(order, made), made)


def _reference(order: Order, made: LiftResult) -> tuple[torch.Tensor, torch.Tensor]:
    """Features [P, F] and evidence [P] of the exact run."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    path = order.reference / "exact.safetensors"
    if order.exact:
        save_file({"features": made.features, "evidence": made.evidence}, path)
        return made.features, made.evidence
    if not path.is_file():
        return made.features[:0], made.evidence[:0]
    with safe_open(str(path), framework="pt") as kept:
        return kept.get_tensor("features"), kept.get_tensor("evidence")


def main() -> int:
    """Run the order on stdin."""
    try:
        figures = measured(Order.of(json.load(sys.stdin)))
    except SplatliftError as error:
        print(json.dumps({"error": str(error), "kind": error.kind}))
        return BAD_INPUT
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
