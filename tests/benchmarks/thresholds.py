"""Masks on the tabletop scene: mean IoU in the views that were not lifted, a phrase at a time.

    python -m tests.benchmarks.thresholds DIR [--lifts NAME ...] [--every N] [--weigh confidence] [--json]

Each phrase is asked alone, no other phrase and no truth is known to the threshold. A column a method: masks of the
objects that it finds; ``worst`` is the phrase that ``auto`` shows least well. ``rendered`` cuts the rendered scores
of each view by an ``auto`` of its own instead (protocol P3), and ``best`` by the best possible threshold of each
mask, which needs the truth. ``absent`` and ``absent rendered`` are the mean shares of the image that masks cover
where nothing of the phrase is to be seen.

The scene is where the constants of ``valley`` were tuned; those of ``auto`` were not tuned. ``--still-life`` judges
the same on the tests' still life, whose words need the extra ``minilm``, with three kinds of mistakes. Examples in
place of words: ``tests.benchmarks.examples``.
"""

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.query.ask import ask
from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.objects import objects
from liftcore.query.render import view_mask
from liftcore.query.scene import QueryScene
from liftcore.query.terms import WEIGH, Query
from liftcore.query.text import TextEncoder, open_encoder
from liftcore.query.threshold import METHODS, find_threshold
from tests.benchmarks.base import PACKS, command_line, lift_files, mask_iou, opened, scene_files, tell
from tests.benchmarks.tabletop import Tabletop

COLUMNS = (*METHODS, "rendered", "best", "absent", "absent rendered")
LIFTS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "robust": {"preset": "row-sum", "robust_steps": 1},
    "default": {"preset": "default"},
    "aggregated": {"preset": "default", "aggregation": True},
}


def best_iou(attention: np.ndarray, met: np.ndarray, truth: Tensor) -> float:
    """The largest IoU that any threshold on the attention gives, over the distinct scores of the met pixels.

    Args:
        attention: [H, W] f32. met: [H, W] bool, the pixels that a mask may take. truth: [H, W] bool.
    """
    seen = torch.from_numpy(met)
    scores, order = torch.sort(torch.from_numpy(attention)[seen], descending=True)
    hits = torch.cumsum(truth[seen][order].double(), dim=0)
    chosen = torch.arange(1, len(scores) + 1, dtype=torch.float64)
    ious = hits / (chosen + int(truth.sum()) - hits)
    last = torch.cat([scores[1:] != scores[:-1], torch.ones(1, dtype=torch.bool)])  # of equal scores: all or none
    return float(ious[last].max())


def measure_phrases(
    scene: QueryScene,
    phrases: Sequence[str],
    encoder: TextEncoder,
    held_out: Mapping[str, Tensor],
    weigh: str = "evidence",
) -> dict[str, float]:
    """Mean IoU over phrases and views, by method and for cuts of the rendered scores; the worst phrase of ``auto``.

    Args:
        scene: an opened lift.
        phrases: [K], asked one at a time.
        encoder: of the lift's text space.
        held_out: view -> [H, W] int, the phrase that each pixel shows.
        weigh: what splats count by.
    """
    rows: dict[str, list[float]] = {name: [] for name in COLUMNS}
    of_phrase: list[list[float]] = [[] for _ in phrases]
    for number, phrase in enumerate(phrases):
        for method in METHODS:
            answer = ask(scene, Query((phrase,), threshold=method, weigh=weigh), encoder)
            found = objects(scene, answer)  # once for all views
            for view, labels in held_out.items():
                truth = labels == number
                seen = view_mask(scene, answer, view, group=lambda *_, found=found: found)
                if truth.any():
                    rows[method].append(mask_iou(seen.mask, truth))
                    if method == "auto":
                        of_phrase[number].append(rows[method][-1])
                if method != "auto":
                    continue
                met = seen.row_sums >= MINIMUM_ROW_SUM
                rendered = met & (seen.attention >= find_threshold(seen.attention[met], method).value)
                if truth.any():
                    rows["rendered"].append(mask_iou(rendered, truth))
                    rows["best"].append(best_iou(seen.attention, met, truth))
                else:
                    rows["absent"].append(float(seen.mask.mean()))
                    rows["absent rendered"].append(float(rendered.mean()))
    worst = min(float(np.mean(values)) for values in of_phrase if values)
    return {name: float(np.mean(values)) for name, values in rows.items() if values} | {"worst": worst}


def rows_of(
    folder: Path, packs: Iterable[str], lifts: Iterable[str], every: int, weigh: str
) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    scene = Tabletop(folder)
    phrases = [thing["class"] for thing in json.loads((folder / "truth.json").read_text())["objects"]]
    encoder = open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack, name in product(packs, lifts):
        made = lift_files(scene_files(folder, pack), **LIFTS[name], view_stride=every)
        lifted = opened(made, scene.raster)
        head = {"scene": "tabletop", "features": f"{pack}, {len(made.views)} views", "lift": name}
        yield head | measure_phrases(lifted, phrases, encoder, scene.held_out, weigh)


def still_life_rows(lifts: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The still life with its usual mistakes, with hard ones, and with hard ones in a narrow cone of vectors."""
    from liftcore.features.pack import write_pack
    from liftcore.io.inria import write_inria_cameras
    from liftcore.io.ply import write_splats
    from liftcore.raster.cpu.raster import CpuRaster
    from tests.still_life.masks import Mistakes, observe, true_labels
    from tests.still_life.scene import still_life

    encoder = open_encoder("minilm")
    hard = Mistakes(merged=0.30, split=0.15, misnamed=0.10, unlabelled=0.06, noise=0.45)
    for seed, (name, mistakes, cone) in enumerate(
        (("usual", Mistakes(), 0.0), ("hard", hard, 0.0), ("cone", hard, 0.9))
    ):
        made = still_life(7 + seed)
        raster = CpuRaster(made.splats)
        held_out = {view: torch.from_numpy(true_labels(made, raster, view)[0]) for view in made.held_out}
        observed = observe(made, raster, encoder, mistakes, 7 + seed)
        with tempfile.TemporaryDirectory() as place:
            files = [Path(place) / part for part in ("point_cloud.ply", "cameras.json", "features.safetensors")]
            write_splats(made.splats, files[0])
            write_inria_cameras(made.cameras, files[1])
            moved = {view: replace(part, codebook=in_cone(part.codebook, cone)) for view, part in observed.items()}
            write_pack(files[2], moved, {"encoder": "generated", "text_space": "minilm", "normalised": "true"})
            for kind in lifts:
                lifted = opened(lift_files(files, **LIFTS[kind]), raster)
                head = {"scene": "still life", "features": name, "lift": kind}
                yield head | measure_phrases(lifted, made.things, encoder, held_out)


def in_cone(codebook: Tensor, share: float) -> Tensor:
    """Unit vectors drawn towards one fixed random direction, as CLIP's image vectors are: that much of each is it."""
    axis = torch.randn(codebook.shape[1], generator=torch.Generator().manual_seed(1))
    drawn = (1 - share**2) ** 0.5 * codebook.float() + share * torch.nn.functional.normalize(axis, dim=0)
    return torch.nn.functional.normalize(drawn, dim=1).half() if share else codebook


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.thresholds",
        __doc__,
        ("folder", {"type": Path}),
        ("--still-life", {"action": "store_true", "help": "the still life too, which nothing was tuned on"}),
        ("--features", {"nargs": "+", "default": PACKS, "choices": PACKS}),
        ("--lifts", {"nargs": "+", "default": tuple(LIFTS), "choices": tuple(LIFTS)}),
        ("--weigh", {"default": WEIGH[0], "choices": WEIGH, "help": "what splats of tabletop count by"}),
        ("--every", {"type": int, "default": 1, "metavar": "N", "help": "tabletop's every N-th view alone"}),
    )
    options = parser.parse_args()
    rows = list(rows_of(options.folder, options.features, options.lifts, options.every, options.weigh))
    rows += still_life_rows(options.lifts) if options.still_life else []
    tell(rows, as_json=options.json, columns=("scene", "features", "lift", "worst", *COLUMNS))


if __name__ == "__main__":
    main()
