"""Accuracy of a lift on edited, compressed, decimated and moved copies of its splats.

    python -m tests.benchmarks.transfer [FOLDER] [--lift LIFT] [--node NODE --tool CLI.mjs] [--only COPY]

FOLDER is `tabletop`; without one it is the generated still life. A lift of its features is transferred to each copy
(`LiftResult.transferred`), its splats are named by the scene's words, and the words in the held-out views are
compared with the true masks: the mean IoU over all classes and views. The column `truth` is the same of the true
labels of the nearest old splats: what the copy's geometry leaves to be had. Copies that splat-transform makes need
node and its command line script.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file
from scipy.spatial import KDTree

import liftcore as lc
from liftcore.query.segment import value_map
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.similarity import Similarity
from liftcore.text.table import TableEncoder
from tests.still_life.masks import Mistakes, observe, true_labels
from tests.still_life.scene import still_life

HALF_TURN = Similarity.of(rotation=[0.0, 1.0, 0.0, 0.0])  # about x
MOVE = Similarity.of(scale=2.5, rotation=[0.8, 0.2, -0.4, 0.3], translation=[10.0, -4.0, 7.0])


@dataclass(frozen=True)
class TransferTruth:
    """A scene with its truth."""

    splats: lc.Splats
    cameras: lc.Cameras
    words: list[str]  # names of the classes
    splat_classes: np.ndarray  # [P], rows of words; -1: none
    masks: dict[str, np.ndarray]  # of held-out views [H, W], rows of words; -1: none
    encoder: Any
    features: Any  # of the other views

    @classmethod
    def of_folder(cls, folder: Path) -> TransferTruth:
        """The truth of a folder in the layout of `tabletop`."""
        document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        truth = load_file(folder / "truth.safetensors")
        return cls(
            lc.read_splats(folder / "point_cloud.ply"),
            lc.read_cameras(folder / "cameras.json"),
            [entry["class"] for entry in sorted(document["objects"], key=lambda entry: entry["id"])],
            truth["splat_object"].astype(int),
            {view: truth[f"{view}/mask"] for view in document["held_out_views"]},
            lc.open_encoder(f"table:{folder / 'text_table.safetensors'}"),
            lc.read_features(folder / "features.safetensors"),
        )

    @classmethod
    def of_still_life(cls) -> TransferTruth:
        """The truth of the generated scene, whose masks have mistakes."""
        scene = still_life()
        raster, words = CpuRaster(scene.splats), list(dict.fromkeys([*scene.objects, *scene.parts]))
        vectors = np.random.default_rng(7).standard_normal((len(words), 64)).astype(np.float32)
        encoder = TableEncoder("words", words, vectors)
        return cls(
            scene.splats,
            scene.cameras,
            list(scene.objects),
            scene.splat_objects.astype(int),
            {view: true_labels(scene, raster, view)[0] for view in scene.held_out},
            encoder,
            observe(scene, raster, encoder, Mistakes(), 7),
        )

    def mean_iou(self, result: lc.LiftResult, splats: lc.Splats, move: Similarity | None) -> float:
        """The mean over classes and views of the IoU, of what the lift's words show in them."""
        scene = lc.Scene(result, splats, self.cameras)
        segmentation = scene.segment(self.words, encoder=self.encoder)
        classes = np.array([-1, *(self.words.index(label.word) for label in segmentation.named_words)])
        return self._mean_iou(scene, classes[segmentation.values], move)

    def mean_iou_of_truth(self, result: lc.LiftResult, splats: lc.Splats, move: Similarity | None) -> float:
        """The same, of the true classes of the nearest splats."""
        places = splats.positions().astype(float)
        if move is not None:
            places = (places - move.translation) @ move.rotation / move.scale
        nearest = KDTree(self.splats.positions()).query(places)[1]
        return self._mean_iou(lc.Scene(result, splats, self.cameras), self.splat_classes[nearest], move)

    def _mean_iou(self, scene: lc.Scene, classes: np.ndarray, move: Similarity | None) -> float:
        ratios = []
        for view, mask in self.masks.items():
            camera = self.cameras[view]
            if move is not None:
                camera = camera.transformed(scale=move.scale, rotation=move.rotation, translation=move.translation)
            predicted = value_map(scene, classes + 1, camera) - 1
            for number in np.unique(mask[mask >= 0]):
                mask_of, true = predicted == number, mask == number
                ratios.append((mask_of & true).sum() / (mask_of | true).sum())
        return float(np.mean(ratios))


def copies(splats: lc.Splats, folder: Path, node: str, tool: str) -> dict[str, tuple[Path, Similarity | None]]:
    """Edited copies of the scene's splats by their names, and how each was moved."""
    source = folder / "scene.ply"
    lc.write_splats(source, splats)
    generator = np.random.default_rng(0)
    places = splats.positions()
    distances = np.abs(places - np.median(places, axis=0)).max(axis=1)
    inside = distances < np.quantile(distances, 0.8)
    move = {"scale": MOVE.scale, "rotation": MOVE.rotation, "translation": MOVE.translation}
    edited = {
        "cropped to the middle 80 %": splats[inside],
        "shuffled": splats[generator.permutation(splats.count)],
        "a random third": splats[np.sort(generator.permutation(splats.count)[: splats.count // 3])],
        "turned and scaled": splats.transformed(**move),
        "shuffled, turned and scaled": splats[generator.permutation(splats.count)].transformed(**move),
    }
    copies_by_name: dict[str, tuple[Path, Similarity | None]] = {}
    for name, edits in edited.items():
        copies_by_name[name] = folder / f"{name}.ply", MOVE if name.endswith("turned and scaled") else None
        lc.write_splats(copies_by_name[name][0], edits)
    for suffix in ("spz", "glb"):
        copies_by_name[f"our .{suffix}"] = folder / f"ours.{suffix}", None
        lc.write_splats(copies_by_name[f"our .{suffix}"][0], splats)

    def transform(*arguments: Path | str) -> None:
        subprocess.run([node, tool, "-w", *map(str, arguments)], check=True, capture_output=True)

    if node:
        for name in ("spz", "sog", "compressed.ply"):
            back = folder / f"{name} back.ply"
            transform("-g", "cpu", source, folder / f"via.{name}")
            transform(folder / f"via.{name}", back)
            copies_by_name[f"through .{name} and back"] = back, None
        copies_by_name["through .spz, which declares no frame"] = folder / "via.spz", HALF_TURN
        transform("-g", "cpu", source, "--decimate", "33%", folder / "third.ply")
        copies_by_name["decimated to a third"] = folder / "third.ply", None
    return copies_by_name


def main() -> None:
    """Print a line a copy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="of a scene with truth; else the still life")
    parser.add_argument("--lift", type=Path, help="of the scene; else it is lifted")
    parser.add_argument("--node", default="")
    parser.add_argument("--tool", default="")
    parser.add_argument("--only", default="", metavar="TEXT", help="copies whose name has this text")
    options = parser.parse_args()
    truth = TransferTruth.of_folder(options.folder) if options.folder else TransferTruth.of_still_life()
    splats = truth.splats
    result = lc.load_lift(options.lift) if options.lift else lc.lift(splats, truth.cameras, truth.features)
    scores = f"{truth.mean_iou(result, splats, None):.4f} | {truth.mean_iou_of_truth(result, splats, None):.4f}"
    print(f"| copy | splats | rows | mixed | no partner | seconds | mIoU | truth |\n|{'---|' * 8}")
    print(f"| as lifted | {splats.count} | | | | | {scores} |", flush=True)
    with tempfile.TemporaryDirectory() as name:
        for copy, (path, move) in copies(splats, Path(name), options.node, options.tool).items():
            if options.only not in copy:
                continue
            new, start = lc.read_splats(path), time.perf_counter()
            other = result.transferred(splats, new, progress=False)
            seconds, facts = time.perf_counter() - start, other.diagnostics["transfer"]
            counts = " | ".join(str(facts[key]) for key in ("rows", "mixed", "without_partner"))
            scores = f"{truth.mean_iou(other, new, move):.4f} | {truth.mean_iou_of_truth(other, new, move):.4f}"
            print(f"| {copy} | {new.count} | {counts} | {seconds:.1f} | {scores} |", flush=True)


if __name__ == "__main__":
    main()
