"""The opacity gain lambda, lifting and rendering apart (the paper's table on Tikhonov Guidance)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from tests.benchmarks.experiments.subject import Subject

TITLE = "The gain lambda on the opacity logits"
SOURCE = "the paper's table on the effect of Tikhonov Guidance"
PAIRS = (  # lambda lifting, lambda rendering: the paper's, then far beyond
    (0.5, 1.0), (0.8, 1.0), (1.0, 1.0), (1.1, 1.1), (1.2, 1.2), (1.35, 1.35), (1.5, 1.5), (1.2, 1.0), (2.0, 2.0),
    (4.0, 4.0), (8.0, 8.0),
)  # fmt: skip
PACKS = ("features_hard",)
COLUMNS = ("pack", "power", "lift_gain", "render_gain", "accuracy", "miou")


def measure(subject: Subject) -> dict[str, Any]:
    """Accuracy and held-out mIoU for every pair of gains, with weights and with squared weights."""
    truth = Tabletop(subject.folder)
    rows = []
    for pack in subject.packs(*PACKS):
        for power in (1, 2):
            for lift_gain, render_gain in PAIRS:
                knobs = {"power": power, "lift_gain": lift_gain, "render_gain": render_gain}
                made = subject.lift(pack, preset="tikhonov", **knobs)
                figures = truth.judge(made.features, made.metadata.settings)
                rows.append({"pack": pack, **knobs, "accuracy": figures.accuracy, "miou": figures.miou})
    return {"columns": COLUMNS, "rows": rows}


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """mIoU against lambda where lifting and rendering share it."""
    from tests.benchmarks.experiments.figure import lines

    axes = lines(figure, "lambda, lifting and rendering", "mIoU of held-out views")
    for power, label in ((1, "w"), (2, "w squared")):
        same = [r for r in document["rows"] if r["power"] == power and r["lift_gain"] == r["render_gain"]]
        axes.plot([row["lift_gain"] for row in same], [row["miou"] for row in same], marker="o", label=label)
    axes.set_xscale("log", base=2)
    axes.legend()
