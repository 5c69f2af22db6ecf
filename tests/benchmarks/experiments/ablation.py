"""What each part counts: guidance (T), robust step (R), aggregation (P) and automatic threshold (A), on and off.

mIoU by argmax knows all classes and needs no threshold; phrase IoU asks for each class of a view alone and cuts its
map, by the automatic threshold or (without A) at 0.65 of the way from the map's mean to its maximum, as the released
code does by hand.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import torch

from liftcore.evaluate.accuracy import mask_iou
from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.threshold import find_threshold
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure
    from torch import Tensor

    from liftcore.settings import LiftSettings
    from tests.benchmarks.experiments.subject import Subject

TITLE = "Ablation"
SOURCE = "the paper's Table 1c"
PACKS = ("features", "features_hard")
BY_HAND = 0.65  # of the way from the mean to the maximum
COLUMNS = ("pack", "T", "R", "P", "accuracy", "miou", "phrase_iou_with_A", "phrase_iou_without_A")


def measure(subject: Subject) -> dict[str, Any]:
    """All combinations of the parts, for every pack."""
    truth = Tabletop(subject.folder)
    rows = []
    parts = list(product((False, True), repeat=3))
    for pack, (guided, robust, aggregated) in product(subject.packs(*PACKS), parts):
        made = subject.lift(
            pack,
            preset="tikhonov" if guided else "row-sum",
            robust_steps=int(robust),
            aggregation=aggregated,
        )
        settings = made.metadata.settings
        figures = truth.judge(made.features, settings)
        automatic, by_hand = phrase_ious(truth, made.features, settings)
        row = {"pack": pack, "T": _mark(guided), "R": _mark(robust), "P": _mark(aggregated)}
        row |= {"accuracy": figures.accuracy, "miou": figures.miou}
        rows.append(row | {"phrase_iou_with_A": automatic, "phrase_iou_without_A": by_hand})
    return {"columns": COLUMNS, "rows": rows}


def phrase_ious(truth: Tabletop, features: Tensor, settings: LiftSettings) -> tuple[float, float]:
    """Mean IoU over the classes of each held-out view, each asked for alone: threshold automatic, and by hand."""
    ious: list[tuple[float, float]] = []
    maps = truth.maps(features, settings, truth.raster)
    for (view, mask), scores in zip(truth.held_out.items(), maps, strict=True):
        met = truth.raster.row_sums(truth.cameras[view], settings.render_params) >= MINIMUM_ROW_SUM
        for k in mask[mask >= 0].unique().tolist():
            attention, real = scores[:, :, k], mask == k
            known = attention[met]
            mean, highest = float(known.mean()), float(known.max())
            cuts = find_threshold(known, "auto").value, mean + BY_HAND * (highest - mean)
            automatic, by_hand = (mask_iou(met & (attention >= cut), real) for cut in cuts)
            ious.append((automatic, by_hand))
    automatic, by_hand = torch.tensor(ious).mean(dim=0).tolist()
    return automatic, by_hand


def _mark(on: bool) -> str:
    return "on" if on else "-"


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """mIoU and phrase IoU of every combination, a panel a pack."""
    packs = list(dict.fromkeys(row["pack"] for row in document["rows"]))
    for number, pack in enumerate(packs):
        rows = [row for row in document["rows"] if row["pack"] == pack]
        names = ["".join(part for part in "TRP" if row[part] == "on") or "none" for row in rows]
        axes = figure.add_subplot(1, len(packs), number + 1)
        for key in ("miou", "phrase_iou_with_A", "phrase_iou_without_A"):
            axes.plot(names, [row[key] for row in rows], marker="o", linestyle=":", label=key.replace("_", " "))
        axes.set_title(pack)
        axes.set_ylim(0, 1)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[-1].legend(fontsize="small", loc="lower right")
