"""Speed against accuracy on a scene of the user's: the settings ``speed`` and the presets, under a budget of time.

Each run is a process of its own (``python -m liftcore.evaluate.tradeoff``: a pickled `RunSpec` on stdin, figures as
JSON on stdout), so that its memory is its own. Time is processor time: on a machine that others use too it says what
a run costs, where wall time says who else ran.
"""

import json
import math
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.device import choose_device
from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.evaluate.accuracy import class_ious, rendered_scores, view_cosines
from liftcore.evaluate.hardware import hardware, peak_memory
from liftcore.features.pack import Views, pair, read_features
from liftcore.io.cameras import read_cameras
from liftcore.io.class_masks import read_masks
from liftcore.io.scene_files import open_files
from liftcore.lifting import lift
from liftcore.progress import Progress
from liftcore.query.render import in_photo
from liftcore.query.text.table import TableEncoder
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.result import LiftResult
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views
from liftcore.settings import LiftSettings
from liftcore.warm_up import warm_up_lift

HOLD_OUT = 8  # every n-th view is held out of the lifts


@dataclass(frozen=True)
class Candidate:
    """Settings under comparison."""

    name: str
    kind: str  # "dial" or "preset"
    settings: dict[str, Any] = field(default_factory=dict)


EXACT = Candidate("exact", "dial", {"speed": "exact"})
DRAFT = Candidate("draft", "dial", {"speed": "draft"})
CANDIDATES = (
    EXACT,
    Candidate("fast", "dial", {"speed": "fast"}),
    DRAFT,
    Candidate("balanced", "dial", {"speed": "balanced"}),
    Candidate("row-sum", "preset", {"preset": "row-sum"}),
    Candidate("robust", "preset", {"robust_steps": 1}),
    Candidate("fast + robust", "preset", {"speed": "fast", "robust_steps": 1}),
    Candidate("front-mass", "preset", {"preset": "front-mass"}),
    Candidate("argmax", "preset", {"preset": "argmax"}),
    Candidate("centre", "preset", {"preset": "centre"}),
    Candidate("top-k", "preset", {"preset": "top-k"}),
    Candidate("mean", "preset", {"preset": "mean"}),
)


@dataclass(frozen=True)
class Scene:
    """The files, and what to judge by."""

    splats: Path
    cameras: Path
    features: tuple[Path, ...]
    labels: Path | None = None  # masks of views, VIEW/mask [h, w] int: numbers of classes, -1 none
    table: Path | None = None  # text embeddings
    classes: tuple[str, ...] = ()  # the words of the classes, in the order of their numbers


@dataclass(frozen=True)
class RunSpec:
    """One run in a process of its own."""

    scene: Scene
    settings: dict[str, Any]
    lifted: tuple[str, ...]  # views
    held_out: tuple[str, ...]  # views with features
    labelled: tuple[str, ...]  # views with masks, none of them lifted
    threads: int | None
    reference: Path  # a folder: the exact run writes its features there, the others read them
    exact: bool


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
        spec = _plan_runs(scene, settings, threads, Path(folder))
        lifted = len(spec.lifted)
        spec = _fitting(spec, budget)
        runs, skipped = [], []
        for number, candidate in enumerate(CANDIDATES):
            if candidate is EXACT or time.monotonic() - start + _expected(candidate, runs) <= budget:
                runs.append(_entry(candidate, settings, _run(spec, candidate)))
                _check_seen(runs[0])
            else:
                skipped.append(candidate.name)
            progress("tradeoff", number + 1, len(CANDIDATES), "runs")
    _ratios(runs)
    return {
        "runs": runs,
        "skipped": skipped,
        "choice": choose(runs),
        "views": {"lifted": len(spec.lifted), "of": lifted, "held_out": len(spec.held_out)},
        "labelled_views": len(spec.labelled),
        "budget_s": budget,
        "seconds": time.monotonic() - start,
        "date": datetime.now(UTC).date().isoformat(),
        "hardware": hardware(),
    }


def _plan_runs(scene: Scene, settings: Mapping[str, Any], threads: int | None, folder: Path) -> RunSpec:
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
    return RunSpec(scene, own, tuple(lifted), tuple(held_out), tuple(labelled), threads, folder, False)


def _fitting(spec: RunSpec, budget: float) -> RunSpec:
    """The order with so few views that the exact run fits the budget, by what the draft takes."""
    probe = _run(replace(spec, held_out=(), labelled=()), DRAFT)
    exact = EXACT_OVER_DRAFT * probe["wall_s"] * len(spec.lifted) / probe["views"]
    keep = EXACT_SHARE * budget / exact
    step = 1 if keep >= 1 else min(round(1 / keep), len(spec.lifted) // LEAST_VIEWS)
    return replace(spec, lifted=spec.lifted[:: max(1, step)])


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


def _run(spec: RunSpec, candidate: Candidate) -> dict[str, Any]:
    """The figures of one candidate, from its own process."""
    own = replace(spec, settings={**spec.settings, **candidate.settings}, exact=candidate is EXACT)
    start = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "liftcore.evaluate.tradeoff"],
            input=pickle.dumps(own),
            capture_output=True,
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
        raise RuntimeError(
            f"{candidate.name} ended with {done.returncode}: {done.stderr.decode(errors='replace').strip()[-300:]}"
        )
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


APART = ("read", "digest", "compile")  # stages that the seconds of a lift leave out
BAD_INPUT = 2


def measured(spec: RunSpec) -> dict[str, Any]:
    """Lift as ordered, and give the figures of the run and of its features."""
    settings, scene = LiftSettings.of(**spec.settings), spec.scene
    cpu, wall = time.process_time(), time.perf_counter()
    splats, cameras, packs = open_files(scene.splats, scene.cameras, scene.features, settings)
    features = pair(packs, cameras)[0]
    lifted = features.seen_by({view: view for view in spec.lifted if view in features}, cameras)
    read = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    warm_up_lift(splats.kernel, choose_device(settings.device), settings)  # the lift's own then takes no time
    cpu, wall = time.process_time(), time.perf_counter()
    made = lift(splats, cameras, lifted, settings, threads=spec.threads)
    seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    figures = {
        "cpu_s": seconds["cpu"],
        "wall_s": seconds["wall"],
        "cpu_with_reading_s": seconds["cpu"] + read["cpu"],
        "wall_with_reading_s": seconds["wall"] + read["wall"],
        "peak_memory_bytes": peak_memory(),
        "load": os.getloadavg()[0],
        "views": len(made.metadata.views),
        "settings": made.metadata.settings.model_dump(mode="json"),
        "seen_share": float(made.seen.float().mean()),
        "timings": {name: value for name, value in made.metadata.timings.items() if name not in APART},
    }
    return figures | judge(spec, splats, cameras, features, _reference(spec, made), made)


def _reference(spec: RunSpec, made: LiftResult) -> tuple[torch.Tensor, torch.Tensor]:
    """Features [P, F] and evidence [P] of the exact run."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    path = spec.reference / "exact.safetensors"
    if spec.exact:
        save_file({"features": made.features, "evidence": made.evidence}, path)
        return made.features, made.evidence
    if not path.is_file():
        return made.features[:0], made.evidence[:0]
    with safe_open(str(path), framework="pt") as kept:
        return kept.get_tensor("features"), kept.get_tensor("evidence")


LOW_QUANTILE = 0.05
ROWS = 1 << 16  # compared at a time


def judge(
    spec: RunSpec,
    splats: Splats,
    cameras: Cameras,
    features: Views,
    reference: tuple[Tensor, Tensor],
    made: LiftResult,
) -> dict[str, Any]:
    """The figures of accuracy; None where there is nothing to compare with.

    Args:
        reference: features [P, F] and evidence [P] of the exact run, empty before it.
    """
    figures = cosine_figures(made.features, *reference)
    raster, walk = CpuRaster(splats, spec.threads), made.metadata.settings.render_params
    rows = [view_cosines(raster, cameras[view], features[view], made.features, walk) for view in spec.held_out]
    cosines = np.concatenate(rows) if rows else np.zeros(0)
    figures["held_out_cosine"] = float(cosines.mean()) if cosines.size else None
    figures["mask_iou"] = None
    if spec.scene.labels is not None and spec.labelled:
        classes = class_vectors(spec.scene)
        masks = labelled_masks(spec.scene, cameras)
        found = []
        for view in spec.labelled:
            scores = in_photo(
                cameras[view],
                lambda camera: rendered_scores(raster, camera, made.features, classes, walk),
            )
            found.append(_resized(scores.argmax(dim=2), masks[view]))
        truth = [masks[view].flatten() for view in spec.labelled]
        ious = class_ious(torch.cat(found), torch.cat(truth), len(classes))
        mean = float(ious.nanmean())
        figures["mask_iou"] = None if math.isnan(mean) else mean  # masks that name no class
    return figures


def cosine_figures(features: Tensor, exact: Tensor, evidence: Tensor) -> dict[str, float | None]:
    """How near the features [P, F] are to the exact ones, over the splats that the exact run saw.

    The mean weighted by evidence, the plain mean, and the quantile below which LOW_QUANTILE of the splats lie. A
    splat that this run did not see counts zero. None where the exact run saw nothing.
    """
    nothing: dict[str, float | None] = {"cosine": None, "cosine_plain": None, "cosine_q05": None}
    if not exact.shape[0]:
        return nothing
    parts, seen = [], []
    for first in range(0, exact.shape[0], ROWS):
        one, other = features[first : first + ROWS].float(), exact[first : first + ROWS].float()
        parts.append(torch.nn.functional.cosine_similarity(one, other, dim=1).double())
        seen.append((other != 0).any(dim=1))
    chosen = torch.cat(seen)
    cosines, weights = torch.cat(parts)[chosen], evidence[chosen].double()
    if not float(weights.sum()) > 0:
        return nothing
    return {
        "cosine": float((cosines * weights).sum() / weights.sum()),
        "cosine_plain": float(cosines.mean()),
        "cosine_q05": float(np.quantile(cosines.numpy(), LOW_QUANTILE)),
    }


def class_vectors(scene: Scene) -> Tensor:
    """The unit vectors [K, F] of the classes' words."""
    if scene.table is None:
        raise ValueError("labels come with a table of their words")
    return torch.as_tensor(TableEncoder.open(scene.table).encode(scene.classes))


def labelled_masks(scene: Scene, cameras: Cameras) -> dict[str, Tensor]:
    """Camera -> its [h, w] i64 of class numbers, as `liftcore.io.class_masks.read_masks` has it."""
    if scene.labels is None:
        raise ValueError("there are no labels")
    masks = read_masks(scene.labels, len(scene.classes))
    return {camera: masks[view] for view, camera in cameras_of_views(masks, cameras).items()}


def _resized(labels: Tensor, mask: Tensor) -> Tensor:
    """The labels [H, W] at the centres of the mask's pixels, flat."""
    rows = ((2 * torch.arange(mask.shape[0]) + 1) * labels.shape[0]) // (2 * mask.shape[0])
    columns = ((2 * torch.arange(mask.shape[1]) + 1) * labels.shape[1]) // (2 * mask.shape[1])
    return labels[rows][:, columns].flatten()


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


def main() -> int:
    """Make the run that is described on stdin."""
    try:
        figures = measured(pickle.load(sys.stdin.buffer))
    except SplatliftError as error:
        print(json.dumps({"error": str(error), "kind": error.kind}))
        return BAD_INPUT
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
