"""Masks by example: mean IoU of what one pixel of a thing finds.

    python -m tests.benchmarks.examples DIR [--features NAME...] [--presets NAME...] [--json]

With truth (``tabletop``) each object is asked for by the pixel deepest inside it, farthest from its border, in the
first held-out view, and judged in the other ones. Without it (``plush``) regions of the pack ``regions`` stand for
things: each one of every third view that covers 2 to 50 % of it is asked for by its deepest pixel and judged in that
view. They are segments of single photos: another segmentation would call other things a thing.

A column a threshold: masks of the objects that it finds, ``anywhere`` those of ``auto`` without its least likeness.
``rendered`` cuts the rendered scores of each view by an ``auto`` of its own instead, and ``best`` by the best
possible threshold of each mask, which needs the truth.
"""

from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

import liftcore as lc
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.query.terms import Pixel
from liftcore.query.threshold import METHODS, find_threshold
from tests.benchmarks.base import PACKS, PRESETS, command_line, print_rows, read_pack, read_scene
from tests.benchmarks.tabletop import Truth, tabletop
from tests.benchmarks.thresholds import compare_thresholds

Case = tuple[Pixel, list[tuple[str, Tensor]]]  # an example, and what it shows: views, and [H, W] bool in each


def deepest_pixel(truth: Tensor) -> tuple[int, int]:
    """x and y of the pixel farthest from the border of a mask [H, W] bool, the topmost of equals."""
    depth = np.asarray(distance_transform_edt(np.pad(truth.numpy(), 1)))[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return int(x), int(y)


def measure(scene: Scene, cases: Iterable[Case]) -> dict[str, float]:
    """Mean IoU over examples and views by column, how many were asked, and how many had no feature."""
    rows: dict[str, list[float]] = {name: [] for name in (*METHODS, "anywhere", "rendered", "best")}
    queries = rejected = 0
    for example, truths in cases:
        queries += 1
        try:
            answers = {name: ask(scene, Query.of((example,), threshold=name)) for name in METHODS}
        except lc.InvalidQuery:
            rejected += 1
            continue
        auto = answers["auto"]
        cut = find_threshold(auto.scores[auto.has_feature], "auto", scene.weights).value
        answers["anywhere"] = ask(scene, Query.of((example,), threshold=cut))
        for name, values in compare_thresholds(scene, answers, truths).items():
            rows[name] += values
    return {"asked": queries, "refused": rejected} | {name: float(np.mean(values)) for name, values in rows.items()}


def objects_of(truth: Truth) -> Iterator[Case]:
    """The objects that the first held-out view shows, and where the others show them."""
    first, *other_views = truth.held_out
    for number in range(len(truth.classes)):
        visible = truth.held_out[first] == number
        if visible.any():
            rest = [(view, truth.held_out[view] == number) for view in other_views]
            yield Pixel(first, *deepest_pixel(visible)), [(view, mask) for view, mask in rest if mask.any()]


def regions_of(scene: Scene, level: int) -> Iterator[Case]:
    """The regions of a level of every third view, and where their own views show them."""
    for view in scene.lift.views[::3]:
        camera, observed = scene.cameras[view], scene.packs[view]
        assert isinstance(observed, lc.Regions)
        labels = torch.as_tensor(observed.labels[level]).float()[None, None]
        size = (camera.height, camera.width)
        of_pixels = torch.nn.functional.interpolate(labels, size=size, mode="nearest")[0, 0]
        for region in of_pixels.unique().tolist():
            mask = of_pixels == region
            if region >= 0 and 0.02 <= float(mask.float().mean()) <= 0.5:
                yield Pixel(view, *deepest_pixel(mask)), [(view, mask)]


def main() -> None:
    """Print the table: a row a lift of a scene with truth, a lift and a level of one with regions alone."""
    packs = {"nargs": "+", "default": PACKS, "choices": PACKS, "help": "which packs, with truth"}
    presets = {"nargs": "+", "default": PRESETS, "metavar": "NAME"}
    parser = command_line(
        "tests.benchmarks.examples",
        __doc__,
        ("folder", {"type": Path}),
        ("--features", packs),
        ("--presets", presets),
    )
    options = parser.parse_args()
    folder, rows = options.folder, []
    if (folder / "truth.json").exists():
        truth = tabletop(folder)
        for pack, preset in product(options.features, options.presets):
            scene = truth.open_scene(truth.lift(read_pack(folder, pack), preset=preset))
            head = {"scene": folder.name, "features": pack, "preset": preset}
            rows.append(head | measure(scene, objects_of(truth)))
    else:
        (splats, cameras), views = read_scene(folder), lc.read_features(folder / "regions.safetensors")
        for preset in options.presets:
            lifted = lc.lift(splats, cameras, views, preset=preset, diagnostic_rays=0)
            scene = Scene(lifted, splats, cameras, views)
            for level in range(3):
                head = {"scene": folder.name, "features": f"regions {level}", "preset": preset}
                rows.append(head | measure(scene, regions_of(scene, level)))
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
