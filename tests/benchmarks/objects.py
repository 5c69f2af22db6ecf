"""Objects of answers on the tabletop scene: are they the things that stand there, and where those stand?

    python -m tests.benchmarks.objects DIR [--json]

Each thing is asked for by its word, with the automatic threshold. ``one`` is for how many of them exactly one object
was found; ``box`` and ``worst`` the mean and the least IoU of the largest object's box with that of the thing's true
splats, ``all`` the mean with the box around all selected splats instead; ``middle`` the mean distance between the
middles of the two boxes, as a share of the true one's diagonal; ``pairs`` of how many pairs of things, asked for
together, exactly two objects are found, one in each. Table and curtain, which hold the things, are not asked for.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.query.ask import Answer, ask
from liftcore.query.objects import objects
from liftcore.query.scene import QueryScene
from liftcore.query.text import open_encoder
from tests.benchmarks.base import PACKS, PRESETS, command_line, lift_files, opened, scene_files, tell
from tests.benchmarks.tabletop import Tabletop

PROCEDURAL = "(procedural)"  # the source of what the things stand on and before


def box_iou(one: np.ndarray, other: np.ndarray) -> float:
    """Volume of the intersection over that of the union of two boxes [2, 3], corners; 0 where both are flat."""
    sides = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    common = float(np.prod(np.maximum(sides, 0)))
    union = float(np.prod(one[1] - one[0]) + np.prod(other[1] - other[0])) - common
    return common / union if union > 0 else 0.0


def measure_lift(scene: QueryScene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The figures of one lift: answers by a thing's number, owners [P] int, the thing of each splat."""
    means, ious, of_all, middles, alone = scene.splats.means.numpy(), [], [], [], 0
    for thing, answer in answers.items():
        true = _bounds(means[owners == thing])
        found = objects(scene, answer).found
        alone += len(found) == 1
        box = np.array(found[0].box) if found else np.zeros((2, 3))
        ious.append(box_iou(box, true))
        of_all.append(box_iou(_bounds(means[answer.selected]), true) if found else 0.0)
        middles.append(np.linalg.norm(box.mean(axis=0) - true.mean(axis=0)) / np.linalg.norm(true[1] - true[0]))
    pairs = list(combinations(answers, 2))
    apart = sum(_are_two(scene, {thing: answers[thing] for thing in pair}, owners) for pair in pairs)
    return {
        "things": len(answers), "one": alone, "box": float(np.mean(ious)), "worst": float(np.min(ious)),
        "all": float(np.mean(of_all)), "middle": float(np.mean(middles)), "pairs": len(pairs), "apart": apart,
    }  # fmt: skip


def _are_two(scene: QueryScene, answers: dict[int, Answer], owners: np.ndarray) -> bool:
    """Whether the splats of two answers make exactly two objects, most of one's splats of each thing."""
    first, second = answers.values()
    both = objects(scene, replace(first, selected=first.selected | second.selected))
    most = {int(np.bincount(owners[both.numbers == number]).argmax()) for number in range(len(both.found))}
    return len(both.found) == 2 and most == set(answers)


def _bounds(means: np.ndarray) -> np.ndarray:
    return np.stack([means.min(axis=0), means.max(axis=0)]).astype(np.float64)


def rows_of(folder: Path, packs: Iterable[str] = PACKS, presets: Iterable[str] = PRESETS) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth = Tabletop(folder)
    known = json.loads((folder / "truth.json").read_text())["objects"]
    words = {number: thing["class"] for number, thing in enumerate(known) if thing["source"] != PROCEDURAL}
    encoder = open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack, preset in product(packs, presets):
        scene = opened(lift_files(scene_files(folder, pack), preset=preset), truth.raster)
        answers = {thing: ask(scene, word, encoder) for thing, word in words.items()}
        yield {"features": pack, "preset": preset, **measure_lift(scene, answers, truth.objects.numpy())}


def main() -> None:
    """Print the table, or one JSON object."""
    packs, presets = {"nargs": "+", "default": PACKS, "choices": PACKS}, {"nargs": "+", "default": PRESETS}
    parser = command_line(
        "tests.benchmarks.objects", __doc__, ("folder", {"type": Path}), ("--features", packs), ("--presets", presets)
    )
    options = parser.parse_args()
    tell(rows_of(options.folder, options.features, options.presets), as_json=options.json)


if __name__ == "__main__":
    main()
