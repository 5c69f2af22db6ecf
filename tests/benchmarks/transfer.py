"""What a lift is worth on edited, compressed, decimated and moved copies of its splats.

    python -m tests.benchmarks.transfer FOLDER [--lift LIFT] [--node NODE --tool CLI.mjs]

FOLDER is `tabletop`: a lift of its features is transferred to each copy (`LiftResult.transferred`), its splats are
named by the scene's words, and the words in the held-out views are compared with the true masks: the mean IoU over
all classes and views. Copies that splat-transform makes need node and its command line script.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

import liftcore as lc
from liftcore.query.segment import value_map
from liftcore.scene.similarity import Similarity

MOVE = Similarity.of(scale=2.5, rotation=[0.8, 0.2, -0.4, 0.3], translation=[10.0, -4.0, 7.0])


class Judge:
    """The true masks of the held-out views."""

    def __init__(self, folder: Path) -> None:
        document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        truth = load_file(folder / "truth.safetensors")
        self.words = [one["class"] for one in sorted(document["objects"], key=lambda one: one["id"])]
        self.masks = {view: truth[f"{view}/mask"] for view in document["held_out_views"]}
        self.cameras = lc.read_cameras(folder / "cameras.json")
        self.table = lc.open_encoder(f"table:{folder / 'text_table.safetensors'}")

    def mean_iou(self, result: lc.LiftResult, splats: lc.Splats, move: Similarity | None) -> float:
        """The mean over classes and views of the IoU, of what the lift's words show in them."""
        scene = lc.Scene(result, splats, self.cameras)
        found = scene.segment(self.words, encoder=self.table)
        values = np.zeros(len(found.found) + 1, int)
        values[1:] = [self.words.index(named.word) + 1 for named in found.found]
        ratios = []
        for view, mask in self.masks.items():
            camera = self.cameras[view]
            if move is not None:
                camera = camera.transformed(scale=move.scale, rotation=move.rotation, translation=move.translation)
            shown = values[value_map(scene, found.values, camera)]
            for number in np.unique(mask[mask >= 0]):
                own, true = shown == number + 1, mask == number
                ratios.append((own & true).sum() / (own | true).sum())
        return float(np.mean(ratios))


def copies(splats: lc.Splats, folder: Path, node: str, tool: str) -> dict[str, tuple[Path, Similarity | None]]:
    """Edited copies of the scene's splats by their names, and how each was moved."""
    source = folder / "scene.ply"
    lc.write_splats(source, splats)
    generator = np.random.default_rng(0)
    places = splats.positions()
    inside = (np.abs(places - np.median(places, axis=0)) < 3.2).all(axis=1)
    move = {"scale": MOVE.scale, "rotation": MOVE.rotation, "translation": MOVE.translation}
    edited = {
        "cropped to the table": splats[inside],
        "shuffled": splats[generator.permutation(splats.count)],
        "a random third": splats[np.sort(generator.permutation(splats.count)[: splats.count // 3])],
        "turned and scaled": splats.transformed(**move),
        "shuffled, turned and scaled": splats[generator.permutation(splats.count)].transformed(**move),
    }
    found: dict[str, tuple[Path, Similarity | None]] = {}
    for name, some in edited.items():
        found[name] = folder / f"{name}.ply", MOVE if name.endswith("turned and scaled") else None
        lc.write_splats(found[name][0], some)
    for suffix in ("spz", "glb"):
        found[f"our .{suffix}"] = folder / f"ours.{suffix}", None
        lc.write_splats(found[f"our .{suffix}"][0], splats)

    def transform(*arguments: Path | str) -> None:
        subprocess.run([node, tool, "-w", *map(str, arguments)], check=True, capture_output=True)

    if node:
        for name in ("spz", "sog", "compressed.ply"):
            back = folder / f"{name} back.ply"
            transform(source, folder / f"via.{name}")
            transform(folder / f"via.{name}", back)
            found[f"through .{name} and back"] = back, None
        transform("-g", "cpu", source, "--decimate", "33%", folder / "third.ply")
        found["decimated to a third"] = folder / "third.ply", None
    return found


def main() -> None:
    """Print a line a copy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lift", type=Path, help="of the scene; else it is lifted")
    parser.add_argument("--node", default="")
    parser.add_argument("--tool", default="")
    options = parser.parse_args()
    splats = lc.read_splats(options.folder / "point_cloud.ply")
    judge = Judge(options.folder)
    if options.lift:
        result = lc.load_lift(options.lift)
    else:
        result = lc.lift(splats, judge.cameras, lc.read_features(options.folder / "features.safetensors"))
    print(f"| copy | splats | rows | mixed | no partner | seconds | mIoU |\n|{'---|' * 7}")
    print(f"| as lifted | {splats.count} | | | | | {judge.mean_iou(result, splats, None):.4f} |", flush=True)
    with tempfile.TemporaryDirectory() as name:
        for copy, (path, move) in copies(splats, Path(name), options.node, options.tool).items():
            new, start = lc.read_splats(path), time.perf_counter()
            other = result.transferred(splats, new, progress=False)
            seconds, facts = time.perf_counter() - start, other.diagnostics["transfer"]
            counts = " | ".join(str(facts[key]) for key in ("rows", "mixed", "without_partner"))
            score = judge.mean_iou(other, new, move)
            print(f"| {copy} | {new.count} | {counts} | {seconds:.1f} | {score:.4f} |", flush=True)


if __name__ == "__main__":
    main()
