"""Parts and wholes on the tabletop scene: the tree of a lift, and what clicks and words find of it.

    python -m tests.benchmarks.parts DIR [--every N ...] [--json]
    python -m tests.benchmarks.parts DIR --seconds [--every N ...] [--json]
    python -m tests.benchmarks.parts --look DIR VIEW X,Y OUT.png ...

``nodes`` and ``largest`` are of the tree; ``thing`` and ``part`` the mean IoU, over splats with evidence over 0.5, of
the best node of each true thing and part (table and curtain, which hold the things, left out), ``worst part`` the
least. ``clicks`` are one a true part and held-out view that shows 100 pixels of it, at its innermost pixel:
``best`` is the mean mask IoU of the best candidate with the part, ``best thing`` with the thing, ``alone`` that of
the plain answer of the same click with the part. ``agreement`` is that of levels, ``seconds`` the processor time of
the objects stage, tree and all, of the lift's ``of`` without compilation. ``--seconds`` measures these alone, on any
scene with such a pack.

``--look`` draws a view of a scene with the candidates of a click side by side, for eyes.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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
from tests.benchmarks.base import command_line, mask_iou, read_pack, read_scene, tell
from tests.benchmarks.tabletop import Truth, tabletop

PARTS = 4  # of a thing at most, as truth numbers them
LEAST_PIXELS = 100  # of a part in a view, to be clicked
CLOTHS = ("tablecloth", "curtain")


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
    facts = scene.metadata.certificate["objects"]
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
        ("--every", {"nargs": "+", "type": int, "default": [1, 4], "metavar": "N", "help": "every N-th view alone"}),
    )
    options = parser.parse_args()
    if options.seconds:
        tell(seconds_of(options.folder, options.features, options.every), as_json=options.json)
        return
    tell(rows_of(options.folder, options.features, options.every), as_json=options.json)


if __name__ == "__main__":
    main()
