"""Parts and wholes on the tabletop scene: the tree of a lift, and what clicks and words find of it.

    python -m tests.benchmarks.parts DIR [--every N ...] [--json]
    python -m tests.benchmarks.parts DIR --seconds [--every N ...] [--json]
    python -m tests.benchmarks.parts DIR --words [--every N ...] [--json]
    python -m tests.benchmarks.parts --look DIR VIEW X,Y OUT.png ...

``nodes`` and ``largest`` are of the tree; ``thing`` and ``part`` the mean IoU, over splats with total weight over
0.5, of the best node of each true thing and part (table and curtain, which hold the things, left out), ``worst part``
the least. ``clicks`` are one a true part and held-out view that shows 100 pixels of it, at its innermost pixel:
``best`` is the mean mask IoU of the best candidate with the part, ``best thing`` with the thing, ``alone`` that of
the plain answer of the same click with the part. ``agreement`` is that of levels, ``seconds`` the processor time of
the objects stage, tree and all, of the lift's ``of`` without compilation. ``--seconds`` measures these alone, on any
scene with such a pack.

``--words`` compares three ways to score splats for a word: by ``sum``, the lift's features; by ``level``, those of
the lift of one level alone whose best splats are nearest to the word, beside the nearest other word; by ``node``, the
best node of each splat's path. Figures are the mean IoU of words over splats with total weight over 0.5, each at its
best threshold. Beside the folder's things it asks those and the parts of the tests' still life under hard masks,
whose words here share nothing, so that its levels say different things.

``--look`` draws a view of a scene with the candidates of a click side by side, for eyes.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file
from scipy.ndimage import distance_transform_edt

import liftcore as lc
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.ask import ask
from liftcore.query.candidates import candidates
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.values.views import ViewFeatures
from tests.benchmarks.base import command_line, mask_iou, print_rows, read_pack, read_scene
from tests.benchmarks.consensus import still_life_scene
from tests.benchmarks.tabletop import Truth, tabletop
from tests.still_life.scene import still_life

PARTS = 4  # of a thing at most, as truth numbers them
LEAST_PIXELS = 100  # of a part in a view, to be clicked
CLOTHS = ("tablecloth", "curtain")
BEST_SPLATS = 100  # by which a level is chosen
STILL_LIFE_SEED = 7


class UnrelatedWords:
    """A text encoder of random directions, so that no word says anything of another."""

    name, channels = "unrelated", 64

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """[n, 64] f32, unit, the same for the same text."""
        rows = [np.random.default_rng(list(text.encode())).normal(size=self.channels) for text in texts]
        return np.stack([row / np.linalg.norm(row) for row in rows]).astype(np.float32)


def masks(scene: Scene, members: np.ndarray, view: str) -> np.ndarray:
    """[H, W, n] bool: the pixels that are mostly of each of some sets of splats [P, n] bool."""
    values = torch.from_numpy(np.concatenate([members, np.ones((len(members), 1))], axis=1).astype(np.float32))
    image = scene.image(view, lambda camera: scene.raster.render(camera, values, scene.compositing)).numpy()
    sums = image[..., -1:]
    return (sums >= MINIMUM_ROW_SUM) & (image[..., :-1] >= 0.5 * sums)


def innermost(mask: np.ndarray) -> tuple[int, int]:
    """x and y of the pixel that lies deepest in a mask."""
    depth = np.asarray(distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), mask.shape)
    return int(x), int(y)


def best_nodes(scene: Scene, truth: Truth, owners: np.ndarray) -> np.ndarray:
    """The IoU of the best node of each owner, over the splats that count."""
    has_weight, part_of = truth.evaluated.numpy(), owners[truth.evaluated.numpy()]
    assert scene.node_parents is not None
    nodes = np.stack([scene.members(node)[has_weight] for node in range(len(scene.node_parents))])
    object_rows = [row for row, word in enumerate(truth.words) if word not in CLOTHS]
    parts = [
        number
        for number in np.unique(part_of)
        if (number // PARTS if owners.max() >= len(truth.words) else number) in object_rows
    ]
    tables = [
        (nodes & (part_of == number)).sum(axis=1) / (nodes | (part_of == number)).sum(axis=1) for number in parts
    ]
    return np.array([table.max() for table in tables])


def click_ious(scene: Scene, truth: Truth, owners: np.ndarray) -> dict[str, list[float]]:
    """Measure the masks of one click a part and held-out view."""
    results: dict[str, list[float]] = {"best": [], "best thing": [], "alone": []}
    assert scene.node_parents is not None
    parts, nodes = int(owners.max()) + 1, range(len(scene.node_parents))
    of_parts = np.stack([owners == number for number in range(parts)], axis=1)
    of_nodes = np.stack([scene.members(node) for node in nodes], axis=1)
    for view, classes in truth.held_out.items():
        image_masks = masks(scene, np.concatenate([of_parts, of_nodes], axis=1), view)
        true, node_masks, shown_classes = image_masks[..., :parts], image_masks[..., parts:], classes.numpy()
        clicked = [
            number
            for number in range(parts)
            if truth.words[number // PARTS] not in CLOTHS and true[..., number].sum() >= LEAST_PIXELS
        ]
        clicks = [Query(like=["{}:{},{}".format(view, *innermost(true[..., number]))], top=0) for number in clicked]
        single_masks = masks(scene, np.stack([ask(scene, query).selected for query in clicks], axis=1), view)
        for place, (number, query) in enumerate(zip(clicked, clicks, strict=True)):
            sets = [node.id for node in candidates(scene, query)]
            ious = [mask_iou(node_masks[..., node], true[..., number]) for node in sets]
            object_ious = [mask_iou(node_masks[..., node], shown_classes == number // PARTS) for node in sets]
            results["best"].append(max(ious, default=0.0))
            results["best thing"].append(max(object_ious, default=0.0))
            results["alone"].append(mask_iou(single_masks[..., place], true[..., number]))
    return results


def rows_of(folder: Path, packs: list[str], strides: list[int]) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene by `default`."""
    truth, tensors = tabletop(folder), load_file(folder / "truth.safetensors")
    owners = (PARTS * tensors["splat_object"].long() + tensors["splat_part"].long()).numpy()
    for pack in packs:
        for step in strides:
            with processor_time():
                lifted = truth.lift(read_pack(folder, pack), preset="default", view_stride=step)
            yield {"features": f"{pack}, {len(lifted.views)} views"} | measured(
                truth.open_scene(lifted), truth, owners
            )


def measured(scene: Scene, truth: Truth, owners: np.ndarray) -> dict[str, Any]:
    """The figures of one lift; owners [P] int, the part of each splat."""
    facts = scene.metadata.diagnostics["objects"]
    parts, clicks = best_nodes(scene, truth, owners), click_ious(scene, truth, owners)
    return {
        "nodes": facts["nodes"], "largest": facts["largest_share"], "agreement": facts["level_agreement"],
        "thing": float(best_nodes(scene, truth, truth.objects.numpy()).mean()),
        "part": float(parts.mean()), "worst part": float(parts.min()), "clicks": len(clicks["best"]),
        **{name: float(np.mean(values)) for name, values in clicks.items()}, **named_miou(scene, truth),
        **seconds(scene.metadata.timings),
    }  # fmt: skip


@contextmanager
def processor_time() -> Iterator[None]:
    """Have lifts time their stages by the processor time of all threads, which other work does not lengthen."""
    with patch("liftcore.runtime.progress.time.perf_counter", time.process_time):
        yield


def seconds(timings: Mapping[str, float]) -> dict[str, float]:
    return {"seconds": timings["objects"], "of": sum(timings.values()) - timings["compile"]}


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length one; zeros stay."""
    lengths = np.linalg.norm(rows.astype(np.float32), axis=1, keepdims=True)
    return rows.astype(np.float32) / np.where(lengths > 0, lengths, 1)


def level_scores(levels: Sequence[np.ndarray], words: np.ndarray, has_weight: np.ndarray) -> np.ndarray:
    """[P, n] f32: how near splats are to each word in the level of its own that answers it best.

    Args:
        levels: [P, F] unit, of each level's lift. words: [n, F] unit. has_weight: [P] bool, the splats that choose.
    """
    tables, margins = [features @ words.T for features in levels], []
    for table in tables:
        near = table[has_weight]
        ranked = np.sort(near, axis=1)
        second = np.where(near == ranked[:, -1:], ranked[:, -2:-1], ranked[:, -1:])  # the nearest other word
        margins.append(np.sort(near - second, axis=0)[-BEST_SPLATS:].mean(axis=0))
    best_level = np.argmax(margins, axis=0)
    return np.stack([tables[level][:, word] for word, level in enumerate(best_level)], axis=1)


def node_scores(scene: Scene, words: np.ndarray) -> np.ndarray:
    """[P, n] f32: how near the best node of each splat's path is to each word; -1 for splats of no node."""
    assert scene.node is not None and scene.node_parents is not None and scene.node_features is not None
    scores = scene.node_features.astype(np.float32) @ words.T
    for node in np.argsort([len(scene.node_path(node)) for node in range(len(scores))], kind="stable"):
        if (parent := scene.node_parents[node]) >= 0:
            scores[node] = np.maximum(scores[node], scores[parent])
    return np.concatenate([scores, np.full((1, len(words)), -1, np.float32)])[scene.node]


def word_iou(scores: np.ndarray, owners: np.ndarray, has_weight: np.ndarray) -> float:
    """Mean IoU of words, each at its best threshold.

    Args:
        scores: [P, n]. owners: [P] int, the word of each splat. has_weight: [P] bool, the splats that count.
    """
    ious, counts = [], np.arange(1, has_weight.sum() + 1)
    for word, column in enumerate(scores[has_weight].T):
        right = owners[has_weight] == word
        hits = np.cumsum(right[np.argsort(-column, kind="stable")])
        ranked = np.sort(-column)
        ends = np.append(ranked[1:] > ranked[:-1], True)  # equal scores are taken together
        ious.append(float((hits / (counts + right.sum() - hits))[ends].max()))
    return float(np.mean(ious))


def words_of(folder: Path, packs: Sequence[str], strides: Sequence[int]) -> Iterator[dict[str, Any]]:
    """One row a set of words: IoU by sum, best level and best node."""
    truth, encoder = tabletop(folder), UnrelatedWords()
    for pack, step in product(packs, strides):
        views = read_pack(folder, pack, step)
        labels = truth.classes.numpy(), truth.objects.numpy()
        yield from compare_levels(truth, views, {f"{pack}, {len(views)} views: things": labels})
    scene, (other, views) = still_life(STILL_LIFE_SEED), still_life_scene("hard", STILL_LIFE_SEED, encoder=encoder)
    queries = {"things": (scene.objects, scene.splat_objects), "parts": (scene.parts, scene.splat_parts)}
    name = f"still life, {len(views)} views"
    yield from compare_levels(
        other, views, {f"{name}: {of}": (encoder.encode(a), b) for of, (a, b) in queries.items()}
    )


def compare_levels(
    truth: Truth, views: Mapping[str, ViewFeatures], queries: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> Iterator[dict[str, Any]]:
    """One row a set of words [n, F] with the word of each splat [P]."""
    scene, has_weight = truth.open_scene(truth.lift(views, preset="default")), truth.evaluated.numpy()
    single_level = [unit(truth.lift(views, preset="default", levels=level).features.numpy()) for level in (0, 1)]
    for name, (words, owners) in queries.items():
        results = {
            "sum": unit(scene.features) @ words.T,
            "level": level_scores(single_level, words, has_weight),
            "node": node_scores(scene, words),
        }
        facts = scene.metadata.diagnostics["objects"]
        yield {"words": name, "agreement": facts["level_agreement"]} | {
            way: word_iou(scores, owners, has_weight) for way, scores in results.items()
        }


def seconds_of(folder: Path, packs: list[str], strides: list[int]) -> Iterator[dict[str, Any]]:
    """The processor time of one lift by `default` a pack and step."""
    splats, cameras = read_scene(folder)
    for pack in packs:
        for step in strides:
            with processor_time():
                lifted = lc.lift(splats, cameras, read_pack(folder, pack, step), preset="default", threads=2)
            stages = seconds(lifted.metadata.timings)
            name = f"{pack}, {len(lifted.views)} views"
            yield {"features": name} | stages | {"share": stages["seconds"] / stages["of"]}


def named_miou(scene: Scene, truth: Truth) -> dict[str, float]:
    """The mIoU of each splat's nearest class, and of the classes that `Scene.segment` gives."""
    labels = torch.from_numpy(scene.segment(truth.words, truth.classes).labels)
    scores = torch.nn.functional.one_hot(labels.long() + 1, len(truth.words) + 1)[:, 1:].float()
    products, params = torch.from_numpy(scene.features).float() @ truth.classes.T, scene.compositing
    return {
        "argmax": truth.evaluate_scores(products, params).miou,
        "segment": truth.evaluate_scores(scores, params).miou,
    }


def print_clicks(folder: Path, clicks: list[str]) -> None:
    """Draw the candidates of clicks: VIEW X,Y OUT.png each, on a lift of the folder's regions by `default`."""
    splats, cameras = read_scene(folder)
    lifted = lc.lift(splats, cameras, read_pack(folder, "regions"), preset="default").cpu()
    scene = Scene(lifted, splats, cameras)
    for view, place, out in zip(clicks[::3], clicks[1::3], clicks[2::3], strict=True):
        image = scene.render(view)
        clicked = candidates(scene, Query(like=[f"{view}:{place}"]))
        print(view, place, [(candidate.set, candidate.kind, candidate.splats) for candidate in clicked])
        tiles = [image]
        for candidate in clicked:
            (mask,) = np.moveaxis(masks(scene, scene.members(candidate.id)[:, None], view), 2, 0)
            tiles.append(np.where(mask[..., None], image, image // 4))
        Image.fromarray(np.concatenate(tiles, axis=1)).save(out)


def main() -> None:
    """Print the table, or one JSON object; or draw pictures."""
    if sys.argv[1:2] == ["--look"]:
        parser = argparse.ArgumentParser()
        parser.add_argument("--look", type=Path)
        parser.add_argument("clicks", nargs="+")
        options = parser.parse_args()
        print_clicks(options.look, options.clicks)
        return
    parser = command_line(
        "tests.benchmarks.parts",
        __doc__,
        ("folder", {"type": Path}),
        ("--features", {"nargs": "+", "default": ["features_hard"]}),
        ("--seconds", {"action": "store_true", "help": "the processor time of the lift alone"}),
        ("--words", {"action": "store_true", "help": "compare ways to answer words"}),
        ("--every", {"nargs": "+", "type": int, "default": [1, 4], "metavar": "N", "help": "every N-th view alone"}),
    )
    options = parser.parse_args()
    if options.seconds:
        print_rows(seconds_of(options.folder, options.features, options.every), as_json=options.json)
        return
    if options.words:
        print_rows(words_of(options.folder, options.features, options.every), as_json=options.json)
        return
    print_rows(rows_of(options.folder, options.features, options.every), as_json=options.json)


if __name__ == "__main__":
    main()
