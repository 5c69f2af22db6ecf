"""Which of several runs to take: the cheapest of those as good as the best, by views that none of them lifted.

A run is judged a view at a time: by the cosines of `liftcore.evaluate.accuracy.centred_cosines`, or by the pixels
that its masks share with labels. As all runs are judged by the same views, what counts is how the *difference* of two
runs varies over views: these are drawn anew RESAMPLES times, with repeats (bootstrap, a fixed seed). A run is as good
as the best one if it comes up to it in more than TAIL of the draws, and lies no more than WITHIN below it: few views
tell little apart, and what they do not tell apart is not thereby equal. Of such runs the one with the least processor
time is taken. Fewer than LEAST_VIEWS views, or one run alone, recommend nothing.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

RESAMPLES = 2_000
TAIL = 0.025  # and intervals hold what lies between the two tails: 95 %
WITHIN = 0.01  # of the best figure: as much as users are asked to give up for speed
LEAST_VIEWS = 4  # of three, a view alone is in a draw more often (1 of 27) than a tail holds
SHOWN_TIES = 4  # names in a sentence
NAMES = {  # what runs are judged by, the first that there are views for
    "mask_iou": "held-out mask IoU",
    "centred_cosine": "centred cosine of held-out views",
    "cosine": "cosine against exact",
}


def accuracy_of(judged: Mapping[str, Any]) -> dict[str, float | None]:
    """The figures of one run over all its views; None without a view.

    Args:
        judged: ``centred_cosine``, a figure a view; ``intersections`` and ``unions``, pixels [V, K] of masks and
            labels of K classes; ``phrase_iou``, a figure for each phrase and view.
    """
    figures = {
        name: float(_figure(judged, name, np.ones((1, _views(judged, name))))[0]) if _views(judged, name) else None
        for name in NAMES
        if name != "cosine"
    }
    return {**figures, "phrase_iou": float(np.mean(judged["phrase_iou"])) if judged["phrase_iou"] else None}


def _views(judged: Mapping[str, Any], name: str) -> int:
    return len(judged["unions" if name == "mask_iou" else name])


def _figure(judged: Mapping[str, Any], name: str, draws: np.ndarray) -> np.ndarray:
    """The figure in each of the draws [B, V], which say how often each view counts: [B]."""
    if name == "centred_cosine":
        return draws @ np.array(judged[name]) / draws.sum(axis=1)
    shared, joined = draws @ np.array(judged["intersections"]), draws @ np.array(judged["unions"])
    known = joined > 0  # a class that a draw does not show does not count there
    return (shared / np.maximum(joined, 1)).sum(axis=1) / known.sum(axis=1)


def choose(runs: Sequence[Mapping[str, Any]], judged: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Which run to take, and why, in a sentence.

    Args:
        runs: the first of them exact; ``name``, ``options``, ``cpu_s``, ``cosine`` and the figures of `accuracy_of`.
        judged: of each run, as `accuracy_of` takes it.

    Returns:
        ``recommended``: whether one is; ``name`` and ``options`` of it, else of the exact run; ``accuracy``: what all
        were judged by; ``ties``: the names of those as good as the best, the cheapest first; ``intervals`` of that
        figure by name; ``front``: runs that none beats in both time and accuracy, the fastest first; ``why``.
    """
    views = {name: min(_views(one, name) for one in judged) for name in NAMES if name != "cosine"}
    known = [name for name in NAMES if all(run[name] is not None for run in runs)]
    enough = [name for name in known if views.get(name, 0) >= LEAST_VIEWS]
    accuracy = (enough or known or ["cosine"])[0]
    found = {
        "recommended": False, "name": runs[0]["name"], "options": runs[0]["options"], "accuracy": accuracy,
        "front": pareto(runs, accuracy), "ties": [], "intervals": {},
    }  # fmt: skip
    if len(runs) == 1:
        why = f"{runs[0]['name']} alone fitted the budget; a larger one compares more"
        return found | {"why": f"Nothing can be recommended: {why}"}
    if not enough:
        there = f"{views['centred_cosine']} with features and {views['mask_iou']} with masks"
        why = f"runs are judged by views that none of them lifted, by {LEAST_VIEWS} at least, and there are {there}"
        return found | {"why": f"Nothing can be recommended: {why}; give more views"}
    count = views[accuracy]
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), RESAMPLES).astype(np.float64)
    drawn = {run["name"]: _figure(one, accuracy, draws) for run, one in zip(runs, judged, strict=True)}
    best = max(runs, key=lambda run: run[accuracy])
    floor = best[accuracy] - WITHIN * abs(best[accuracy])
    near = [run for run in runs if run[accuracy] >= floor]
    ties = [run for run in near if np.quantile(drawn[best["name"]] - drawn[run["name"]], TAIL) <= 0]
    ties.sort(key=lambda run: run["cpu_s"])
    taken = ties[0]
    figure, seconds = f"{NAMES[accuracy]} ({taken[accuracy]:.4f})", f"{taken['cpu_s']:.2f} s of processor time"
    others = [run["name"] for run in ties[1:]]
    named = ", ".join(others[:SHOWN_TIES] + ["..."] * (len(others) > SHOWN_TIES))
    if not others:
        why = f"it has the best {figure}, and {count} views show no other that is as good"
    elif taken is best:
        why = f"it has the best {figure}, and takes the least ({seconds}) of those as good ({named})"
    else:
        why = (
            f"{count} views do not tell its {figure} from the best ({best['name']}, {best[accuracy]:.4f}), and it "
            f"takes the least ({seconds}) of those as good ({named})"
        )
    return found | {
        "recommended": True, "name": taken["name"], "options": taken["options"], "why": why,
        "ties": [run["name"] for run in ties],
        "intervals": {name: np.quantile(values, [TAIL, 1 - TAIL]).tolist() for name, values in drawn.items()},
    }  # fmt: skip


def pareto(runs: Sequence[Mapping[str, Any]], accuracy: str) -> list[str]:
    """The names of runs that none beats in both time and accuracy, the fastest first."""
    best, names = float("-inf"), []
    for run in sorted(runs, key=lambda run: (run["cpu_s"], -run[accuracy])):
        if run[accuracy] > best:
            best = run[accuracy]
            names.append(run["name"])
    return names
