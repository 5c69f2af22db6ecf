"""Objects of answers on the tabletop scene: are they the things that stand there, and where those stand?

    python -m tests.benchmarks.objects DIR [--without-words] [--json]

Each thing is asked for by its word, with the automatic threshold. ``one`` is for how many of them exactly one object
was found; ``box`` and ``worst`` the mean and the least IoU of the largest object's box with that of the thing's true
splats, ``all`` the mean with the box around all selected splats instead; ``middle`` the mean distance between the
middles of the two boxes, as a share of the true one's diagonal; ``pairs`` of how many pairs of things, asked for
together, exactly two objects are found, one in each. Table and curtain, which hold the things, are not asked for.

``--without-words`` judges the objects that lifts of masks hold instead, with 52, 26 and 13 views, beside HDBSCAN's
clusters of the same lift's features: of the twelve things ``found`` by an object with an IoU of splats over .75, over
splats with total weight over 0.5; the ``mean`` and ``worst`` of their best IoUs; ``all`` objects there are, of 14
that there should be with table and curtain; and what they cost, ``seconds`` of the lift's ``of``.
"""

import time
from collections.abc import Iterable, Iterator
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.query.ask import ask
from liftcore.query.objects import objects
from liftcore.query.question import Answer
from liftcore.query.scene import Scene
from liftcore.solve.clusters import cluster_splats
from liftcore.text import open_encoder
from tests.benchmarks.base import PACKS, PRESETS, box_iou, command_line, print_rows, read_pack
from tests.benchmarks.tabletop import Truth, tabletop

FOUND_IOU = 0.75  # IoU of splats
CLOTHS = ("tablecloth", "curtain")  # what the things stand on and before


def measure_lift(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The figures of one lift: answers by a thing's number, owners [P] int, the thing of each splat."""
    boxes, pairs = measure_boxes(scene, answers, owners), list(combinations(answers, 2))
    separate = sum(_are_two(scene, {number: answers[number] for number in pair}, owners) for pair in pairs)
    return {**boxes, "pairs": len(pairs), "apart": separate}


def measure_boxes(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The same without pairs."""
    means, ious, of_all, middles, single_count = scene.splats.means.numpy(), [], [], [], 0
    for number, answer in answers.items():
        true = _bounds(means[owners == number])
        selected_objects = objects(scene, answer).objects
        single_count += len(selected_objects) == 1
        box = np.array(selected_objects[0].box) if selected_objects else np.zeros((2, 3))
        ious.append(box_iou(box, true))
        of_all.append(box_iou(_bounds(means[answer.selected]), true) if selected_objects else 0.0)
        middles.append(np.linalg.norm(box.mean(axis=0) - true.mean(axis=0)) / np.linalg.norm(true[1] - true[0]))
    return {
        "things": len(answers), "one": single_count, "box": float(np.mean(ious)), "worst": float(np.min(ious)),
        "all": float(np.mean(of_all)), "middle": float(np.mean(middles)),
    }  # fmt: skip


def _are_two(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> bool:
    """Return True if the splats of two answers form exactly two objects, one for each labelled object."""
    first, second = answers.values()
    union, fields = (
        first.selected | second.selected,
        first.model_dump(exclude={"text", "like", "count", "top", "box"}),
    )
    grouped = objects(scene, Answer.of(first.query, first.scores, first.has_feature, union, **fields))
    majorities = {
        int(np.bincount(owners[grouped.numbers == number]).argmax()) for number in range(len(grouped.objects))
    }
    return len(grouped.objects) == 2 and majorities == set(answers)


def _bounds(means: np.ndarray) -> np.ndarray:
    return np.stack([means.min(axis=0), means.max(axis=0)]).astype(np.float64)


def best_ious(labels: np.ndarray, owners: np.ndarray, object_numbers: Iterable[int]) -> np.ndarray:
    """Of each thing the best IoU of its splats with those of one label: labels, owners [n] int, -1 for none."""
    table = np.zeros((owners.max() + 1, labels.max() + 2))
    np.add.at(table, (owners, labels + 1), 1)
    unions = table.sum(axis=1, keepdims=True) + table.sum(axis=0) - table
    return (table / np.maximum(unions, 1))[list(object_numbers), 1:].max(axis=1, initial=0.0)


def rows_without_words(folder: Path, packs: Iterable[str], strides: Iterable[int]) -> Iterator[dict[str, Any]]:
    """Two rows a lift of the preset default: the objects that it holds, and HDBSCAN's clusters of its features."""
    truth = tabletop(folder)
    object_numbers, owners = things_of(truth), truth.objects.numpy()[truth.evaluated.numpy()].astype(np.int64)
    for pack, stride in product(packs, strides):
        lifted = truth.lift(read_pack(folder, pack, stride), preset="default")
        assert lifted.object is not None
        start = time.perf_counter()
        clusters = cluster_splats(lifted.features, lifted.total_weight.numpy(), lifted.settings).labels
        seconds_by_method = {"objects": lifted.metadata.timings["objects"], "HDBSCAN": time.perf_counter() - start}
        for by, labels in (("objects", lifted.object), ("HDBSCAN", clusters)):
            truth_labels = labels.numpy()[truth.evaluated.numpy()]
            ious = best_ious(truth_labels, owners, object_numbers)
            yield {
                "features": pack, "views": len(lifted.views), "by": by, "found": int((ious > FOUND_IOU).sum()),
                "mean": float(ious.mean()), "worst": float(ious.min()), "all": int(labels.max()) + 1,
                "seconds": seconds_by_method[by], "of": sum(lifted.metadata.timings.values()),
            }  # fmt: skip


def rows_of(folder: Path, packs: Iterable[str], presets: Iterable[str]) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth, encoder = tabletop(folder), open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack, preset in product(packs, presets):
        scene = truth.open_scene(truth.lift(read_pack(folder, pack), preset=preset))
        answers = {number: ask(scene, truth.words[number], encoder) for number in things_of(truth)}
        yield {"features": pack, "preset": preset, **measure_lift(scene, answers, truth.objects.numpy())}


def things_of(truth: Truth) -> list[int]:
    """The classes that are things, by their numbers."""
    return [number for number, word in enumerate(truth.words) if word not in CLOTHS]


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.objects",
        __doc__,
        ("folder", {"type": Path}),
        ("--features", {"nargs": "+", "default": PACKS, "choices": PACKS}),
        ("--presets", {"nargs": "+", "default": PRESETS}),
        ("--without-words", {"action": "store_true", "help": "the objects that lifts hold, not those of words"}),
        ("--strides", {"nargs": "*", "type": int, "default": (1, 2, 4), "help": "every n-th view, without words"}),
    )
    options = parser.parse_args()
    if options.without_words:
        packs = [pack for pack in options.features if pack != "grids"]  # which have no masks
        rows = rows_without_words(options.folder, packs, options.strides)
    else:
        rows = rows_of(options.folder, options.features, options.presets)
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
