"""The choice among several runs: the cheapest of those as good as the best, by views that no run lifted.

Accuracy is measured a view at a time: the cosines of `liftcore.evaluate.accuracy.centred_cosines`, or the pixels that
masks and labels share. All runs are measured on the same views, so that the variation of the *difference* of two runs
over views matters. Views are resampled RESAMPLES times with replacement (bootstrap, a fixed seed). A run is as good
as the best one if it reaches it in more than TAIL of the samples, and is at most WITHIN below it: a few views do not
separate runs, and runs that are not separated need not be equal. Of these runs the one with the least CPU time is
chosen. Fewer than LEAST_VIEWS views, or a single run, give no recommendation.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from liftcore.runtime.one_line import join_names

RESAMPLES = 2_000
TAIL = 0.025  # and intervals hold what lies between the two tails: 95 %
WITHIN = 0.01  # of the best figure: the loss that is acceptable for less time
LEAST_VIEWS = 4  # with three, a sample of one view alone is more probable (1 of 27) than a tail
SHOWN_TIES = 4  # names in a sentence
NAMES = {  # measures of accuracy; the first with views is used
    "mask_iou": "held-out mask IoU",
    "centred_cosine": "centred cosine of held-out views",
    "cosine": "cosine against exact",
}


def accuracy_of(accuracies: Mapping[str, Any]) -> dict[str, float | None]:
    """Compute the figures of one run over all its views; None without a view.

    Args:
        accuracies: ``centred_cosine``, a figure a view; ``intersections`` and ``unions``, pixels [V, K] of masks and
            labels of K classes; ``phrase_iou``, a figure for each phrase and view.
    """
    figures = {
        name: float(_figure(accuracies, name, np.ones((1, _views(accuracies, name))))[0])
        if _views(accuracies, name)
        else None
        for name in NAMES
        if name != "cosine"
    }
    return {**figures, "phrase_iou": float(np.mean(accuracies["phrase_iou"])) if accuracies["phrase_iou"] else None}


def _views(accuracies: Mapping[str, Any], name: str) -> int:
    return len(accuracies["unions" if name == "mask_iou" else name])


def _figure(accuracies: Mapping[str, Any], name: str, draws: np.ndarray) -> np.ndarray:
    """Compute the figure [B] of each sample in ``draws`` [B, V], the count of each view."""
    if name == "centred_cosine":
        return draws @ np.array(accuracies[name]) / draws.sum(axis=1)
    shared, unions = draws @ np.array(accuracies["intersections"]), draws @ np.array(accuracies["unions"])
    present = unions > 0  # a class that a draw does not show does not count there
    return (shared / np.maximum(unions, 1)).sum(axis=1) / present.sum(axis=1)


def choose(runs: Sequence[Mapping[str, Any]], accuracies: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Choose the run to recommend, with the reason in a sentence.

    Args:
        runs: the first of them exact; ``name``, ``options``, ``cpu_s``, ``cosine`` and the figures of `accuracy_of`.
        accuracies: of each run, as in `accuracy_of`.

    Returns:
        ``recommended``: True if one is; ``name`` and ``options`` of it, else of the exact run; ``accuracy``: the
        measure; ``ties``: the names of those as good as the best, the cheapest first; ``intervals`` of that
        figure by name; ``front``: runs that none beats in both time and accuracy, the fastest first; ``why``.
    """
    views = {
        name: min(_views(accuracy_data, name) for accuracy_data in accuracies) for name in NAMES if name != "cosine"
    }
    shared_names = [name for name in NAMES if all(run[name] is not None for run in runs)]
    sufficient = [name for name in shared_names if views.get(name, 0) >= LEAST_VIEWS]
    accuracy = (sufficient or shared_names or ["cosine"])[0]
    choice = {
        "recommended": False, "name": runs[0]["name"], "options": runs[0]["options"], "accuracy": accuracy,
        "front": pareto(runs, accuracy), "ties": [], "intervals": {},
    }  # fmt: skip
    if len(runs) == 1:
        reason = f"{runs[0]['name']} alone fitted the budget; a larger one compares more"
        return choice | {"why": f"Nothing can be recommended: {reason}"}
    if not sufficient:
        available = f"{views['centred_cosine']} with features and {views['mask_iou']} with masks"
        reason = (
            f"runs are judged by views that none of them lifted, by {LEAST_VIEWS} at least, and there are {available}"
        )
        return choice | {"why": f"Nothing can be recommended: {reason}; give more views"}
    count = views[accuracy]
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), RESAMPLES).astype(np.float64)
    figures_by_name = {
        run["name"]: _figure(accuracy_data, accuracy, draws)
        for run, accuracy_data in zip(runs, accuracies, strict=True)
    }
    best = max(runs, key=lambda run: run[accuracy])
    floor = best[accuracy] - WITHIN * abs(best[accuracy])
    near_best = [run for run in runs if run[accuracy] >= floor]
    ties = [
        run
        for run in near_best
        if np.quantile(figures_by_name[best["name"]] - figures_by_name[run["name"]], TAIL) <= 0
    ]
    ties.sort(key=lambda run: run["cpu_s"])
    best_tie = ties[0]
    figure, seconds = f"{NAMES[accuracy]} ({best_tie[accuracy]:.4f})", f"{best_tie['cpu_s']:.2f} s of CPU time"
    other_ties = [run["name"] for run in ties[1:]]
    tie_names = join_names(other_ties, SHOWN_TIES)
    if not other_ties:
        reason = f"it has the best {figure}, and {count} views show no other that is as good"
    elif best_tie is best:
        reason = f"it has the best {figure}, and takes the least ({seconds}) of those as good ({tie_names})"
    else:
        reason = (
            f"{count} views do not tell its {figure} from the best ({best['name']}, {best[accuracy]:.4f}), and it "
            f"takes the least ({seconds}) of those as good ({tie_names})"
        )
    return choice | {
        "recommended": True, "name": best_tie["name"], "options": best_tie["options"], "why": reason,
        "ties": [run["name"] for run in ties],
        "intervals": {name: np.quantile(values, [TAIL, 1 - TAIL]).tolist() for name, values in
        figures_by_name.items()},
    }  # fmt: skip


def pareto(runs: Sequence[Mapping[str, Any]], accuracy: str) -> list[str]:
    """Return the names of runs that none beats in both time and accuracy, the fastest first."""
    best, names = float("-inf"), []
    for run in sorted(runs, key=lambda run: (run["cpu_s"], -run[accuracy])):
        if run[accuracy] > best:
            best = run[accuracy]
            names.append(run["name"])
    return names
