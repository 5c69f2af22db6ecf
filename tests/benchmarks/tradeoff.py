"""Quality of the recommendations of ``splatlift tradeoff`` without labels, measured by the ground truth.

    python -m tests.benchmarks.tradeoff TABLETOP [--cases NAME ...] [--json]

Cases are packs of `tabletop` (``features_hard/4`` takes every fourth view), and ``KIND SEED``: mistakes that are made
on the tests' still life (its words need the extra ``minilm``). All runs lift the views that a trade-off lifts, and
are judged by those that it holds out, in one process. A row is a case: the run that is taken, its mIoU by truth in
views that no run saw, the best run by truth, and how far the taken one is below it (``worse``). The bar is .01.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import liftcore as lc
from liftcore.evaluate.accuracy import centred_cosines
from liftcore.evaluate.ranking import accuracy_of, choose
from liftcore.evaluate.tradeoff import candidates_of, hold_out
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.runtime.device import CPU
from liftcore.values.views import ViewFeatures
from tests.benchmarks.base import command_line, print_rows, read_pack
from tests.benchmarks.consensus import still_life_scene
from tests.benchmarks.tabletop import Truth, tabletop

CASES = (
    "features_hard", "features_hard/2", "features_hard/4", "features", "features/4", "usual 7", "hard 7", "grids",
)  # fmt: skip


def measured(case: str, truth: Truth, views: Mapping[str, ViewFeatures]) -> dict[str, Any]:
    """The row of a case, and under ``runs`` what it comes from."""
    lifted, held_out = hold_out(list(views))
    observed, runs, accuracies = [(truth.cameras[view], views[view]) for view in held_out], [], []
    for candidate in candidates_of({}):
        settings = lc.LiftSettings.of(**{"diagnostic_rays": 0, **candidate.settings})
        warm_up_lift(truth.raster.splats.kernel, CPU, settings)
        busy = time.process_time()
        result = lc.lift(truth.raster.splats, truth.cameras, {view: views[view] for view in lifted}, settings)
        seconds = time.process_time() - busy
        cosines = centred_cosines(truth.raster, observed, result.features, settings.render_params)
        accuracies.append({"centred_cosine": cosines, "intersections": [], "unions": [], "phrase_iou": []})
        entry = {"name": candidate.name, "options": candidate.settings, "cpu_s": seconds, "cosine": 1.0}
        runs.append({**entry, **accuracy_of(accuracies[-1]), "miou": truth.evaluate(result).miou, "views": cosines})
    choice, miou = choose(runs, accuracies), {run["name"]: run["miou"] for run in runs}
    best = max(miou, key=lambda name: miou[name])
    row = {"case": f"{case}, {len(lifted)} and {len(held_out)} views", "taken": choice["name"]}
    row |= {"mIoU": miou[choice["name"]], "best": best, "its mIoU": miou[best]}
    return row | {"worse": miou[best] - miou[choice["name"]], "runs": runs}


def rows_of(folder: Path, cases: Iterable[str]) -> Iterator[dict[str, Any]]:
    """A row a case."""
    truth = tabletop(folder)
    for case in cases:
        if " " in case:
            kind, seed = case.split()
            yield measured(f"still life, {case}", *still_life_scene(kind, int(seed)))
        else:
            pack, _, stride = case.partition("/")
            yield measured(case, truth, read_pack(folder, pack, int(stride or 1)))


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.tradeoff",
        __doc__,
        ("folder", {"type": Path}),
        ("--cases", {"nargs": "+", "default": CASES, "metavar": "NAME"}),
    )
    options = parser.parse_args()
    rows = list(rows_of(options.folder, options.cases))
    print_rows(
        rows, as_json=options.json, columns=() if options.json else [name for name in rows[0] if name != "runs"]
    )


if __name__ == "__main__":
    main()
