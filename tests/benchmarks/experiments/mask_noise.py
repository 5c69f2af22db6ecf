"""Wrong masks: a growing share of exact regions merged, mislabelled or dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from liftcore.features.pack import open_packs, pair
from liftcore.features.views import Regions
from tests.benchmarks.noise import noisy_masks
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from tests.benchmarks.experiments.subject import Subject

TITLE = "Wrong masks"
SOURCE = "the paper's failure modes of masks, at rates of one's choice"
RATES = (0.0, 0.1, 0.2, 0.4, 0.6)
PACK = "features_clean"
METHODS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "tikhonov + robust step": {"preset": "tikhonov", "robust_steps": 1},
    "tikhonov + aggregation": {"preset": "tikhonov", "aggregation": True},
}
COLUMNS = ("method", "rate", "accuracy", "miou")


def measure(subject: Subject) -> dict[str, Any]:
    """Accuracy and held-out mIoU of each method at each rate; the same wrong masks for all methods."""
    truth = Tabletop(subject.folder)
    packs = pair(open_packs([subject.pack(PACK)]), truth.cameras)[0]
    seen = {name: packs.observation(name) for name in packs.views}
    maps = {name: observed for name, observed in seen.items() if isinstance(observed, Regions)}
    rows = []
    for rate in RATES:
        wrong = noisy_masks(maps, rate, seed=0)
        for method, settings in METHODS.items():
            made = subject.lift_seeing(wrong, **settings)
            figures = truth.judge(made.features, made.metadata.settings)
            rows.append({"method": method, "rate": rate, "accuracy": figures.accuracy, "miou": figures.miou})
    return {"columns": COLUMNS, "rows": rows}


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """mIoU against the rate."""
    from tests.benchmarks.experiments.figure import lines

    axes = lines(figure, "share of wrong regions", "mIoU of held-out views")
    for method in METHODS:
        rows = [row for row in document["rows"] if row["method"] == method]
        axes.plot([row["rate"] for row in rows], [row["miou"] for row in rows], marker="o", label=method)
    axes.legend()
