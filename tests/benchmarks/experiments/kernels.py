"""The same scene in three kernels (the paper's Table 2a).

The paper trains a scene for each kernel. Here one trained 3DGS scene is read as discs and as beta kernels
(``liftcore/measure/converted.py``): that compares what kernels do to the lift, not how well they are trained.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.io.ply import read_splats
from liftcore.raster.cpu.raster import CpuRaster
from tests.benchmarks.converted import to_betas, to_discs
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from tests.benchmarks.experiments.subject import Subject

TITLE = "Kernels"
SOURCE = "the paper's Table 2a"
PACKS = ("features", "features_hard")
PRESETS = ("row-sum", "tikhonov")
NOTE = (
    "2DGS and DBS are conversions of the trained 3DGS scene, not scenes trained for these kernels. The splats that "
    "count are the same in all rows: those with evidence over 0.5 in the 3DGS scene."
)
COLUMNS = ("pack", "kernel", "preset", "row_sum_mean", "accuracy", "miou")


def measure(subject: Subject) -> dict[str, Any]:
    """Row sums, accuracy and held-out mIoU of every kernel."""
    truth = Tabletop(subject.folder)
    trained = read_splats(subject.folder / "point_cloud.ply")
    forms = {
        "3dgs": (trained, {}),
        "3dgs antialiased": (trained, {"antialiased": True}),
        "2dgs": (to_discs(trained), {}),
        "dbs": (to_betas(trained), {}),
    }
    rows = []
    for kernel, (splats, knobs) in forms.items():
        raster = CpuRaster(splats)
        for pack in subject.packs(*PACKS):
            for preset in PRESETS:
                made = subject.lift_of(splats, pack, preset=preset, **knobs)
                settings = made.metadata.settings
                figures = truth.judge(made.features, settings, raster=raster)
                sums = [raster.row_sums(truth.cameras[v], settings.render_params).mean() for v in truth.held_out]
                row = {"pack": pack, "kernel": kernel, "preset": preset, "row_sum_mean": float(np.mean(sums))}
                rows.append(row | {"accuracy": figures.accuracy, "miou": figures.miou})
    return {"columns": COLUMNS, "rows": rows, "note": NOTE}


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """mIoU a kernel, a group a pack and preset."""
    axes = figure.add_subplot()
    kernels = list(dict.fromkeys(row["kernel"] for row in document["rows"]))
    groups = list(dict.fromkeys((row["pack"], row["preset"]) for row in document["rows"]))
    width = 0.8 / len(kernels)
    for k, kernel in enumerate(kernels):
        heights = [row["miou"] for row in document["rows"] if row["kernel"] == kernel]
        axes.bar(np.arange(len(heights)) + (k - len(kernels) / 2 + 0.5) * width, heights, width, label=kernel)
    axes.set_xticks(range(len(groups)), [f"{pack}\n{preset}" for pack, preset in groups])
    axes.set_ylim(min(row["miou"] for row in document["rows"]) * 0.95, 1)
    axes.set_ylabel("mIoU of held-out views")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend()
