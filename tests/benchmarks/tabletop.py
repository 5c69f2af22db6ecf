"""Accuracy on the tabletop scene, beside the baselines that its data README gives.

    python -m tests.benchmarks.tabletop DIR [--codes [PACK ...]] [--json]

Each row is one lift. Splat accuracy is the share of splats whose most similar class vector is their own class, over
the splats whose total weight from the 52 views of ``features.safetensors`` exceeds 0.5, whatever the lift. mIoU is of
the argmax over the class scores, rendered in the held-out views with the opacity gain of the lift.

``--codes`` compares lifts by the preset default with the same lifts as codes, of all views and of each fourth: also
the mean and the least IoU of the masks of the classes, asked by their words, in the held-out views, milliseconds of a
warm question, and the bytes of the file.
"""

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import torch
from safetensors.torch import load_file
from torch import Tensor

import liftcore as lc
from liftcore.evaluate.accuracy import shared_pixels
from liftcore.query.scene import Scene
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.values.views import NO_LABEL, ViewFeatures
from tests.benchmarks.base import command_line, print_rows, read_pack, read_scene

LEAST_TOTAL_WEIGHT = 0.5  # of the splats that count


@dataclass(frozen=True)
class Figures:
    """The accuracy of a lift."""

    accuracy: float  # over the splats that count
    miou: float  # over the classes, in the held-out views


@dataclass(frozen=True)
class Truth:
    """A scene with what is really there."""

    raster: CpuRaster
    cameras: lc.Cameras
    words: tuple[str, ...]  # [K], the classes
    classes: Tensor  # [K, F] f32, their unit vectors
    objects: Tensor  # [P] int, the class of each splat
    evaluated: Tensor  # [P] bool, those that accuracy is over
    held_out: Mapping[str, Tensor]  # view -> [H, W] int, the class of each pixel, -1 for none

    def lift(self, views: Mapping[str, ViewFeatures], **settings: Any) -> lc.LiftResult:
        """A lift of views onto the scene, without the diagnostics unless the settings ask for it."""
        options: dict[str, Any] = {"diagnostic_rays": 0, **settings}
        return lc.lift(self.raster.splats, self.cameras, views, **options).cpu()

    def open_scene(self, lifted: lc.LiftResult) -> Scene:
        """A lift to ask questions of."""
        scene = Scene(lifted, self.raster.splats, self.cameras)
        scene.raster = self.raster
        return scene

    def scores(self, lifted: lc.LiftResult) -> Tensor:
        """Compute the score of each class at each splat, [P, K] f32."""
        return lifted.features.float() @ self.classes.T

    def evaluate(self, lifted: lc.LiftResult) -> Figures:
        """The figures of a lift; rendering is linear, so that scores are rendered in place of features."""
        scores, params = self.scores(lifted), lifted.settings.compositing
        accuracy = float((scores.argmax(dim=1) == self.objects)[self.evaluated].float().mean())
        images = (self.raster.render(self.cameras[view], scores, params) for view in self.held_out)
        best = torch.stack([image.argmax(dim=2) for image in images])
        truth_labels = torch.stack(list(self.held_out.values()))
        best[truth_labels < 0] = NO_LABEL  # rays that meet nothing show no class
        shared, union = shared_pixels(best, truth_labels, len(self.classes))
        return Figures(accuracy, float((shared.double() / union)[union > 0].mean()))


def tabletop(folder: Path) -> Truth:
    """The scene in a folder in the layout of ``tabletop``, opened once for many lifts."""
    document, truth = json.loads((folder / "truth.json").read_text()), load_file(folder / "truth.safetensors")
    vectors = load_file(folder / "text_table.safetensors")["embeddings"]
    classes = vectors[[entry["lvis_row"] for entry in document["objects"]]].float()
    splats, cameras = read_scene(folder)
    no_labels = lc.Regions(torch.full((1, 1, 1), NO_LABEL, dtype=torch.int32), torch.ones(1, 1))
    return Truth(
        CpuRaster(splats),
        cameras,
        tuple(entry["class"] for entry in document["objects"]),
        torch.nn.functional.normalize(classes, dim=1),
        truth["splat_object"],
        evaluated_splats(splats, cameras, dict.fromkeys(read_pack(folder, "features"), no_labels)),
        {view: truth[f"{view}/mask"] for view in document["held_out_views"]},
    )


def evaluated_splats(splats: lc.Splats, cameras: lc.Cameras, views: Mapping[str, ViewFeatures]) -> Tensor:
    """[P] bool: the splats with total weight over LEAST_TOTAL_WEIGHT in these views."""
    weights = lc.region_weights(splats, cameras, views, preset="row-sum")
    total_weight = torch.zeros(splats.count)
    total_weight[weights.total_weight_splats.long()] = weights.total_weight
    return total_weight > LEAST_TOTAL_WEIGHT


@dataclass(frozen=True)
class Case:
    """One lift, and the figures that the data README gives for it (None where it gives none)."""

    pack: str
    power: int
    gain: float  # lambda, lifting and rendering
    accuracy: float | None = None
    miou: float | None = None

    @property
    def values(self) -> dict[str, Any]:
        """The settings of the row, by name."""
        return {"preset": "row-sum", "power": self.power, "gain": self.gain}

    @property
    def name(self) -> str:
        """As the table prints it."""
        weights = ("w" if self.power == 1 else "w^2") + ("" if self.gain == 1 else f", lambda {self.gain:g}")
        return f"{self.pack}, {weights}"


# The README's grids were read at the nearest cell, so its figures are of no row here.
CASES = (
    Case("features_clean", 1, 1.0, 0.958, 0.995),
    Case("features_clean", 2, 1.0, 0.959, 0.997),
    Case("features_clean", 2, 1.2),
    Case("features", 1, 1.0, 0.952, 0.989),
    Case("features", 2, 1.0, 0.947, 0.988),
    Case("features", 2, 1.2),
    Case("features_hard", 1, 1.0, 0.900, 0.935),
    Case("features_hard", 2, 1.0, 0.900, 0.939),
    Case("features_hard", 2, 1.2, 0.899, 0.940),
    Case("grids", 1, 1.0),
    Case("grids", 2, 1.0),
    Case("grids", 2, 1.2),
)


def measured(scene: Truth, folder: Path, case: Case) -> dict[str, Any]:
    """The row of one lift, beside the figures of the data README."""
    start = time.perf_counter()
    lifted = scene.lift(read_pack(folder, case.pack), **case.values)
    seconds, figures = time.perf_counter() - start, scene.evaluate(lifted)
    return {
        "features, weights": case.name, "accuracy": figures.accuracy, "README accuracy": case.accuracy,
        "mIoU": figures.miou, "README mIoU": case.miou, "lift s": seconds,
    }  # fmt: skip


def coded_rows(scene: Truth, folder: Path, pack: str, stride: int) -> Iterator[dict[str, Any]]:
    """The rows of a lift by the preset default, exact and as codes."""
    lift = scene.lift(read_pack(folder, pack, stride))
    encoder = lc.open_encoder(f"table:{folder / 'text_table.safetensors'}")
    lifts: dict[Literal["exact", "codes"], lc.LiftResult] = {"exact": lift, "codes": lift.as_codes()}
    for name, lifted in lifts.items():
        figures, lift_scene = scene.evaluate(lifted), scene.open_scene(lifted)
        ious, seconds = list[float](), list[float]()
        for number, word in enumerate(scene.words):
            lift_scene.ask(word, encoder=encoder, places=False)
            start = time.perf_counter()
            answer = lift_scene.ask(word, encoder=encoder, places=False)
            seconds.append(time.perf_counter() - start)
            pairs = [
                (torch.from_numpy(lift_scene.view_mask(answer, view).mask), truth == number)
                for view, truth in scene.held_out.items()
                if (truth == number).any()
            ]
            ious.append(sum(float((mask & truth).sum() / (mask | truth).sum()) for mask, truth in pairs) / len(pairs))
        with tempfile.TemporaryDirectory() as output:
            lifted.save(Path(output) / "lift.safetensors", features=name)
            size = (Path(output) / "lift.safetensors").stat().st_size
        facts = lifted.diagnostics.get("codes", {})
        yield {
            "features, views": f"{pack}, {len(lifted.views)}", "as": name, "rows": facts.get("rows"),
            "loss": facts.get("loss"), "accuracy": figures.accuracy, "mIoU": figures.miou,
            "phrases": sum(ious) / len(ious), "least": min(ious), "ms a word": 1e3 * median(seconds),
            "MB": size / 1e6,
        }  # fmt: skip


def main() -> None:
    """Print the table, or one JSON object."""
    codes = "--codes", {"nargs": "*", "metavar": "PACK", "help": "compare lifts as codes; default: of all packs"}
    options = command_line("tests.benchmarks.tabletop", __doc__, ("folder", {"type": Path}), codes).parse_args()
    scene = tabletop(options.folder)
    if options.codes is None:
        rows = [measured(scene, options.folder, case) for case in CASES]
    else:
        packs = options.codes or list(dict.fromkeys(case.pack for case in CASES))
        pairs = [(pack, stride) for pack in packs for stride in (1, 4)]
        rows = [row for pair in pairs for row in coded_rows(scene, options.folder, *pair)]
    print_rows(
        rows, as_json=options.json, note=f"{int(scene.evaluated.sum())} of {len(scene.evaluated)} splats count"
    )


if __name__ == "__main__":
    main()
