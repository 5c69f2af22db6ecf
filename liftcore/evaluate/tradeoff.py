"""Speed against accuracy on a user's scene: ``quality``, presets, smoothness, aggregation, in a budget of time.

Each run is a process of its own (``python -m liftcore.evaluate.tradeoff``: a pickled `RunSpec` on stdin, figures as
JSON on stdout), so that its memory is measured alone. Time is CPU time, as wall time depends on other programs of the
machine.
"""

import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.evaluate.accuracy import centred_cosines, cosine_figures, shared_pixels
from liftcore.evaluate.class_masks import read_masks
from liftcore.evaluate.hardware import hardware, peak_memory
from liftcore.evaluate.ranking import accuracy_of, choose
from liftcore.io.cameras import read_cameras
from liftcore.lifting.files import open_files
from liftcore.lifting.pipeline import lift
from liftcore.lifting.planning.views import evenly_spaced
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import view_mask
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.raster import open_raster
from liftcore.runtime.arguments import as_list, as_path, as_paths
from liftcore.runtime.device import CPU
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Progress, one_step
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.drawing import in_photo
from liftcore.scene.kernel import Kernel, scale_count
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views
from liftcore.text.table import TableEncoder
from liftcore.values.pack import Views, pair, read_features
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions, cells_under

HOLD_OUT = 8  # every n-th view is held out of the lifts
LEAST_HELD_OUT = 6  # if there are three times as many: five views may agree by chance (1 of 32)
EXACT_OVER_DRAFT = 5.0  # assumed maximum ratio of the time of an exact view to that of a draft
EXACT_SHARE = 1 / 3  # of the budget, that the exact run may take
LEAST_VIEWS = 4
LONGEST = 86_400  # seconds that one run may take: longer, it hangs
UNTIMED = ("read", "digest", "compile")  # stages that are not part of a lift's seconds
BAD_INPUT = 2
MOST_PHRASES = 32  # queries of a single class, each in
PHRASE_VIEWS = 4  # views that show it


@dataclass(frozen=True)
class Candidate:
    """Settings under comparison."""

    name: str
    kind: str  # "dial" or "preset"
    settings: dict[str, Any] = field(default_factory=dict)
    times: float = 1.0  # assumed maximum ratio of its seconds to the exact run's


EXACT = Candidate("exact", "dial", {"quality": "exact"})  # the caller's settings unchanged
DRAFT = Candidate("draft", "dial", {"quality": "draft"})
CANDIDATES = (  # in the order in which the budget is spent; a candidate overrides some of the caller's settings
    EXACT,
    Candidate("fast", "dial", {"quality": "fast"}),
    Candidate("default", "preset", {"preset": "default"}, 1.6),
    Candidate("row-sum", "preset", {"preset": "row-sum"}),
    Candidate("tikhonov", "preset", {"preset": "tikhonov"}),
    DRAFT,
    Candidate("smoothness 1", "preset", {"smoothness": 1.0}, 2.0),
    Candidate("smoothness 4", "preset", {"smoothness": 4.0}, 2.0),
    Candidate("tikhonov + aggregation", "preset", {"preset": "tikhonov", "aggregation": True}, 2.5),
    Candidate("balanced", "dial", {"quality": "balanced"}),
)


def candidates_of(settings: Mapping[str, Any]) -> list[Candidate]:
    """List the candidates, `EXACT` first, without those whose lift would be the same."""
    lifts: dict[str, Candidate] = {}
    for candidate in CANDIDATES:
        lift_settings = LiftSettings.of(**{**settings, **candidate.settings})
        lifts.setdefault(lift_settings.model_dump_json(exclude={"preset", "quality"}), candidate)
    return list(lifts.values())


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene, and labels for the evaluation.

    Raises:
        InvalidInput: labels without the words of their classes.
    """

    splats: Path  # or str, as the others
    cameras: Path
    features: tuple[Path, ...]
    labels: Path | None = None  # masks of views, VIEW/mask [h, w] int: numbers of classes, -1 none
    table: Path | None = None  # text embeddings
    classes: tuple[str, ...] = ()  # the words of the classes, in the order of their numbers

    def __post_init__(self) -> None:
        for name in ("splats", "cameras", "labels", "table"):
            path = getattr(self, name)
            if path is not None or name in ("splats", "cameras"):
                object.__setattr__(self, name, as_path(path, name))  # pyright: ignore[reportArgumentType]: None too
        object.__setattr__(self, "features", tuple(as_paths(self.features, "features")))
        object.__setattr__(self, "classes", tuple(as_list(self.classes)))
        if self.labels is not None and (self.table is None or not self.classes):
            raise InvalidInput("labels", expected="a table and the classes' words beside them", got="no words")

    def truth(self, cameras: Cameras) -> tuple[dict[str, Tensor], Tensor]:
        """Read labels: camera -> class numbers [h, w] i64, and the unit vectors [K, F] of the classes' words."""
        if self.labels is None or self.table is None:
            return {}, torch.empty(0, 0, dtype=torch.float32)
        masks = read_masks(self.labels, len(self.classes))
        by_camera = {camera: masks[view] for view, camera in cameras_of_views(masks, cameras).items()}
        return by_camera, torch.as_tensor(TableEncoder.open(self.table).encode(self.classes))


@dataclass(frozen=True)
class RunSpec:
    """The input of one run, which is a process of its own."""

    scene: SceneFiles
    settings: dict[str, Any]
    lifted: tuple[str, ...]  # views
    held_out: tuple[str, ...]  # views with features
    labelled: tuple[str, ...]  # views with masks, none of them lifted
    threads: int | None
    reference: Path  # a folder: the exact run writes its features there, the others read them
    exact: bool


def compare(
    scene: SceneFiles,
    budget: float,
    settings: Mapping[str, Any],
    threads: int | None,
    progress: Progress,
    kernel: Kernel | None = None,
) -> dict[str, Any]:
    """Measure the runs that fit the budget, and choose one.

    Args:
        budget: seconds. The exact run is always made, from few views if necessary.
        settings: of all runs, besides those that differ.
        kernel: of the splats, to compile all kernels before the budget begins: else compilation on a new machine
            uses it up.

    Returns:
        Plain numbers: the ``runs``, the names ``over_budget`` for lack of time, the counts of ``views``, and the
        ``choice``.

    Raises:
        InvalidInput: the scene lacks an input, or a lift rejects one.
        Unavailable: a run did not end within a day.
    """
    candidates = candidates_of(settings)
    if kernel is not None:
        with one_step(progress, "compile"):
            for candidate in candidates:
                compile_lift(kernel, LiftSettings.of(**{**settings, **candidate.settings}))
    progress("tradeoff", 0, len(candidates), "runs")
    start, runs, accuracies, over_budget = time.monotonic(), [], [], []
    with scratch_folder("splatlift-tradeoff-") as folder:
        spec = _plan_runs(scene, settings, threads, folder)
        lifted = len(spec.lifted)
        spec = _fitting(spec, budget)
        for number, candidate in enumerate(candidates):
            if candidate is EXACT or time.monotonic() - start + candidate.times * runs[0]["process_s"] <= budget:
                entry = {
                    "name": candidate.name,
                    "kind": candidate.kind,
                    "options": {**settings, **candidate.settings},
                }
                figures = _run(spec, candidate)
                accuracies.append(figures.pop("accuracies"))
                runs.append(entry | figures | accuracy_of(accuracies[-1]))
                if runs[0]["cosine"] is None:  # no run could be compared with the exact one
                    got = "an exact run that gave no splat a feature"
                    hint = "splats and cameras must share their frame, and features must not be zero"
                    raise InvalidInput("features", expected="views that lift", got=got, hint=hint)
            else:
                over_budget.append(candidate.name)
            progress("tradeoff", number + 1, len(candidates), "runs")
    for run in runs:
        for name in ("wall", "cpu", "wall_with_reading", "cpu_with_reading"):
            run[f"{name}_ratio"] = runs[0][f"{name}_s"] / run[f"{name}_s"]
    return {
        "runs": runs,
        "over_budget": over_budget,
        "choice": choose(runs, accuracies),
        "views": {"lifted": len(spec.lifted), "of": lifted, "held_out": len(spec.held_out)},
        "labelled_views": len(spec.labelled),
        "budget_s": budget,
        "seconds": time.monotonic() - start,
        "date": datetime.now(UTC).date().isoformat(),
        "hardware": hardware(),
    }


def _plan_runs(scene: SceneFiles, settings: Mapping[str, Any], threads: int | None, folder: Path) -> RunSpec:
    """Split the views: every HOLD_OUT-th view is held out, and so are views with masks."""
    cameras = read_cameras(scene.cameras)
    packs = pair(read_features(*scene.features), cameras)[0]
    names = packs.views[:: LiftSettings.of(**settings).view_stride]
    masks, classes = scene.truth(cameras)
    if scene.labels is not None:
        if classes.shape[1] != packs.channels:
            expected = f"{packs.channels} channels, as the features"
            raise InvalidInput("table", expected=expected, got=f"{classes.shape[1]}")
        if not masks:
            raise InvalidInput("labels", expected="VIEW/mask of some camera", got="none")
    lifted, held_out = hold_out([name for name in names if name not in masks])
    if not lifted:
        raise InvalidInput("features", expected="views besides those with labels", got=f"{len(names)} views")
    run_settings = {**settings, "view_stride": 1}  # the views are named
    return RunSpec(scene, run_settings, tuple(lifted), tuple(held_out), tuple(sorted(masks)), threads, folder, False)


def hold_out(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split views with features into lifted and held-out ones, which alternate regularly."""
    step = min(HOLD_OUT, max(3, len(names) // LEAST_HELD_OUT))
    held_out = list(names[step // 2 :: step] if len(names) >= HOLD_OUT else names[1:2])
    return [name for name in names if name not in set(held_out)], held_out


def _fitting(spec: RunSpec, budget: float) -> RunSpec:
    """Reduce the views so that the exact run fits the budget, estimated from the time of a draft."""
    probe = _run(replace(spec, held_out=(), labelled=()), DRAFT)
    exact = EXACT_OVER_DRAFT * probe["wall_s"] * len(spec.lifted) / probe["views"]
    keep = EXACT_SHARE * budget / exact
    step = 1 if keep >= 1 else min(round(1 / keep), len(spec.lifted) // LEAST_VIEWS)
    return replace(spec, lifted=spec.lifted[:: max(1, step)])


def _run(spec: RunSpec, candidate: Candidate) -> dict[str, Any]:
    """Run one candidate in a process of its own, and return its figures."""
    run_spec = replace(spec, settings={**spec.settings, **candidate.settings}, exact=candidate is EXACT)
    command, start = [sys.executable, "-m", "liftcore.evaluate.tradeoff"], time.monotonic()
    try:
        process = subprocess.run(
            command, input=pickle.dumps(run_spec), capture_output=True, check=False, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        hint = "lift fewer views (view_stride=n; on the command line --set view_stride=n)"
        raise Unavailable(candidate.name, expected=f"an end within {LONGEST} s", got="none yet", hint=hint) from None
    answer = json.loads(process.stdout.splitlines()[-1]) if process.stdout.strip() else {}
    if "error" in answer:
        fault = Unavailable if answer["kind"] == Unavailable.kind else InvalidInput
        raise fault(candidate.name, expected="a scene that lifts", got=answer["error"])
    if process.returncode != 0:
        stderr = process.stderr.decode(errors="replace").strip()[-300:]
        raise RuntimeError(f"{candidate.name} ended with {process.returncode}: {stderr}")
    return {**answer, "process_s": time.monotonic() - start}


def compile_lift(kernel: Kernel, settings: LiftSettings) -> None:
    """Lift three splats, which compiles what lifts with these settings run, or loads it from the disk."""
    means, scales = [[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]], np.zeros((3, scale_count(kernel)))
    beta = np.zeros(3) if kernel is Kernel.BETA else None
    splats = Splats(np.array(means), np.ones((3, 4)), scales, np.zeros(3), kernel, beta=beta)
    labels = np.arange(64).reshape(8, 8) % 3
    views = {"a": Regions(labels, np.eye(3)), "b": Regions(labels, np.eye(3)), "c": FeatureGrid(np.ones((2, 2, 3)))}
    cameras = {name: Camera.pinhole(name, 8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(4)) for name in views}
    every_level = settings.model_copy(update={"levels": "rows"})
    lift(splats, cameras, views, every_level, threads=1, progress=False, on_plan=lambda _: None)


def measure_run(spec: RunSpec) -> dict[str, Any]:
    """Lift, and return the figures of the run and of its features."""
    settings, scene = LiftSettings.of(**spec.settings), spec.scene
    cpu, wall = time.process_time(), time.perf_counter()
    splats, cameras, packs = open_files(scene.splats, scene.cameras, scene.features, settings)
    features = pair(packs, cameras)[0]
    lifted = features.seen_by({view: view for view in spec.lifted if view in features}, cameras)
    reading = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    compile_lift(splats.kernel, settings)  # the lift's own then takes no time
    cpu, wall = time.process_time(), time.perf_counter()
    result = lift(splats, cameras, lifted, settings, threads=spec.threads)
    seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    result = result.cpu()
    figures = {
        "cpu_s": seconds["cpu"],
        "wall_s": seconds["wall"],
        "cpu_with_reading_s": seconds["cpu"] + reading["cpu"],
        "wall_with_reading_s": seconds["wall"] + reading["wall"],
        "peak_memory_bytes": peak_memory(),
        "load": None if sys.platform == "win32" else os.getloadavg()[0],
        "views": len(result.metadata.views),
        "settings": result.metadata.settings.model_dump(mode="json"),
        "feature_share": float(result.has_feature.float().mean()),
        "timings": {name: value for name, value in result.metadata.timings.items() if name not in UNTIMED},
    }
    return figures | _accuracy_figures(spec, splats, cameras, features, result)


def _accuracy_figures(
    spec: RunSpec, splats: Splats, cameras: Cameras, features: Views, result: LiftResult
) -> dict[str, Any]:
    """Compare the run with the exact one, and measure the inputs of `liftcore.evaluate.ranking`, a view at a time."""
    raster, params = open_raster(splats, CPU, spec.threads), result.metadata.settings.compositing
    cosines = centred_cosines(
        raster, [(cameras[view], features[view]) for view in spec.held_out], result.features, params
    )
    accuracies: dict[str, Any] = {"centred_cosine": cosines, "intersections": [], "unions": [], "phrase_iou": []}
    if spec.labelled:
        masks, classes = spec.scene.truth(cameras)
        # Rendering is linear: (A X) C^T = A (X C^T). The norm of A X is left out, as no argmax depends on it.
        products = result.features.to(torch.float32) @ classes.to(torch.float32).T
        for view in spec.labelled:
            scores = in_photo(cameras[view], lambda of: raster.render(of, products, params))
            shared, unions = shared_pixels(_resized(scores.argmax(dim=2), masks[view]), masks[view], len(classes))
            accuracies["intersections"].append(shared.tolist())
            accuracies["unions"].append(unions.tolist())
        accuracies["phrase_iou"] = _phrase_ious(spec, Scene(result, splats, cameras), masks)
    return {**cosine_figures(result.features, *_reference(spec, result)), "accuracies": accuracies}


def _phrase_ious(spec: RunSpec, scene: Scene, masks: Mapping[str, Tensor]) -> list[float]:
    """Compute the IoU of masks of queries for each class alone, in labelled views that show it."""
    assert spec.scene.table is not None  # there are labels
    encoder, ious = TableEncoder.open(spec.scene.table), list[float]()
    showing = [
        [view for view in spec.labelled if (masks[view] == number).any()] for number in range(len(spec.scene.classes))
    ]
    for number in evenly_spaced([number for number, views in enumerate(showing) if views], MOST_PHRASES):
        answer = ask(scene, Query.of(spec.scene.classes[number]), encoder)
        for view in evenly_spaced(showing[number], PHRASE_VIEWS):
            answer_mask = view_mask(scene, answer, view)
            predicted, true = _resized(torch.from_numpy(answer_mask.mask), masks[view]), masks[view] == number
            ious.append(int((predicted & true).sum()) / int((predicted | true).sum()))
    return ious


def _reference(spec: RunSpec, result: LiftResult) -> tuple[Tensor, Tensor]:
    """Return features [P, F] and total weight [P] of the exact run; empty before it."""
    path, tensors = spec.reference / "exact.pt", (result.features, result.total_weight)
    if spec.exact:
        torch.save(tensors, path)
    return torch.load(path, weights_only=True) if path.is_file() else (tensors[0][:0], tensors[1][:0])


def _resized(labels: Tensor, mask: Tensor) -> Tensor:
    """Sample labels [H, W] at the centres of the mask's pixels, [h, w]."""
    rows, columns = (
        cells_under(torch.arange(size), size, cells) for size, cells in zip(mask.shape, labels.shape, strict=True)
    )
    return labels[rows][:, columns]


def main() -> int:
    """Run the `RunSpec` on stdin, and print its figures."""
    try:
        figures = measure_run(pickle.load(sys.stdin.buffer))
    except SplatliftError as error:
        print(json.dumps({"error": str(error), "kind": error.kind}))
        return BAD_INPUT
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
