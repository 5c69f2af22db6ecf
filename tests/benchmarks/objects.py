"""Objects of answers on the tabletop scene: are they the things that stand there, and where those stand?

    python -m tests.benchmarks.objects DIR [--json]

Each thing is asked for by its word, with the automatic threshold. ``one`` is for how many of them exactly one object
was found; ``box`` and ``worst`` the mean and the least IoU of the largest object's box with that of the thing's true
splats, ``all`` the mean with the box around all selected splats instead; ``middle`` the mean distance between the
middles of the two boxes, as a share of the true one's diagonal; ``pairs`` of how many pairs of things, asked for
together, exactly two objects are found, one in each. Table and curtain, which hold the things, are not asked for.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.query.ask import ask
from liftcore.query.encoders import open_encoder
from liftcore.query.objects import objects
from tests.benchmarks.tabletop import Tabletop
from tests.benchmarks.thresholds import PACKS, PRESETS, lifted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.query.ask import Answer
    from liftcore.query.scene import QueryScene

PROCEDURAL = "(procedural)"  # the source of what the things stand on and before


def box_iou(one: np.ndarray, other: np.ndarray) -> float:
    """Volume of the intersection over that of the union of two boxes [2, 3], corners; 0 where both are flat."""
    sides = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    common = float(np.prod(np.maximum(sides, 0)))
    union = float(np.prod(one[1] - one[0]) + np.prod(other[1] - other[0])) - common
    return common / union if union > 0 else 0.0


def measure_lift(scene: QueryScene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The figures of one lift.

    Args:
        scene: the lift.
        answers: a thing's number -> the answer to its word.
        owners: [P] int, the thing that each splat belongs to.
    """
    means, ious, of_all, middles, alone = scene.splats.means.numpy(), [], [], [], 0
    for thing, answer in answers.items():
        true = _bounds(means[owners == thing])
        found = objects(scene, answer).found
        alone += len(found) == 1
        box = np.array(found[0].box) if found else np.zeros((2, 3))
        ious.append(box_iou(box, true))
        of_all.append(box_iou(_bounds(means[answer.selected.numpy()]), true) if found else 0.0)
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


def measure_tabletop(
    folder: Path, packs: Sequence[str] = PACKS, presets: Sequence[str] = PRESETS
) -> list[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth, rows = Tabletop(folder), []
    known = json.loads((folder / "truth.json").read_text())["objects"]
    words = {number: thing["class"] for number, thing in enumerate(known) if thing["source"] != PROCEDURAL}
    encoder = open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack in packs:
        for preset in presets:
            files = [folder / name for name in ("point_cloud.ply", "cameras.json", f"{pack}.safetensors")]
            scene = lifted(files, preset, truth.raster)
            answers = {thing: ask(scene, word, encoder) for thing, word in words.items()}
            rows.append({"features": pack, "preset": preset, **measure_lift(scene, answers, truth.objects.numpy())})
    return rows


def table_of(document: dict[str, Any]) -> str:
    """The rows and the machine, for people."""
    lines = [f"{'features, preset':<28}{'one':>8}{'box':>8}{'worst':>8}{'all':>8}{'middle':>8}{'pairs':>10}"]
    for row in document["rows"]:
        lines.append(
            f"{row['features'] + ', ' + row['preset']:<28}{row['one']:>5}/{row['things']:<2}{row['box']:>8.3f}"
            f"{row['worst']:>8.3f}{row['all']:>8.3f}{row['middle']:>8.3f}{row['apart']:>7}/{row['pairs']}"
        )
    lines.append(machine_line(document["hardware"]))
    return "\n".join(lines)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.objects", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="the tabletop scene")
    parser.add_argument("--features", nargs="+", default=PACKS, choices=PACKS, help="which feature packs")
    parser.add_argument("--presets", nargs="+", default=PRESETS, metavar="NAME", help="which weights")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args()
    rows = measure_tabletop(options.folder, options.features, options.presets)
    document = {"rows": rows, "hardware": hardware()}
    print(json.dumps(document) if options.json else table_of(document))


if __name__ == "__main__":
    main()
