"""Wrong poses: the poses of N of 100 feature views turned by 1 degree and moved by a hundredth of the scene.

The splats and the held-out cameras stay right (the paper's table on noisy camera poses).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.features.pack import open_packs, pair
from tests.benchmarks.noise import noisy_poses
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from tests.benchmarks.experiments.subject import Subject

TITLE = "Noisy camera poses"
SOURCE = "the paper's table on robustness against noisy camera poses"
SHARES = (0, 20, 50, 100)  # views of 100
SEEDS = (0, 1, 2)
PACKS = ("features",)
METHODS: dict[str, dict[str, Any]] = {"row-sum": {"preset": "row-sum"}, "tikhonov": {"preset": "tikhonov"}}
COLUMNS = ("pack", "method", "noisy_of_100", "accuracy", "miou", "miou_std")


def measure(subject: Subject) -> dict[str, Any]:
    """Accuracy and held-out mIoU, means over the seeds."""
    truth = Tabletop(subject.folder)
    rows = []
    for pack in subject.packs(*PACKS):
        names = pair(open_packs([subject.pack(pack)]), truth.cameras)[0].views[:: subject.every]
        for method, settings in METHODS.items():
            for share in SHARES:
                found = []
                for seed in SEEDS if share else SEEDS[:1]:
                    order = np.random.default_rng((seed, 1)).permutation(len(names))
                    wrong = [names[k] for k in order[: round(len(names) * share / 100)]]
                    made = subject.lift_from(noisy_poses(truth.cameras, wrong, seed), pack, **settings)
                    found.append(truth.judge(made.features, made.metadata.settings))
                mious = [figures.miou for figures in found]
                rows.append(
                    {
                        "pack": pack,
                        "method": method,
                        "noisy_of_100": share,
                        "accuracy": float(np.mean([figures.accuracy for figures in found])),
                        "miou": float(np.mean(mious)),
                        "miou_std": float(np.std(mious)),
                    }
                )
    return {"columns": COLUMNS, "rows": rows, "seeds": SEEDS}


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """mIoU against the share of wrong poses."""
    from tests.benchmarks.experiments.figure import lines

    axes = lines(figure, "views with a wrong pose, of 100", "mIoU of held-out views")
    for method in METHODS:
        rows = [row for row in document["rows"] if row["method"] == method]
        spread = [row["miou_std"] for row in rows]
        axes.errorbar([r["noisy_of_100"] for r in rows], [r["miou"] for r in rows], spread, marker="o", label=method)
    axes.legend()
