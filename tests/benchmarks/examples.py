"""Masks by example: mean IoU of what one pixel of a thing finds.

    python -m tests.benchmarks.examples DIR [--json]

With truth (``tabletop``) each object is asked for by the pixel deepest inside it, farthest from its border, in the
first held-out view, and judged in the other ones. Without it (``plush``) regions of the pack ``regions`` stand for
things: each one of every third view that covers 2 to 50 % of it is asked for by its deepest pixel and judged in that
view. They are segments of single photos: another segmentation would call other things a thing.

A column a threshold: masks of the objects that it finds, ``anywhere`` those of ``auto`` without its least likeness.
``rendered`` cuts the rendered scores of each view by an ``auto`` of its own instead, and ``best`` by the best
possible threshold of each mask, which needs the truth.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidQuery
from liftcore.evaluate.accuracy import mask_iou
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.features.views import Regions
from liftcore.io.ply import read_splats
from liftcore.query.ask import Answer, ask
from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.example import Pixel
from liftcore.query.objects import objects
from liftcore.query.query import Query
from liftcore.query.threshold import METHODS, find_threshold
from liftcore.query.view_mask import view_mask
from liftcore.raster.cpu.raster import CpuRaster
from tests.benchmarks.tabletop import Tabletop
from tests.benchmarks.thresholds import PACKS, PRESETS, best_iou, lifted

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from torch import Tensor

    from liftcore.query.scene import QueryScene

COLUMNS = (*METHODS, "anywhere", "rendered", "best")
LEVELS = (0, 1, 2)  # of the regions
VIEW_STRIDE = 3  # of the views with regions
LEAST_AREA, MOST_AREA = 0.02, 0.5  # of the view, that a region covers

Case = tuple[Pixel, list[tuple[str, "Tensor"]]]  # an example, and what it shows: views, and [H, W] bool in each


def deepest_pixel(truth: Tensor) -> tuple[int, int]:
    """x and y of the pixel farthest from the border of a mask [H, W] bool, the topmost of equals."""
    from scipy.ndimage import distance_transform_edt

    depth = np.asarray(distance_transform_edt(np.pad(truth.numpy(), 1)))[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return int(x), int(y)


def measure_examples(scene: QueryScene, cases: Iterable[Case]) -> dict[str, float]:
    """Mean IoU over examples and views by column, how many were asked, and how many had no feature."""
    rows: dict[str, list[float]] = {name: [] for name in COLUMNS}
    asked = refused = 0
    for example, truths in cases:
        asked += 1
        try:
            answers = {name: ask(scene, Query((example,), threshold=name)) for name in METHODS}
        except InvalidQuery:
            refused += 1
            continue
        answers["anywhere"] = _anywhere(scene, answers["auto"])
        found = {name: (answer, objects(scene, answer)) for name, answer in answers.items()}  # once for all views
        for view, truth in truths:
            looks = {
                name: view_mask(scene, answer, view, group=lambda *_, known=known: known)
                for name, (answer, known) in found.items()
            }
            for name, seen in looks.items():
                rows[name].append(mask_iou(seen.mask, truth))
            seen = looks["auto"]
            met = seen.row_sums >= MINIMUM_ROW_SUM
            cut = find_threshold(seen.attention[met]).value
            rows["rendered"].append(mask_iou(met & (seen.attention >= cut), truth))
            rows["best"].append(best_iou(seen.attention, met, truth))
    return {name: float(np.mean(values)) for name, values in rows.items()} | {"asked": asked, "refused": refused}


def _anywhere(scene: QueryScene, answer: Answer) -> Answer:
    found = find_threshold(answer.scores[answer.seen], "auto", scene.weights)
    return replace(answer, threshold=found.value, selected=answer.seen & (answer.scores >= found.value))


def objects_of(truth: Tabletop) -> Iterator[Case]:
    """The objects that the first held-out view shows, and where the others show them."""
    first, *others = truth.held_out
    for number in range(len(truth.classes)):
        shown = truth.held_out[first] == number
        if shown.any():
            rest = [(view, truth.held_out[view] == number) for view in others]
            yield Pixel(first, *deepest_pixel(shown)), [(view, mask) for view, mask in rest if mask.any()]


def regions_of(scene: QueryScene, level: int) -> Iterator[Case]:
    """The regions of a level, and where their own views show them."""
    for view in scene.lift.metadata.views[::VIEW_STRIDE]:
        camera = scene.cameras[view]
        observed = scene.packs.observation(view)
        assert isinstance(observed, Regions)
        labels = torch.as_tensor(observed.labels[level]).float()
        size = (camera.height, camera.width)
        of_pixels = torch.nn.functional.interpolate(labels[None, None], size=size, mode="nearest")[0, 0]
        for region in of_pixels.unique().tolist():
            shown = of_pixels == region
            if region >= 0 and LEAST_AREA <= float(shown.float().mean()) <= MOST_AREA:
                yield Pixel(view, *deepest_pixel(shown)), [(view, shown)]


def measure_folder(
    folder: Path, packs: Sequence[str] = PACKS, presets: Sequence[str] = PRESETS
) -> Iterator[dict[str, Any]]:
    """One row a lift of a scene with truth, a lift and a level of one with regions alone."""
    splats, cameras = folder / "point_cloud.ply", folder / "cameras.json"
    truth = Tabletop(folder) if (folder / "truth.json").exists() else None
    raster = truth.raster if truth else CpuRaster(read_splats(splats))
    for pack in packs if truth else ("regions",):
        for preset in presets:
            scene = lifted([splats, cameras, folder / f"{pack}.safetensors"], preset, raster)
            row = {"scene": folder.name, "features": pack, "preset": preset}
            if truth:
                yield row | measure_examples(scene, objects_of(truth))
                continue
            for level in LEVELS:
                yield row | {"features": f"{pack} {level}"} | measure_examples(scene, regions_of(scene, level))


def table_of(document: dict[str, Any]) -> str:
    """The rows and the machine, for people."""
    lines = [f"{'scene, features, preset':<36}{'asked':>6}" + "".join(f"{name:>10}" for name in COLUMNS)]
    for row in document["rows"]:
        head = ", ".join(row[key] for key in ("scene", "features", "preset"))
        lines.append(f"{head:<36}{row['asked']:>6}" + "".join(f"{row[name]:>10.3f}" for name in COLUMNS))
    lines.append(machine_line(document["hardware"]))
    return "\n".join(lines)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.examples", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="a scene with truth, or with the pack regions")
    parser.add_argument("--features", nargs="+", default=PACKS, choices=PACKS, help="which packs, with truth")
    parser.add_argument("--presets", nargs="+", default=PRESETS, metavar="NAME", help="which weights")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args()
    rows = list(measure_folder(options.folder, options.features, options.presets))
    document = {"rows": rows, "hardware": hardware()}
    print(json.dumps(document) if options.json else table_of(document))


if __name__ == "__main__":
    main()
