"""Speed against accuracy on a scene of the user's: ``speed``, presets, smoothness, aggregation, in a budget of time.

Each run is a process of its own (``python -m liftcore.evaluate.tradeoff``: a pickled `RunSpec` on stdin, figures as
JSON on stdout), so that its memory is its own. Time is processor time: on a machine that others use too it says what
a run costs, where wall time says who else ran.
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
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from liftcore.errors import InvalidInput, InvalidSettings, SplatliftError, Unavailable
from liftcore.evaluate.accuracy import centred_cosines, cosine_figures, rendered_scores, shared_pixels
from liftcore.evaluate.class_masks import read_masks
from liftcore.evaluate.hardware import hardware, peak_memory
from liftcore.evaluate.ranking import accuracy_of, choose
from liftcore.io.cameras import read_cameras
from liftcore.io.remote import local_path, local_paths
from liftcore.lifting.files import open_files
from liftcore.lifting.pipeline import lift
from liftcore.lifting.planning.views import spread
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.query.ask import ask
from liftcore.query.objects import objects
from liftcore.query.question import Query
from liftcore.query.render import view_mask
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.raster import open_raster
from liftcore.runtime.arguments import as_list
from liftcore.runtime.device import CPU, choose_device
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Progress, one_step
from liftcore.scene.cameras import Cameras
from liftcore.scene.drawing import in_photo
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views
from liftcore.text.table import TableEncoder
from liftcore.values.pack import Views, pair, read_features
from liftcore.values.settings import LiftSettings
from liftcore.values.views import cells_under

HOLD_OUT = 8  # every n-th view is held out of the lifts
LEAST_HELD_OUT = 6  # where there are three times as many: five that agree may do so by chance (1 of 32)
EXACT_OVER_DRAFT = 5.0  # how much longer an exact view takes, at most, as far as the budget is planned
EXACT_SHARE = 1 / 3  # of the budget, that the exact run may take
LEAST_VIEWS = 4
LONGEST = 86_400  # seconds that one run may take: longer, it hangs
APART = ("read", "digest", "compile")  # stages that the seconds of a lift leave out
BAD_INPUT = 2
MOST_PHRASES = 32  # that are asked for alone, each in
PHRASE_VIEWS = 4  # of the views that show it


@dataclass(frozen=True)
class Candidate:
    """Settings under comparison."""

    name: str
    kind: str  # "dial" or "preset"
    settings: dict[str, Any] = field(default_factory=dict)
    times: float = 1.0  # the seconds of the exact run, that it may take at most


EXACT = Candidate("exact", "dial", {"speed": "exact"})  # the settings of the order as they are
DRAFT = Candidate("draft", "dial", {"speed": "draft"})
CANDIDATES = (  # in the order in which a budget is spent; others than presets keep the order's
    EXACT,
    Candidate("fast", "dial", {"speed": "fast"}),
    Candidate("default", "preset", {"preset": "default"}, 1.6),
    Candidate("row-sum", "preset", {"preset": "row-sum"}),
    Candidate("tikhonov", "preset", {"preset": "tikhonov"}),
    DRAFT,
    Candidate("smooth", "preset", {"smoothness": "auto"}, 2.5),
    Candidate("aggregation", "preset", {"aggregation": True}, 2.5),
    Candidate("tikhonov + aggregation", "preset", {"preset": "tikhonov", "aggregation": True}, 2.5),
    Candidate("balanced", "dial", {"speed": "balanced"}),
    Candidate("front-mass", "preset", {"preset": "front-mass"}),
    Candidate("argmax", "preset", {"preset": "argmax"}),
    Candidate("centre", "preset", {"preset": "centre"}),
    Candidate("top-k", "preset", {"preset": "top-k"}, 1.5),  # walks tiles twice
    Candidate("mean", "preset", {"preset": "mean"}),
)


def candidates_of(settings: Mapping[str, Any]) -> list[Candidate]:
    """Those that the settings of an order allow, `EXACT` first; of two whose lifts would be the same the first."""
    lifts: dict[str, Candidate] = {}
    LiftSettings.of(**{**settings, **EXACT.settings})
    for candidate in CANDIDATES:
        made = _allowed(settings, candidate)
        if made is not None:
            lifts.setdefault(made.model_dump_json(exclude={"preset", "speed"}), candidate)
    return list(lifts.values())


def _allowed(settings: Mapping[str, Any], candidate: Candidate) -> LiftSettings | None:
    try:
        return LiftSettings.of(**{**settings, **candidate.settings})
    except InvalidSettings:  # as reliability without the robust step, which a preset has
        return None


@dataclass(frozen=True)
class SceneFiles:
    """The files, and what to judge by.

    Raises:
        InvalidInput: labels without the words of their classes.
    """

    splats: Path  # any may be given as text
    cameras: Path
    features: tuple[Path, ...]
    labels: Path | None = None  # masks of views, VIEW/mask [h, w] int: numbers of classes, -1 none
    table: Path | None = None  # text embeddings
    classes: tuple[str, ...] = ()  # the words of the classes, in the order of their numbers

    def __post_init__(self) -> None:
        for name in ("splats", "cameras", "labels", "table"):
            path = getattr(self, name)
            if path is not None or name in ("splats", "cameras"):
                object.__setattr__(self, name, local_path(path, name))  # pyright: ignore[reportArgumentType]: None too
        object.__setattr__(self, "features", tuple(local_paths(self.features, "features")))
        object.__setattr__(self, "classes", tuple(as_list(self.classes)))
        if self.labels is not None and (self.table is None or not self.classes):
            raise InvalidInput("labels", expected="a table and the classes' words beside them", got="no words")

    def truth(self, cameras: Cameras) -> tuple[dict[str, Tensor], Tensor]:
        """Camera -> its class numbers [h, w] i64, and the unit vectors [K, F] of the classes' words."""
        if self.labels is None or self.table is None:
            return {}, torch.empty(0, 0, dtype=torch.float32)
        masks = read_masks(self.labels, len(self.classes))
        by_camera = {camera: masks[view] for view, camera in cameras_of_views(masks, cameras).items()}
        return by_camera, torch.as_tensor(TableEncoder.open(self.table).encode(self.classes))


@dataclass(frozen=True)
class RunSpec:
    """One run in a process of its own."""

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
    """Measure what fits the budget, and choose.

    Args:
        budget: seconds. The exact run is made whatever it is, from few views if need be.
        settings: of all runs, beside what they compare.
        kernel: of the splats, to compile what the runs load before the budget begins: else the first of a kind on a
            machine eats it up.

    Returns:
        Plain numbers: the ``runs``, what was ``skipped`` for want of time, what the settings ``refused``, which
        ``views`` were lifted, and the ``choice``.

    Raises:
        InvalidInput: the scene lacks what is needed; or whatever a lift refuses.
        Unavailable: a run did not end within a day.
    """
    candidates = candidates_of(settings)
    if kernel is not None:
        device = choose_device(settings.get("device", "auto"))
        with one_step(progress, "compile"):
            for candidate in candidates:
                warm_up_lift(kernel, device, LiftSettings.of(**{**settings, **candidate.settings}))
    progress("tradeoff", 0, len(candidates), "runs")
    start, runs, judged, skipped = time.monotonic(), [], [], []
    with scratch_folder("splatlift-tradeoff-") as folder:
        spec = _plan_runs(scene, settings, threads, folder)
        lifted = len(spec.lifted)
        spec = _fitting(spec, budget)
        for number, candidate in enumerate(candidates):
            if candidate is EXACT or time.monotonic() - start + candidate.times * runs[0]["process_s"] <= budget:
                named = {
                    "name": candidate.name,
                    "kind": candidate.kind,
                    "options": {**settings, **candidate.settings},
                }
                found = _run(spec, candidate)
                judged.append(found.pop("judged"))
                runs.append(named | found | accuracy_of(judged[-1]))
                if runs[0]["cosine"] is None:  # no run could be set beside the exact one
                    got = "an exact run that gave no splat a feature"
                    hint = "splats and cameras must share their frame, and features must not be zero"
                    raise InvalidInput("features", expected="views that lift", got=got, hint=hint)
            else:
                skipped.append(candidate.name)
            progress("tradeoff", number + 1, len(candidates), "runs")
    for run in runs:
        for name in ("wall", "cpu", "wall_with_reading", "cpu_with_reading"):
            run[f"{name}_ratio"] = runs[0][f"{name}_s"] / run[f"{name}_s"]
    return {
        "runs": runs,
        "skipped": skipped,
        "refused": [candidate.name for candidate in CANDIDATES if _allowed(settings, candidate) is None],
        "choice": choose(runs, judged),
        "views": {"lifted": len(spec.lifted), "of": lifted, "held_out": len(spec.held_out)},
        "labelled_views": len(spec.labelled),
        "budget_s": budget,
        "seconds": time.monotonic() - start,
        "date": datetime.now(UTC).date().isoformat(),
        "hardware": hardware(),
    }


def _plan_runs(scene: SceneFiles, settings: Mapping[str, Any], threads: int | None, folder: Path) -> RunSpec:
    """The views of each kind. Every HOLD_OUT-th view is held out, and what has masks is."""
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
    own = {**settings, "view_stride": 1}  # the views are named
    return RunSpec(scene, own, tuple(lifted), tuple(held_out), tuple(sorted(masks)), threads, folder, False)


def hold_out(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Of the views with features those that are lifted, and those that judge; they lie between each other."""
    step = min(HOLD_OUT, max(3, len(names) // LEAST_HELD_OUT))
    judges = list(names[step // 2 :: step] if len(names) >= HOLD_OUT else names[1:2])
    return [name for name in names if name not in set(judges)], judges


def _fitting(spec: RunSpec, budget: float) -> RunSpec:
    """The order with so few views that the exact run fits the budget, by what the draft takes."""
    probe = _run(replace(spec, held_out=(), labelled=()), DRAFT)
    exact = EXACT_OVER_DRAFT * probe["wall_s"] * len(spec.lifted) / probe["views"]
    keep = EXACT_SHARE * budget / exact
    step = 1 if keep >= 1 else min(round(1 / keep), len(spec.lifted) // LEAST_VIEWS)
    return replace(spec, lifted=spec.lifted[:: max(1, step)])


def _run(spec: RunSpec, candidate: Candidate) -> dict[str, Any]:
    """The figures of one candidate, from its own process."""
    own = replace(spec, settings={**spec.settings, **candidate.settings}, exact=candidate is EXACT)
    command, start = [sys.executable, "-m", "liftcore.evaluate.tradeoff"], time.monotonic()
    try:
        done = subprocess.run(command, input=pickle.dumps(own), capture_output=True, check=False, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        hint = "lift fewer views (view_stride=n; on the command line --set view_stride=n)"
        raise Unavailable(candidate.name, expected=f"an end within {LONGEST} s", got="none yet", hint=hint) from None
    answer = json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else {}
    if "error" in answer:
        fault = Unavailable if answer["kind"] == Unavailable.kind else InvalidInput
        raise fault(candidate.name, expected="a scene that lifts", got=answer["error"])
    if done.returncode != 0:
        told = done.stderr.decode(errors="replace").strip()[-300:]
        raise RuntimeError(f"{candidate.name} ended with {done.returncode}: {told}")
    return {**answer, "process_s": time.monotonic() - start}


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
    made = made.cpu()
    figures = {
        "cpu_s": seconds["cpu"],
        "wall_s": seconds["wall"],
        "cpu_with_reading_s": seconds["cpu"] + read["cpu"],
        "wall_with_reading_s": seconds["wall"] + read["wall"],
        "peak_memory_bytes": peak_memory(),
        "load": None if sys.platform == "win32" else os.getloadavg()[0],
        "views": len(made.metadata.views),
        "settings": made.metadata.settings.model_dump(mode="json"),
        "seen_share": float(made.seen.float().mean()),
        "timings": {name: value for name, value in made.metadata.timings.items() if name not in APART},
    }
    return figures | _judge(spec, splats, cameras, features, made)


def _judge(spec: RunSpec, splats: Splats, cameras: Cameras, features: Views, made: LiftResult) -> dict[str, Any]:
    """How near the run is to the exact one, and what `liftcore.evaluate.ranking` judges it by, a view at a time."""
    raster, params = open_raster(splats, CPU, spec.threads), made.metadata.settings.render_params
    cosines = centred_cosines(
        raster, [(cameras[view], features[view]) for view in spec.held_out], made.features, params
    )
    judged: dict[str, Any] = {"centred_cosine": cosines, "intersections": [], "unions": [], "phrase_iou": []}
    if spec.labelled:
        masks, classes = spec.scene.truth(cameras)
        for view in spec.labelled:
            scores = in_photo(cameras[view], lambda of: rendered_scores(raster, of, made.features, classes, params))
            shared, joined = shared_pixels(_resized(scores.argmax(dim=2), masks[view]), masks[view], len(classes))
            judged["intersections"].append(shared.tolist())
            judged["unions"].append(joined.tolist())
        judged["phrase_iou"] = _phrase_ious(spec, Scene(made, splats, cameras), masks)
    return {**cosine_figures(made.features, *_reference(spec, made)), "judged": judged}


def _phrase_ious(spec: RunSpec, scene: Scene, masks: Mapping[str, Tensor]) -> list[float]:
    """IoU of the masks that words give, each class asked for alone, in labelled views that show it."""
    assert spec.scene.table is not None  # there are labels
    encoder, ious = TableEncoder.open(spec.scene.table), list[float]()
    showing = [
        [view for view in spec.labelled if (masks[view] == number).any()] for number in range(len(spec.scene.classes))
    ]
    for number in evenly_spaced([number for number, views in enumerate(showing) if views], MOST_PHRASES):
        answer = ask(scene, Query.of(spec.scene.classes[number]), encoder)
        found = cache(partial(objects, scene, answer))  # once for all views, if they ask for it
        for view in evenly_spaced(showing[number], PHRASE_VIEWS):
            seen = view_mask(scene, answer, view, group=lambda *_, found=found: found())
            mine, real = _resized(torch.from_numpy(seen.mask), masks[view]), masks[view] == number
            ious.append(int((mine & real).sum()) / int((mine | real).sum()))
    return ious


def evenly_spaced(items: Sequence[Any], most: int) -> list[Any]:
    """As many of them, evenly spread."""
    return [items[int(place)] for place in spread(len(items), min(most, len(items)))]


def _reference(spec: RunSpec, made: LiftResult) -> tuple[Tensor, Tensor]:
    """Features [P, F] and total weight [P] of the exact run; empty before it."""
    from safetensors.torch import load_file, save_file

    path = spec.reference / "exact.safetensors"
    if spec.exact:
        save_file({"features": made.features, "total_weight": made.total_weight}, path)
    if not path.is_file():
        return made.features[:0], made.total_weight[:0]
    kept = load_file(path)
    return kept["features"], kept["total_weight"]


def _resized(labels: Tensor, mask: Tensor) -> Tensor:
    """The labels [H, W] at the centres of the mask's pixels, [h, w]."""
    rows, columns = (
        cells_under(torch.arange(size), size, cells) for size, cells in zip(mask.shape, labels.shape, strict=True)
    )
    return labels[rows][:, columns]


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
