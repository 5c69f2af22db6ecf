"""Which runs are worth their time, and which one to take.

Time is processor time: on a machine that others use too it says what a run costs, where wall time says who else ran.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WITHIN = 0.01  # of the best accuracy
NAMES = {
    "mask_iou": "held-out mask IoU",
    "held_out_cosine": "held-out view cosine",
    "cosine": "cosine against exact",
}


def accuracy_of(runs: Sequence[Mapping[str, Any]]) -> str:
    """The figure that the runs are judged by: masks when there are some, else held-out views, else the exact run."""
    for name in ("mask_iou", "held_out_cosine"):
        if runs and all(run[name] is not None for run in runs):
            return name
    return "cosine"


def pareto(runs: Sequence[Mapping[str, Any]], accuracy: str) -> list[str]:
    """The names of runs that none beats in both time and accuracy, the fastest first."""
    best, names = float("-inf"), []
    for run in sorted(runs, key=lambda run: (run["cpu_s"], -_value(run, accuracy))):
        if _value(run, accuracy) > best:
            best = _value(run, accuracy)
            names.append(run["name"])
    return names


def choose(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The fastest run whose accuracy is within WITHIN of the best one's, and why, in a sentence."""
    accuracy = accuracy_of(runs)
    front = pareto(runs, accuracy)
    by_name = {run["name"]: run for run in runs}
    best = by_name[front[-1]]
    floor = _value(best, accuracy) - WITHIN * abs(_value(best, accuracy))
    taken = by_name[next(name for name in front if _value(by_name[name], accuracy) >= floor)]
    why = _why(taken, best, accuracy)
    return {"name": taken["name"], "options": taken["options"], "accuracy": accuracy, "front": front, "why": why}


def _why(taken: Mapping[str, Any], best: Mapping[str, Any], accuracy: str) -> str:
    figure, value, seconds = NAMES[accuracy], f"{_value(taken, accuracy):.4f}", f"{taken['cpu_s']:.2f} s"
    if taken is best:
        return (
            f"{taken['name']} has the best {figure} ({value}), and none within {WITHIN:.0%} of it takes less than "
            f"its {seconds} of processor time"
        )
    return (
        f"{taken['name']} is the fastest whose {figure} ({value}) is within {WITHIN:.0%} of the best "
        f"({best['name']}, {_value(best, accuracy):.4f}): {seconds} of processor time against {best['cpu_s']:.2f} s"
    )


def _value(run: Mapping[str, Any], accuracy: str) -> float:
    value = run[accuracy]
    return -1.0 if value is None or math.isnan(value) else float(value)
