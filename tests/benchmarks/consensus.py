"""Reweighting and aggregation under wrong masks: what each part gains, over scenes and seeds of mistakes.

    python -m tests.benchmarks.consensus DIR [--packs NAME ...] [--strides N ...] [--mistakes NAME ...]
        [--seeds N ...] [--settings NAME ...] [--json]

``DIR`` is `tabletop`, with its packs of 52, 26 and 13 views. ``--mistakes`` are made on its exact masks (13 views),
and on the tests' still life and small things, with each seed. A row is a
scene: splat accuracy / mIoU of held-out views as `tests.benchmarks.tabletop` has them / the least IoU of a class, and
how well the confidence of ``default`` ranks splats by being right (AUROC). ``seconds`` are of the
lift, over those of ``row-sum``.
"""

import time
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor
from torch.nn.functional import normalize

import liftcore as lc
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.text import TextEncoder, open_encoder
from liftcore.values.views import ViewFeatures
from tests.benchmarks.base import command_line, print_rows, read_pack
from tests.benchmarks.tabletop import Truth, evaluated_splats, tabletop
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
SETTINGS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "default": {"preset": "default"},
    "published": {"preset": "default", "aggregation": True},
}


def with_mistakes(folder: Path, kind: str, seed: int, stride: int = 4) -> dict[str, ViewFeatures]:
    """Every ``stride``-th view of tabletop's exact masks, with mistakes."""
    packs, (mistakes, cone) = lc.read_features(folder / "features_clean.safetensors"), MISTAKES[kind]
    rng, views = np.random.default_rng(100 + seed), dict[str, ViewFeatures]()
    for view in packs.views[seed % stride :: stride]:
        exact = packs[view]
        assert isinstance(exact, lc.Regions)
        views[view] = in_cone(mistaken_regions(exact, mistakes, rng), cone)
    return views


def in_cone(regions: lc.Regions, share: float) -> lc.Regions:
    """Unit vectors drawn towards one fixed random direction, as CLIP's image vectors are: that much of each is it."""
    axis = torch.randn(regions.codebook.shape[1], generator=torch.Generator().manual_seed(1))
    rows = (1 - share**2) ** 0.5 * regions.codebook.float() + share * normalize(axis, dim=0)
    return replace(regions, codebook=normalize(rows, dim=1).half()) if share else regions


def still_life_scene(
    kind: str, seed: int, pieces: Sequence[Piece] | None = None, encoder: TextEncoder | None = None
) -> tuple[Truth, dict[str, ViewFeatures]]:
    """The still life, or other pieces in its place, with mistakes, and its truth; lvis if no encoder is named."""
    encoder = encoder or open_encoder("lvis")
    scene, (mistakes, cone) = still_life(seed, pieces=pieces), MISTAKES[kind]
    raster = CpuRaster(scene.splats)
    views: dict[str, ViewFeatures] = {
        view: in_cone(view_features, cone)
        for view, view_features in observe(scene, raster, encoder, mistakes, seed).items()
    }
    held_out = {view: torch.from_numpy(true_labels(scene, raster, view)[0]) for view in scene.held_out}
    classes = normalize(torch.from_numpy(np.asarray(encoder.encode(scene.objects))).float(), dim=1)
    object_rows, view_features = (
        torch.from_numpy(scene.splat_objects),
        evaluated_splats(scene.splats, scene.cameras, views),
    )
    return Truth(raster, scene.cameras, scene.objects, classes, object_rows, view_features, held_out), views


def ranked(truth: Truth, lifted: lc.LiftResult, values: Tensor) -> float:
    """AUROC of values [P] on splats for being right."""
    right = (truth.scores(lifted).argmax(dim=1) == truth.objects)[truth.evaluated].numpy()
    ranks, hits = rankdata(values[truth.evaluated].numpy()), int(right.sum())
    return float((ranks[right].sum() - hits * (hits + 1) / 2) / max(hits * (right.size - hits), 1))


def measured(name: str, truth: Truth, views: Mapping[str, ViewFeatures], settings: Iterable[str]) -> dict[str, Any]:
    """A row: each setting's accuracy / mIoU / worst class, ranking, and seconds over those of row-sum."""
    row: dict[str, Any] = {"scene": f"{name}, {len(views)} views"}
    seconds: dict[str, float] = {}
    for label in settings:
        start = time.perf_counter()
        lifted = truth.lift(views, **SETTINGS[label])
        seconds[label] = time.perf_counter() - start
        row[label] = " / ".join(f"{value:.4f}" for value in vars(truth.evaluate(lifted)).values())
        if label == "default" and lifted.confidence is not None:
            row["confidence"] = ranked(truth, lifted, lifted.confidence)
    if {"default", "row-sum"} <= seconds.keys():
        row["seconds"] = seconds["default"] / seconds["row-sum"]
    return row


def rows_of(options: Namespace) -> Iterator[dict[str, Any]]:
    """Packs of tabletop, then mistakes on it, on the still life and on small things."""
    truth = tabletop(options.folder)
    for pack in options.packs:
        for stride in options.strides if pack != "grids" else (1,):
            yield measured(pack, truth, read_pack(options.folder, pack, stride), options.settings)
    for kind, seed in product(options.mistakes, options.seeds):
        views = with_mistakes(options.folder, kind, seed)
        yield measured(f"tabletop, {kind} {seed}", truth, views, options.settings)
        for name, pieces in (("still life", None), ("small things", small_things())):
            yield measured(f"{name}, {kind} {seed}", *still_life_scene(kind, seed, pieces), options.settings)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.consensus",
        __doc__,
        ("folder", {"type": Path}),
        ("--packs", {"nargs": "*", "default": PACKS, "choices": PACKS}),
        ("--strides", {"nargs": "*", "type": int, "default": (1, 2, 4)}),
        ("--mistakes", {"nargs": "*", "default": tuple(MISTAKES), "choices": tuple(MISTAKES)}),
        ("--seeds", {"nargs": "*", "type": int, "default": (7, 8)}),
        ("--settings", {"nargs": "*", "default": tuple(SETTINGS), "choices": tuple(SETTINGS)}),
    )
    options = parser.parse_args()
    print_rows(rows_of(options), as_json=options.json)


if __name__ == "__main__":
    main()
