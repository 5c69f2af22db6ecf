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
from tests.benchmarks.base import command_line, mask_iou, read_pack, read_scene, tell
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
    counted, own = truth.counted.numpy(), owners[truth.counted.numpy()]
    assert scene.node_parents is not None
    nodes = np.stack([scene.members(node)[counted] for node in range(len(scene.node_parents))])
    things = [row for row, word in enumerate(truth.words) if word not in CLOTHS]
    wanted = [one for one in np.unique(own) if (one // PARTS if owners.max() >= len(truth.words) else one) in things]
    tables = [(nodes & (own == one)).sum(axis=1) / (nodes | (own == one)).sum(axis=1) for one in wanted]
    return np.array([table.max() for table in tables])


def click_ious(scene: Scene, truth: Truth, owners: np.ndarray) -> dict[str, list[float]]:
    """What one click a part and held-out view finds."""
    found: dict[str, list[float]] = {"best": [], "best thing": [], "alone": []}
    assert scene.node_parents is not None
    parts, nodes = int(owners.max()) + 1, range(len(scene.node_parents))
    of_parts = np.stack([owners == one for one in range(parts)], axis=1)
    of_nodes = np.stack([scene.members(node) for node in nodes], axis=1)
    for view, classes in truth.held_out.items():
        seen = masks(scene, np.concatenate([of_parts, of_nodes], axis=1), view)
        true, meant, shown = seen[..., :parts], seen[..., parts:], classes.numpy()
        clicked = [
            one
            for one in range(parts)
            if truth.words[one // PARTS] not in CLOTHS and true[..., one].sum() >= LEAST_PIXELS
        ]
        clicks = [Query(like=["{}:{},{}".format(view, *innermost(true[..., one]))], top=0) for one in clicked]
        alone = masks(scene, np.stack([ask(scene, query).selected for query in clicks], axis=1), view)
        for place, (one, query) in enumerate(zip(clicked, clicks, strict=True)):
            sets = [node.id for node in candidates(scene, query)]
            ious = [mask_iou(meant[..., node], true[..., one]) for node in sets]
            things = [mask_iou(meant[..., node], shown == one // PARTS) for node in sets]
            found["best"].append(max(ious, default=0.0))
            found["best thing"].append(max(things, default=0.0))
            found["alone"].append(mask_iou(alone[..., place], true[..., one]))
    return found


def rows_of(folder: Path, packs: list[str], every: list[int]) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene by `default`."""
    truth, known = tabletop(folder), load_file(folder / "truth.safetensors")
    owners = (PARTS * known["splat_object"].long() + known["splat_part"].long()).numpy()
    for pack in packs:
        for step in every:
            with processor_time():
                lifted = truth.lift(read_pack(folder, pack), preset="default", view_stride=step)
            yield {"features": f"{pack}, {len(lifted.views)} views"} | measured(truth.opened(lifted), truth, owners)


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


def level_scores(levels: Sequence[np.ndarray], words: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """[P, n] f32: how near splats are to each word in the level of its own that answers it best.

    Args:
        levels: [P, F] unit, of each level's lift. words: [n, F] unit. counted: [P] bool, the splats that choose.
    """
    tables, margins = [features @ words.T for features in levels], []
    for table in tables:
        near = table[counted]
        ranked = np.sort(near, axis=1)
        beside = np.where(near == ranked[:, -1:], ranked[:, -2:-1], ranked[:, -1:])  # the nearest other word
        margins.append(np.sort(near - beside, axis=0)[-BEST_SPLATS:].mean(axis=0))
    chosen = np.argmax(margins, axis=0)
    return np.stack([tables[level][:, word] for word, level in enumerate(chosen)], axis=1)


def node_scores(scene: Scene, words: np.ndarray) -> np.ndarray:
    """[P, n] f32: how near the best node of each splat's path is to each word; -1 for splats of no node."""
    assert scene.node is not None and scene.node_parents is not None and scene.node_features is not None
    scores = scene.node_features.astype(np.float32) @ words.T
    for node in np.argsort([len(scene.node_path(node)) for node in range(len(scores))], kind="stable"):
        if (whole := scene.node_parents[node]) >= 0:
            scores[node] = np.maximum(scores[node], scores[whole])
    return np.concatenate([scores, np.full((1, len(words)), -1, np.float32)])[scene.node]


def word_iou(scores: np.ndarray, owners: np.ndarray, counted: np.ndarray) -> float:
    """Mean IoU of words, each at its best threshold.

    Args:
        scores: [P, n]. owners: [P] int, the word of each splat. counted: [P] bool, the splats that count.
    """
    ious, taken = [], np.arange(1, counted.sum() + 1)
    for word, column in enumerate(scores[counted].T):
        right = owners[counted] == word
        hits = np.cumsum(right[np.argsort(-column, kind="stable")])
        ranked = np.sort(-column)
        ends = np.append(ranked[1:] > ranked[:-1], True)  # equal scores are taken together
        ious.append(float((hits / (taken + right.sum() - hits))[ends].max()))
    return float(np.mean(ious))


def words_of(folder: Path, packs: Sequence[str], every: Sequence[int]) -> Iterator[dict[str, Any]]:
    """One row a set of words: IoU by sum, best level and best node."""
    truth, encoder = tabletop(folder), UnrelatedWords()
    for pack, step in product(packs, every):
        views = read_pack(folder, pack, step)
        things = truth.classes.numpy(), truth.objects.numpy()
        yield from compared(truth, views, {f"{pack}, {len(views)} views: things": things})
    made, (other, views) = still_life(STILL_LIFE_SEED), still_life_scene("hard", STILL_LIFE_SEED, encoder=encoder)
    asked = {"things": (made.things, made.splat_things), "parts": (made.parts, made.splat_parts)}
    name = f"still life, {len(views)} views"
    yield from compared(other, views, {f"{name}: {of}": (encoder.encode(a), b) for of, (a, b) in asked.items()})


def compared(
    truth: Truth, views: Mapping[str, ViewFeatures], asked: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> Iterator[dict[str, Any]]:
    """One row a set of words [n, F] with the word of each splat [P]."""
    scene, counted = truth.opened(truth.lift(views, preset="default")), truth.counted.numpy()
    alone = [unit(truth.lift(views, preset="default", levels=level).features.numpy()) for level in (0, 1)]
    for name, (words, owners) in asked.items():
        found = {
            "sum": unit(scene.features) @ words.T,
            "level": level_scores(alone, words, counted),
            "node": node_scores(scene, words),
        }
        facts = scene.metadata.diagnostics["objects"]
        yield {"words": name, "agreement": facts["level_agreement"]} | {
            way: word_iou(scores, owners, counted) for way, scores in found.items()
        }


def seconds_of(folder: Path, packs: list[str], every: list[int]) -> Iterator[dict[str, Any]]:
    """The processor time of one lift by `default` a pack and step."""
    splats, cameras = read_scene(folder)
    for pack in packs:
        for step in every:
            with processor_time():
                lifted = lc.lift(splats, cameras, read_pack(folder, pack, step), preset="default", threads=2)
            spent = seconds(lifted.metadata.timings)
            name = f"{pack}, {len(lifted.views)} views"
            yield {"features": name} | spent | {"share": spent["seconds"] / spent["of"]}


def named_miou(scene: Scene, truth: Truth) -> dict[str, float]:
    """The mIoU of each splat's nearest class, and of the classes that `Scene.segment` gives."""
    labels = torch.from_numpy(scene.segment(truth.words, truth.classes).labels)
    scores = torch.nn.functional.one_hot(labels.long() + 1, len(truth.words) + 1)[:, 1:].float()
    plain, params = torch.from_numpy(scene.features).float() @ truth.classes.T, scene.compositing
    return {"argmax": truth.judge_scores(plain, params).miou, "segment": truth.judge_scores(scores, params).miou}


def look(folder: Path, clicks: list[str]) -> None:
    """Draw the candidates of clicks: VIEW X,Y OUT.png each, on a lift of the folder's regions by `default`."""
    splats, cameras = read_scene(folder)
    lifted = lc.lift(splats, cameras, read_pack(folder, "regions"), preset="default").cpu()
    scene = Scene(lifted, splats, cameras)
    for view, place, out in zip(clicks[::3], clicks[1::3], clicks[2::3], strict=True):
        drawn = scene.render(view)
        meant = candidates(scene, Query(like=[f"{view}:{place}"]))
        print(view, place, [(one.set, one.kind, one.splats) for one in meant])
        tiles = [drawn]
        for one in meant:
            (mask,) = np.moveaxis(masks(scene, scene.members(one.id)[:, None], view), 2, 0)
            tiles.append(np.where(mask[..., None], drawn, drawn // 4))
        Image.fromarray(np.concatenate(tiles, axis=1)).save(out)


def main() -> None:
    """Print the table, or one JSON object; or draw pictures."""
    if sys.argv[1:2] == ["--look"]:
        parser = argparse.ArgumentParser()
        parser.add_argument("--look", type=Path)
        parser.add_argument("clicks", nargs="+")
        options = parser.parse_args()
        look(options.look, options.clicks)
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
        tell(seconds_of(options.folder, options.features, options.every), as_json=options.json)
        return
    if options.words:
        tell(words_of(options.folder, options.features, options.every), as_json=options.json)
        return
    tell(rows_of(options.folder, options.features, options.every), as_json=options.json)


if __name__ == "__main__":
    main()
