"""Masks on the tabletop scene: mean IoU in the views that were not lifted, a phrase at a time.

    python -m tests.benchmarks.thresholds DIR [--lifts NAME ...] [--every N] [--still-life] [--alone]
        [--smoothness L] [--json]

Each phrase is asked alone, no other phrase and no truth is known to the threshold. A column a method: masks of the
objects that it finds; ``worst`` is the phrase that ``auto`` shows least well. ``rendered`` cuts the rendered scores
of each view by an ``auto`` of its own instead (protocol P3), and ``best`` by the best possible threshold of each
mask, which needs the truth. ``absent`` and ``absent rendered`` are the mean shares of the image that masks cover
where nothing of the phrase is to be seen.

``--alone`` asks with ``absent=keep`` by ``auto`` of the preset `default`: of each lift the mean, the worst phrase,
what is there and called absent or not sure, and the share of 200 words for what is not there (20 for the still life,
of which five seeds of mistakes are asked) that select nothing.

The scene is where the constants of ``valley`` were tuned; those of ``auto`` were not tuned. ``--still-life`` judges
the tests' still life too, with three kinds of mistakes; its words need the extra ``minilm``. Examples in place of
words: ``tests.benchmarks.examples``.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.ask import ask
from liftcore.query.objects import objects
from liftcore.query.question import Answer, Query
from liftcore.query.render import LEAST_SHARE, MOST_GROUPED, view_mask
from liftcore.query.scene import Scene
from liftcore.query.threshold import METHODS, find_threshold
from liftcore.text import TextEncoder, open_encoder
from liftcore.text.table import TableEncoder
from tests.benchmarks.base import PACKS, command_line, mask_iou, print_rows, read_pack
from tests.benchmarks.consensus import still_life_scene
from tests.benchmarks.presence import ABSENT, NOT_THERE
from tests.benchmarks.tabletop import Truth, tabletop

COLUMNS = (*METHODS, "rendered", "best", "absent", "absent rendered")
LIFTS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "robust": {"preset": "row-sum", "robust_steps": 1},
    "default": {"preset": "default"},
    "smooth": {"preset": "default", "smoothness": "auto"},
    "aggregated": {"preset": "default", "aggregation": True},
}


def best_iou(attention: np.ndarray, hit: np.ndarray, truth: Tensor) -> float:
    """The largest IoU that any threshold on the attention gives, over the distinct scores of the met pixels.

    Args:
        attention: [H, W] f32. hit: [H, W] bool, the pixels that a mask may take. truth: [H, W] bool.
    """
    hit_mask = torch.from_numpy(hit)
    scores, order = torch.sort(torch.from_numpy(attention)[hit_mask], descending=True)
    hits = torch.cumsum(truth[hit_mask][order].double(), dim=0)
    counts = torch.arange(1, len(scores) + 1, dtype=torch.float64)
    ious = hits / (counts + int(truth.sum()) - hits)
    last = torch.cat([scores[1:] != scores[:-1], torch.ones(1, dtype=torch.bool)])  # of equal scores: all or none
    return float(ious[last].max())


def compare_thresholds(
    scene: Scene, answers: Mapping[str, Answer], truths: Iterable[tuple[str, Tensor]]
) -> dict[str, list[float]]:
    """IoU of the masks of answers to the same question in views, by their names, one of which is ``auto``.

    Args:
        truths: of each view its name and [H, W] bool, what the mask should be; where nothing is to be seen, how much
            of the image a mask covers counts instead.
    """
    rows: dict[str, list[float]] = defaultdict(list)
    grouped = {name: objects(scene, answer) for name, answer in answers.items()}  # once for all views
    for view, truth in truths:
        is_visible = bool(truth.any())
        by_threshold = {
            name: view_mask(scene, answers[name], view, group=lambda *_, group=grouped[name]: group)
            for name in (answers if is_visible else ("auto",))
        }
        attention, hit = by_threshold["auto"].attention, by_threshold["auto"].row_sums >= MINIMUM_ROW_SUM
        rendered = hit & (attention >= find_threshold(attention[hit]).value)
        if is_visible:
            masks = {name: view_answer.mask for name, view_answer in by_threshold.items()} | {"rendered": rendered}
            for name, mask in masks.items():
                rows[name].append(mask_iou(mask, truth))
            rows["best"].append(best_iou(attention, hit, truth))
        else:
            rows["absent"].append(float(by_threshold["auto"].mask.mean()))
            rows["absent rendered"].append(float(rendered.mean()))
    return rows


def measure_phrases(scene: Scene, truth: Truth, encoder: TextEncoder) -> dict[str, float]:
    """Means over the words and the held-out views, each word asked for alone; ``worst`` is the mean of one word."""
    of_words = []
    for number, word in enumerate(truth.words):
        answers = {way: ask(scene, Query.of((word,), threshold=way), encoder) for way in METHODS}
        of_words.append(
            compare_thresholds(scene, answers, [(view, mask == number) for view, mask in truth.held_out.items()])
        )
    columns = {name: [value for rows in of_words for value in rows[name]] for name in COLUMNS}
    worst = min(float(np.mean(rows["auto"])) for rows in of_words if rows["auto"])
    return {name: float(np.mean(values)) for name, values in columns.items() if values} | {"worst": worst}


def rows_of(folder: Path, packs: Iterable[str], lifts: Iterable[str], stride: int) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth, encoder = tabletop(folder), open_encoder(f"table:{folder / 'text_table.safetensors'}")
    for pack, name in product(packs, lifts):
        lifted = truth.lift(read_pack(folder, pack), **LIFTS[name], view_stride=stride)
        head = {"scene": "tabletop", "features": f"{pack}, {len(lifted.views)} views", "lift": name}
        yield head | measure_phrases(truth.open_scene(lifted), truth, encoder)


def still_life_rows(lifts: Iterable[str]) -> Iterator[dict[str, Any]]:
    """One row a kind of mistakes and a lift."""
    encoder = open_encoder("minilm")
    for seed, kind in enumerate(("usual", "hard", "cone"), start=7):
        truth, views = still_life_scene(kind, seed)
        for name in lifts:
            scene = truth.open_scene(truth.lift(views, **LIFTS[name]))
            yield {"scene": "still life", "features": kind, "lift": name} | measure_phrases(scene, truth, encoder)


def measure_alone(scene: Scene, truth: Truth, encoder: TextEncoder, absent: Sequence[str]) -> dict[str, Any]:
    """Measure the selection of ``auto`` for each word, ``absent=keep``, and for words of absent objects."""
    answers = [ask(scene, Query.of((word,), absent="keep"), encoder) for word in truth.words]
    masks = [
        objects(scene, answer).numbers >= 0 if answer.count <= MOST_GROUPED else answer.selected for answer in answers
    ]
    values = torch.from_numpy(np.stack([*masks, np.ones(len(masks[0]))], axis=1).astype(np.float32))
    rows: dict[str, list[float]] = {word: [] for word in truth.words}
    for view, mask in truth.held_out.items():
        image = scene.image(view, lambda camera: scene.raster.render(camera, values, scene.compositing))
        weights, sums = image[..., :-1], image[..., -1:]
        visible = (sums >= MINIMUM_ROW_SUM) & (weights >= LEAST_SHARE * sums)
        for number, word in enumerate(truth.words):
            if bool((mask == number).any()):
                rows[word].append(mask_iou(visible[..., number], mask == number))
    means = {word: float(np.mean(values)) for word, values in rows.items() if values}
    worst = min(means, key=lambda word: means[word])
    states = {word: answer.present for word, answer in zip(truth.words, answers, strict=True)}
    rejected = [ask(scene, word, encoder).count == 0 for word in absent]
    return {
        "mean": float(np.mean(list(means.values()))),
        "worst": means[worst],
        "worst phrase": worst,
        "called absent": ", ".join(word for word, state in states.items() if state is False) or "-",
        "not sure": ", ".join(word for word, state in states.items() if state is None) or "-",
        "absent words select nothing": float(np.mean(rejected)),
    }


def rows_alone(
    folder: Path, packs: Iterable[str], stride: int, still_life: bool, smoothness: str
) -> Iterator[dict[str, Any]]:
    """One row a lift by `default`: of tabletop, and of the still life with five seeds of mistakes."""
    truth, table = tabletop(folder), TableEncoder.open(folder / "text_table.safetensors")
    other_words = [word for word in table.words if word not in truth.words]
    keywords: dict[str, Any] = {
        "preset": "default",
        "smoothness": smoothness if smoothness == "auto" else float(smoothness),
    }
    absent = np.random.default_rng(0).choice(other_words, ABSENT, replace=False).tolist()
    for pack in packs:
        scene = truth.open_scene(truth.lift(read_pack(folder, pack), view_stride=stride, **keywords))
        yield {"scene": f"{pack}, {len(scene.metadata.views)} views"} | measure_alone(scene, truth, table, absent)
    for kind, seed in product(("usual", "hard"), range(7, 12) if still_life else ()):
        still_life_truth, views = still_life_scene(kind, seed)
        scene = still_life_truth.open_scene(still_life_truth.lift(views, **keywords))
        head = {"scene": f"still life, {kind} {seed}"}
        yield head | measure_alone(scene, still_life_truth, open_encoder("minilm"), NOT_THERE)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.thresholds",
        __doc__,
        ("folder", {"type": Path}),
        ("--features", {"nargs": "*", "default": PACKS, "choices": PACKS}),
        ("--lifts", {"nargs": "+", "default": tuple(LIFTS), "choices": tuple(LIFTS)}),
        ("--still-life", {"action": "store_true", "help": "the still life too, which nothing was tuned on"}),
        ("--alone", {"action": "store_true", "help": "each phrase alone by auto, and words for what is not there"}),
        ("--every", {"type": int, "default": 1, "metavar": "N", "help": "tabletop's every N-th view alone"}),
        ("--smoothness", {"default": "0", "metavar": "L", "help": "of the lifts for --alone; a number or auto"}),
    )
    options = parser.parse_args()
    if options.alone:
        arguments = options.folder, options.features, options.every, options.still_life, options.smoothness
        print_rows(rows_alone(*arguments), as_json=options.json)
        return
    rows = list(rows_of(options.folder, options.features, options.lifts, options.every))
    rows += still_life_rows(options.lifts) if options.still_life else []
    print_rows(rows, as_json=options.json, columns=("scene", "features", "lift", "worst", *COLUMNS))


if __name__ == "__main__":
    main()
