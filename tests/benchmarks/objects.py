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
from tests.benchmarks.base import PACKS, PRESETS, box_iou, command_line, read_pack, tell
from tests.benchmarks.tabletop import Truth, tabletop

FOUND = 0.75  # IoU of splats
CLOTHS = ("tablecloth", "curtain")  # what the things stand on and before


def measure_lift(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The figures of one lift: answers by a thing's number, owners [P] int, the thing of each splat."""
    boxes, pairs = measure_boxes(scene, answers, owners), list(combinations(answers, 2))
    apart = sum(_are_two(scene, {thing: answers[thing] for thing in pair}, owners) for pair in pairs)
    return {**boxes, "pairs": len(pairs), "apart": apart}


def measure_boxes(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> dict[str, Any]:
    """The same without pairs."""
    means, ious, of_all, middles, alone = scene.splats.means.numpy(), [], [], [], 0
    for thing, answer in answers.items():
        true = _bounds(means[owners == thing])
        found = objects(scene, answer).found
        alone += len(found) == 1
        box = np.array(found[0].box) if found else np.zeros((2, 3))
        ious.append(box_iou(box, true))
        of_all.append(box_iou(_bounds(means[answer.selected]), true) if found else 0.0)
        middles.append(np.linalg.norm(box.mean(axis=0) - true.mean(axis=0)) / np.linalg.norm(true[1] - true[0]))
    return {
        "things": len(answers), "one": alone, "box": float(np.mean(ious)), "worst": float(np.min(ious)),
        "all": float(np.mean(of_all)), "middle": float(np.mean(middles)),
    }  # fmt: skip


def _are_two(scene: Scene, answers: dict[int, Answer], owners: np.ndarray) -> bool:
    """Whether the splats of two answers make exactly two objects, most of one's splats of each thing."""
    first, second = answers.values()
    either, told = first.selected | second.selected, first.model_dump(exclude={"text", "like", "count", "top", "box"})
    both = objects(scene, Answer.of(first.query, first.scores, first.seen, either, **told))
    most = {int(np.bincount(owners[both.numbers == number]).argmax()) for number in range(len(both.found))}
    return len(both.found) == 2 and most == set(answers)


def _bounds(means: np.ndarray) -> np.ndarray:
    return np.stack([means.min(axis=0), means.max(axis=0)]).astype(np.float64)


def best_ious(labels: np.ndarray, owners: np.ndarray, things: Iterable[int]) -> np.ndarray:
    """Of each thing the best IoU of its splats with those of one label: labels, owners [n] int, -1 for none."""
    table = np.zeros((owners.max() + 1, labels.max() + 2))
    np.add.at(table, (owners, labels + 1), 1)
    unions = table.sum(axis=1, keepdims=True) + table.sum(axis=0) - table
    return (table / np.maximum(unions, 1))[list(things), 1:].max(axis=1, initial=0.0)


def rows_without_words(folder: Path, packs: Iterable[str], strides: Iterable[int]) -> Iterator[dict[str, Any]]:
    """Two rows a lift of the preset default: the objects that it holds, and HDBSCAN's clusters of its features."""
    truth = tabletop(folder)
    things, owners = things_of(truth), truth.objects.numpy()[truth.counted.numpy()].astype(np.int64)
    for pack, stride in product(packs, strides):
        made = truth.lift(read_pack(folder, pack, stride), preset="default")
        assert made.object is not None
        start = time.perf_counter()
        clusters = cluster_splats(made.features, made.total_weight.numpy(), made.settings).labels
        spent = {"objects": made.metadata.timings["objects"], "HDBSCAN": time.perf_counter() - start}
        for by, labels in (("objects", made.object), ("HDBSCAN", clusters)):
            own = labels.numpy()[truth.counted.numpy()]
            ious = best_ious(own, owners, things)
            yield {
                "features": pack, "views": len(made.views), "by": by, "found": int((ious > FOUND).sum()),
                "mean": float(ious.mean()), "worst": float(ious.min()), "all": int(labels.max()) + 1,
                "seconds": spent[by], "of": sum(made.metadata.timings.values()),
            }  # fmt: skip


def rows_of(folder: Path, packs: Iterable[str], presets: Iterable[str]) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth, encoder = tabletop(folder), open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack, preset in product(packs, presets):
        scene = truth.opened(truth.lift(read_pack(folder, pack), preset=preset))
        answers = {thing: ask(scene, truth.words[thing], encoder) for thing in things_of(truth)}
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
    tell(rows, as_json=options.json)


if __name__ == "__main__":
    main()
