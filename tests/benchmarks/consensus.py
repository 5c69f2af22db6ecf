"""Reweighting and aggregation under wrong masks: what each part gains, over scenes and seeds of mistakes.

    python -m tests.benchmarks.consensus DIR [--packs NAME ...] [--mistakes NAME ...] [--seeds N ...] [--json]

``DIR`` is `tabletop`, with its packs of 52, 26 and 13 views. ``--mistakes`` are made on its exact masks (13 views),
and on the tests' still life and small things (their words need the extra ``minilm``), with each seed. A row is a
scene: splat accuracy / mIoU of held-out views as `tests.benchmarks.tabletop` has them / the least IoU of a class, and
how well confidence and agreement of ``default`` rank splats by being right (AUROC). ``seconds`` are of the lift, over
those of ``row-sum``.

    python -m tests.benchmarks.consensus --generated M

The seconds and the memory of `mask_consensus` for M regions in a W that is made for it: 300,000 splats in a row, each
in 30 views, which part them on two levels.
"""

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

import liftcore as lc
from liftcore.device import CPU
from liftcore.evaluate.accuracy import class_ious, rendered_scores
from liftcore.features.pack import read_features
from liftcore.features.views import Regions, ViewFeatures
from liftcore.query.text import open_encoder
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Cameras
from liftcore.scene.kernel import Kernel
from liftcore.settings import LiftSettings
from liftcore.solve.consensus import mask_consensus
from liftcore.solve.weights import RegionWeights
from liftcore.warm_up import warm_up_lift
from tests.benchmarks.base import class_scores, command_line, splat_accuracy, tell
from tests.benchmarks.memory import high_water
from tests.benchmarks.tabletop import EVIDENCE_OVER, Tabletop
from tests.benchmarks.thresholds import in_cone
from tests.still_life.masks import Mistakes, mistaken_regions, observe, true_labels
from tests.still_life.objects import Piece, small_things
from tests.still_life.scene import still_life

HARD = Mistakes(merged=0.30, split=0.15, misnamed=0.10, unlabelled=0.06, noise=0.45)
MISTAKES = {
    "exact": (Mistakes(0, 0, 0, 0, 0, 0.3), 0.0),
    "usual": (Mistakes(), 0.0),
    "hard": (HARD, 0.0),
    "cone": (HARD, 0.9),  # all vectors drawn towards one direction, as CLIP's image vectors are
    "merged": (Mistakes(0.5, 0, 0, 0, 1.0), 0.0),
    "split": (Mistakes(0, 0.5, 0, 0, 1.0), 0.0),
    "misnamed": (Mistakes(0, 0, 0.3, 0, 1.0), 0.0),
}
PACKS = ("features_hard", "features", "features_clean", "grids")
AGGREGATED = {"aggregation": True}
SETTINGS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "robust": {"preset": "row-sum", "robust_steps": 1},
    "and reliability": {"preset": "default", "consensus": False},
    "default": {"preset": "default"},
    "huber": {"preset": "row-sum", "loss": "huber"},
    "default, huber": {"preset": "default", "loss": "huber"},
    "published": {"preset": "default", **AGGREGATED, "aggregation_clusters": "hdbscan", "aggregation_guard": False},
    "touching": {"preset": "default", **AGGREGATED, "aggregation_clusters": "touching"},
    "aggregated": {"preset": "default", **AGGREGATED},
}


@dataclass(frozen=True)
class Truth:
    """A scene with what is really there."""

    raster: CpuRaster
    cameras: Cameras
    classes: Tensor  # [K, F], unit
    splats: Tensor  # [P], the class of each
    counted: Tensor  # [P] bool
    masks: Mapping[str, Tensor]  # held-out view -> [H, W], classes

    def judge(self, lifted: lc.LiftResult) -> tuple[float, float, float]:
        """Splat accuracy, mIoU, and the least IoU of a class: a thing that vanishes has none."""
        params = lifted.settings.render_params
        maps = [
            rendered_scores(self.raster, self.cameras[v], lifted.features, self.classes, params) for v in self.masks
        ]
        best, shown = torch.stack([image.argmax(dim=2) for image in maps]), torch.stack(list(self.masks.values()))
        accuracy = splat_accuracy(class_scores(lifted.features, self.classes), self.splats, self.counted)
        best[shown < 0] = -1  # rays that meet nothing show no class
        ious = class_ious(best, shown, len(self.classes))
        return accuracy, float(ious.nanmean()), float(ious[~ious.isnan()].min())

    def ranked(self, lifted: lc.LiftResult, values: Tensor) -> float:
        """AUROC of values on splats for being right."""
        right = (class_scores(lifted.features, self.classes).argmax(dim=1) == self.splats.long())[
            self.counted
        ].numpy()
        ranks, hits = rankdata(values[self.counted].numpy()), int(right.sum())
        return float((ranks[right].sum() - hits * (hits + 1) / 2) / max(hits * (right.size - hits), 1))


def tabletop_truth(scene: Tabletop) -> Truth:
    """Of the tabletop scene."""
    return Truth(scene.raster, scene.cameras, scene.classes, scene.objects, scene.counted, scene.held_out)


def with_mistakes(scene: Tabletop, kind: str, seed: int, every: int = 4) -> dict[str, ViewFeatures]:
    """Every ``every``-th view of tabletop's exact masks, with mistakes."""
    packs, (mistakes, cone) = read_features(scene.folder / "features_clean.safetensors"), MISTAKES[kind]
    rng, made = np.random.default_rng(100 + seed), dict[str, ViewFeatures]()
    for view in packs.views[seed % every :: every]:
        exact = packs[view]
        assert isinstance(exact, Regions)
        regions = mistaken_regions(exact, mistakes, rng)
        made[view] = replace(regions, codebook=in_cone(regions.codebook, cone))
    return made


def still_life_scene(
    kind: str, seed: int, pieces: Sequence[Piece] | None = None
) -> tuple[Truth, dict[str, ViewFeatures]]:
    """The still life, or other pieces in its place, with mistakes, and its truth."""
    made, encoder, (mistakes, cone) = still_life(seed, pieces=pieces), open_encoder("minilm"), MISTAKES[kind]
    raster = CpuRaster(made.splats)
    seen = observe(made, raster, encoder, mistakes, seed)
    views: dict[str, ViewFeatures] = {
        v: replace(part, codebook=in_cone(part.codebook, cone)) for v, part in seen.items()
    }
    held_out = {view: torch.from_numpy(true_labels(made, raster, view)[0]) for view in made.held_out}
    evidence = lc.region_weights(made.splats, made.cameras, views, preset="row-sum")
    counted = torch.zeros(made.splats.count)
    counted[evidence.evidence_splats.long()] = evidence.evidence
    classes = torch.nn.functional.normalize(torch.from_numpy(np.asarray(encoder.encode(made.things))).float(), dim=1)
    things = torch.from_numpy(made.splat_things)
    return Truth(raster, made.cameras, classes, things, counted > EVIDENCE_OVER, held_out), views


def measured(name: str, truth: Truth, views: Mapping[str, ViewFeatures], settings: Iterable[str]) -> dict[str, Any]:
    """A row: each setting's accuracy / mIoU, ranking, and seconds over those of row-sum."""
    row: dict[str, Any] = {"scene": f"{name}, {len(views)} views"}
    seconds: dict[str, float] = {}
    for label in settings:
        start = time.perf_counter()
        lifted = lc.lift(truth.raster.splats, truth.cameras, views, certificate_rays=0, **SETTINGS[label])
        seconds[label] = time.perf_counter() - start
        row[label] = " / ".join(f"{value:.4f}" for value in truth.judge(lifted))
        if label == "default" and lifted.confidence is not None:
            row["confidence"], row["agreement"] = (
                truth.ranked(lifted, values) for values in (lifted.confidence, lifted.agreement)
            )
    if {"default", "row-sum"} <= seconds.keys():
        row["seconds"] = seconds["default"] / seconds["row-sum"]
    return row


def rows_of(
    folder: Path, packs: Iterable[str], strides: Iterable[int], mistakes: Iterable[str], seeds: Iterable[int],
    settings: Iterable[str],
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Packs of tabletop, then mistakes on it, on the still life and on small things."""
    scene, settings = Tabletop(folder), list(settings)
    truth = tabletop_truth(scene)
    for pack in packs:
        whole = read_features(folder / f"{pack}.safetensors")
        for stride in strides if pack != "grids" else (1,):
            yield measured(pack, truth, {view: whole[view] for view in whole.views[::stride]}, settings)
    for kind in mistakes:
        for seed in seeds:
            yield measured(f"tabletop, {kind} {seed}", truth, with_mistakes(scene, kind, seed), settings)
            for name, pieces in (("still life", None), ("small things", small_things())):
                own, views = still_life_scene(kind, seed, pieces)
                yield measured(f"{name}, {kind} {seed}", own, views, settings)


def generated(
    regions: int, splats: int = 300_000, seen: int = 30, level: int = 50
) -> tuple[RegionWeights, np.ndarray]:
    """W of so many regions, half of them on each of two levels, of views that see a stretch of splats; and levels."""
    rng, views = np.random.default_rng(0), max(regions // (2 * level), seen)
    place = np.sort(rng.random(splats))
    first = (place * (views - seen)).astype(np.int64)[:, None] + np.arange(seen)
    inside = (place[:, None] * views - first + seen) / (2 * seen) % 1.0  # where in the view's picture
    wobble = rng.normal(0, 0.1 / level, first.shape)
    cut = ((inside + wobble) % 1.0 * level).astype(np.int64) % level
    whole = 2 * level * first
    region = np.stack([whole + cut, whole + level + cut // 3], axis=2).reshape(splats, -1)
    indptr = torch.arange(splats + 1) * region.shape[1]
    every, one = torch.arange(splats, dtype=torch.int32), torch.ones(splats)
    entries = torch.from_numpy(region.astype(np.int32).ravel())
    offsets = torch.arange(views + 1) * 2 * level
    W = RegionWeights(every, indptr, entries, torch.ones(entries.shape[0]), every, one, offsets)
    return W, np.tile(np.repeat([0, 1], level), views).astype(np.int8)


def of_generated(regions: int) -> Iterator[dict[str, Any]]:
    """A row: what mask consensus takes."""
    W, levels = generated(regions)
    warm_up_lift(Kernel.GAUSSIAN_3D, CPU, LiftSettings.of(preset="default"))
    Path("/proc/self/clear_refs").write_text("5")  # the most that was held so far is what is held now
    before, start, busy = high_water(os.getpid()), time.perf_counter(), time.process_time()
    mask_consensus(W, levels)
    seconds = {"seconds": time.perf_counter() - start, "processor seconds": time.process_time() - busy}
    yield {"regions": levels.size, "entries": W.region.shape[0], **seconds, "MB": high_water(os.getpid()) - before}


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.consensus",
        __doc__,
        ("folder", {"type": Path, "nargs": "?"}),
        ("--generated", {"type": int, "metavar": "M"}),
        ("--packs", {"nargs": "*", "default": PACKS, "choices": PACKS}),
        ("--strides", {"nargs": "*", "type": int, "default": (1, 2, 4)}),
        ("--mistakes", {"nargs": "*", "default": tuple(MISTAKES), "choices": tuple(MISTAKES)}),
        ("--seeds", {"nargs": "*", "type": int, "default": (7, 8)}),
        ("--settings", {"nargs": "*", "default": tuple(SETTINGS), "choices": tuple(SETTINGS)}),
    )
    chosen = parser.parse_args()
    if chosen.generated:
        made = of_generated(chosen.generated)
    elif chosen.folder:
        made = rows_of(chosen.folder, chosen.packs, chosen.strides, chosen.mistakes, chosen.seeds, chosen.settings)
    else:
        parser.error("a folder, or --generated M")
    tell(made, as_json=chosen.json)


if __name__ == "__main__":
    main()
