"""Run the candidates one after the other, each in a process of its own, for as long as the budget lasts."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput, Unavailable
from liftcore.evaluate.hardware import hardware
from liftcore.evaluate.tradeoff.choice import choose
from liftcore.evaluate.tradeoff.judge import class_vectors, labelled_masks
from liftcore.evaluate.tradeoff.order import CANDIDATES, DRAFT, EXACT, HOLD_OUT, Candidate, Order, Scene
from liftcore.features.pack import pair, read_features
from liftcore.io.cameras import read_cameras
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from liftcore.progress import Progress

EXACT_OVER_DRAFT = 5.0  # how much longer an exact view takes, at most, as far as the budget is planned
EXACT_SHARE = 1 / 3  # of the budget, that the exact run may take
PRESET_OVER_EXACT = 1.5  # top-k walks tiles twice, the robust step goes over W again
LEAST_VIEWS = 4
LONGEST = 86_400  # seconds that one run may take: longer, it hangs


def compare(
    scene: Scene, budget: float, settings: Mapping[str, Any], threads: int | None, progress: Progress
) -> dict[str, Any]:
    """Measure what fits the budget, and choose.

    Args:
        budget: seconds. The exact run is made whatever it is, from few views if need be.
        settings: of all runs, beside what they compare.

    Returns:
        Plain numbers: the ``runs``, what was ``skipped``, which ``views`` were lifted, and the ``choice``.

    Raises:
        InvalidInput: the scene lacks what is needed; or whatever a lift refuses.
        Unavailable: a run did not end within a day.
    """
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="splatlift-tradeoff-") as folder:
        order = _order(scene, settings, threads, Path(folder))
        lifted = len(order.lifted)
        order = _fitting(order, budget)
        runs, skipped = [], []
        for number, candidate in enumerate(CANDIDATES):
            if candidate is EXACT or time.monotonic() - start + _expected(candidate, runs) <= budget:
                runs.append(_entry(candidate, settings, _run(order, candidate)))
                _check_seen(runs[0])
            else:
                skipped.append(candidate.name)
            progress("tradeoff", number + 1, len(CANDIDATES), "runs")
    _ratios(runs)
    return {
        "runs": runs,
        "skipped": skipped,
        "choice": choose(runs),
        "views": {"lifted": len(order.lifted), "of": lifted, "held_out": len(order.held_out)},
        "labelled_views": len(order.labelled),
        "budget_s": budget,
        "seconds": time.monotonic() - start,
        "date": datetime.now(UTC).date().isoformat(),
        "hardware": hardware(),
    }


def _order(scene: Scene, settings: Mapping[str, Any], threads: int | None, folder: Path) -> Order:
    """The views of each kind. Every HOLD_OUT-th view is held out, and what has masks is."""
    cameras = read_cameras(scene.cameras)
    stride = LiftSettings.of(**settings).view_stride
    packs = pair(read_features(*scene.features), cameras)[0]
    names = packs.views[::stride]
    labelled: list[str] = []
    if scene.labels is not None:
        if scene.table is None or not scene.classes:
            raise InvalidInput("labels", expected="a table and the classes' words beside them", got="no words")
        channels = class_vectors(scene).shape[1]
        if channels != packs.channels:
            raise InvalidInput("table", expected=f"{packs.channels} channels, as the features", got=f"{channels}")
        labelled = sorted(labelled_masks(scene, cameras))
        if not labelled:
            raise InvalidInput("labels", expected="VIEW/mask of some camera", got="none")
    free = [name for name in names if name not in set(labelled)]
    held_out = free[HOLD_OUT // 2 :: HOLD_OUT] if len(free) >= HOLD_OUT else free[1:2]
    lifted = [name for name in free if name not in set(held_out)]
    if not lifted:
        raise InvalidInput("features", expected="views besides those with labels", got=f"{len(names)} views")
    own = {**settings, "view_stride": 1}  # the views are named
    return Order(scene, own, tuple(lifted), tuple(held_out), tuple(labelled), threads, folder, False)


def _fitting(order: Order, budget: float) -> Order:
    """The order with so few views that the exact run fits the budget, by what the draft takes."""
    probe = _run(replace(order, held_out=(), labelled=()), DRAFT)
    exact = EXACT_OVER_DRAFT * probe["wall_s"] * len(order.lifted) / probe["views"]
    keep = EXACT_SHARE * budget / exact
    step = 1 if keep >= 1 else min(round(1 / keep), len(order.lifted) // LEAST_VIEWS)
    return replace(order, lifted=order.lifted[:: max(1, step)])


def _expected(candidate: Candidate, runs: Sequence[Mapping[str, Any]]) -> float:
    """Seconds that a run may take with all around it, guessed from the exact run's, which comes first."""
    slower = candidate.kind == "preset" and "speed" not in candidate.settings
    return runs[0]["process_s"] * (PRESET_OVER_EXACT if slower else 1.0)


def _check_seen(exact: Mapping[str, Any]) -> None:
    """Raise InvalidInput where no run could be set beside the exact one."""
    if exact["cosine"] is None:
        got = "an exact run that gave no splat a feature"
        hint = "splats and cameras must share their frame, and features must not be zero"
        raise InvalidInput("features", expected="views that lift", got=got, hint=hint)


def _run(order: Order, candidate: Candidate) -> dict[str, Any]:
    """The figures of one candidate, from its own process."""
    own = replace(order, settings={**order.settings, **candidate.settings}, exact=candidate is EXACT)
    start = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "liftcore.evaluate.tradeoff.child"],
            input=json.dumps(own.document()),
            capture_output=True,
            text=True,
            check=False,
            timeout=LONGEST,
        )
    except subprocess.TimeoutExpired:
        hint = "lift fewer views (--set view_stride=n)"
        raise Unavailable(candidate.name, expected=f"an end within {LONGEST} s", got="none yet", hint=hint) from None
    answer = json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else {}
    if "error" in answer:
        fault = Unavailable if answer["kind"] == Unavailable.kind else InvalidInput
        raise fault(candidate.name, expected="a scene that lifts", got=answer["error"])
    if done.returncode != 0:
        raise RuntimeError(f"{candidate.name} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return {**answer, "process_s": time.monotonic() - start}


def _entry(candidate: Candidate, settings: Mapping[str, Any], figures: Mapping[str, Any]) -> dict[str, Any]:
    options = {**settings, **candidate.settings}
    return {"name": candidate.name, "kind": candidate.kind, "options": options, **figures}


def _ratios(runs: Sequence[dict[str, Any]]) -> None:
    """How much faster than the exact run each is, in wall and in processor time, with reading and without."""
    exact = next(run for run in runs if run["name"] == EXACT.name)
    for run in runs:
        for name in ("wall", "cpu", "wall_with_reading", "cpu_with_reading"):
            run[f"{name}_ratio"] = exact[f"{name}_s"] / run[f"{name}_s"]
