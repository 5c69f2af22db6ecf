"""Accuracy on the tabletop scene, beside the baselines that its data README gives.

    python -m tests.benchmarks.tabletop DIR [--robust N] [--json]

Each row is one lift. Splat accuracy is the share of splats whose most similar class vector is their own class, over
the splats whose evidence from the 52 views of ``features.safetensors`` exceeds 0.5, whatever the lift. mIoU is of the
argmax over the class scores, rendered in the held-out views with the opacity gain of the lift.
"""

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidInput
from liftcore.evaluate.accuracy import class_ious, rendered_scores
from liftcore.features.pack import read_features
from liftcore.features.views import NO_LABEL, Regions
from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from liftcore.raster.base import CompositingParams, Raster, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Cameras
from liftcore.settings import LiftSettings
from tests.benchmarks.base import (
    cameras_of,
    class_scores,
    command_line,
    lift_files,
    scene_files,
    splat_accuracy,
    tell,
)

EVIDENCE_PACK = "features"  # its views say which splats count
EVIDENCE_OVER = 0.5
TRUTH_FILES = ("truth.json", "truth.safetensors", "text_table.safetensors")


@dataclass(frozen=True)
class Case:
    """One lift, and the figures that the data README gives for it (None where it gives none)."""

    pack: str
    power: int
    gain: float  # lambda, lifting and rendering
    accuracy: float | None = None
    miou: float | None = None
    grid_reading: str = "bilinear"
    robust_steps: int = 0

    @property
    def values(self) -> dict[str, Any]:
        """The settings of the row, by name."""
        gains = {"lift_gain": self.gain, "render_gain": self.gain}
        reading = {"grid_reading": self.grid_reading, "robust_steps": self.robust_steps}
        return {"preset": "row-sum", "power": self.power, **gains, **reading}

    @property
    def settings(self) -> LiftSettings:
        """The same, as a lift has them."""
        return LiftSettings.of(**self.values)

    @property
    def name(self) -> str:
        """As the table prints it."""
        robust = f", robust {self.robust_steps}" if self.robust_steps else ""
        weights = ("w" if self.power == 1 else "w^2") + ("" if self.gain == 1 else f", lambda {self.gain:g}")
        reading = f" {self.grid_reading}" if self.pack == "grids" else ""
        return f"{self.pack}{reading}, {weights}{robust}"


# The README's grids were read at the nearest cell, so its figures stand at that reading.
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
    Case("grids", 1, 1.0, 0.914, 0.896, "nearest"),
    Case("grids", 2, 1.0, 0.895, 0.875, "nearest"),
    Case("grids", 2, 1.2, grid_reading="nearest"),
    Case("grids", 1, 1.0),
    Case("grids", 2, 1.0),
    Case("grids", 2, 1.2),
)


@dataclass(frozen=True)
class Figures:
    """What a lift reached."""

    accuracy: float  # over splats with evidence over 0.5
    miou: float
    seconds: float  # of the lift, without reading the truth


class Tabletop:
    """The scene and its truth, opened once for many lifts."""

    def __init__(self, folder: Path) -> None:
        from safetensors import SafetensorError, safe_open

        self.folder = folder
        missing = [name for name in TRUTH_FILES if not (folder / name).is_file()]
        if missing:
            raise _no_truth(folder, f"no {' and no '.join(missing)}")
        try:
            document = json.loads((folder / "truth.json").read_text())
            with safe_open(str(folder / "truth.safetensors"), framework="pt") as truth:
                self.objects: Tensor = truth.get_tensor("splat_object")  # [P] i16, the class of every splat
                self.held_out = {view: truth.get_tensor(f"{view}/mask") for view in document["held_out_views"]}
            with safe_open(str(folder / "text_table.safetensors"), framework="pt") as table:
                vectors = table.get_tensor("embeddings")[[thing["lvis_row"] for thing in document["objects"]]]
        except (OSError, ValueError, LookupError, TypeError, SafetensorError) as error:
            raise _no_truth(folder, f"files that do not hold that ({type(error).__name__}: {error})") from None
        self.classes: Tensor = torch.nn.functional.normalize(vectors.float(), dim=1)  # [K, F]
        self.cameras: Cameras = read_cameras(cameras_of(folder))
        if self.cameras.distorted:
            raise InvalidInput(
                str(folder), expected="undistorted cameras beside its truth",
                got=f"{len(self.cameras.distorted)} distorted ones",
                hint="'splatlift tradeoff --labels' takes them, or undistort photos and masks",
            )  # fmt: skip
        self.raster = CpuRaster(read_splats(folder / "point_cloud.ply"))
        self.counted = self._counted_splats()

    def _counted_splats(self) -> Tensor:
        """[P] bool: splats with evidence over 0.5 in the views of EVIDENCE_PACK."""
        nothing = Regions(torch.full((1, 1, 1), NO_LABEL, dtype=torch.int32), torch.ones(1, 1))
        evidence = np.zeros(self.raster.splats.count)
        for view in read_features(self.folder / f"{EVIDENCE_PACK}.safetensors").views:
            weights = self.raster.region_weights(self.cameras[view], nothing, CompositingParams(), Weighting())
            evidence[weights.evidence_splats.numpy()] += weights.evidence.numpy()
        return torch.from_numpy(evidence > EVIDENCE_OVER)

    def measure(self, case: Case) -> Figures:
        """Lift, classify the splats, and look from the held-out views."""
        start = time.perf_counter()
        features = lift_files(scene_files(self.folder, case.pack), **case.values).features
        return self.judge(features, case.settings, time.perf_counter() - start)

    def judge(
        self, features: Tensor, settings: LiftSettings, seconds: float = 0.0, raster: Raster | None = None
    ) -> Figures:
        """The figures of lifted features [P, F] against the truth; the settings say how they are rendered.

        Args:
            raster: of the same splats in another form; None takes the scene's own.
        """
        scores = class_scores(features, self.classes)
        miou = self.miou(self.maps(features, settings, raster or self.raster))
        return Figures(splat_accuracy(scores, self.objects, self.counted), miou, seconds)

    def miou(self, maps: Iterable[Tensor]) -> float:
        """Mean IoU over classes of each pixel's best class, of score maps [H, W, K] of the held-out views."""
        best = torch.stack([image.argmax(dim=2) for image in maps])
        return float(class_ious(best, torch.stack(list(self.held_out.values())), len(self.classes)).nanmean())

    def maps(self, features: Tensor, settings: LiftSettings, raster: Raster) -> Iterator[Tensor]:
        """Each held-out view's rendered class scores [H, W, K] f32."""
        for view in self.held_out:
            camera = self.cameras[view]
            yield rendered_scores(raster, camera, features, self.classes, settings.render_params)


def _no_truth(folder: Path, got: str) -> InvalidInput:
    return InvalidInput(
        str(folder), expected=f"truth in the layout of tabletop ({', '.join(TRUTH_FILES)})", got=got,
        hint="docs/results.md says under The paper's experiments which of them need none",
    )  # fmt: skip


def rows_of(scene: Tabletop, cases: Iterable[Case]) -> Iterator[dict[str, Any]]:
    """One row a lift, beside the figures of the data README."""
    for case in cases:
        found = scene.measure(case)
        yield {
            "features, weights": case.name, "accuracy": found.accuracy, "README accuracy": case.accuracy,
            "mIoU": found.miou, "README mIoU": case.miou, "lift s": found.seconds,
        }  # fmt: skip


def main() -> None:
    """Print the table, or one JSON object."""
    robust = {"type": int, "default": 0, "metavar": "N", "help": "lift with N robust steps"}
    parser = command_line("tests.benchmarks.tabletop", __doc__, ("folder", {"type": Path}), ("--robust", robust))
    options = parser.parse_args()
    scene = Tabletop(options.folder)
    note = f"{int(scene.counted.sum())} of {len(scene.counted)} splats count"
    cases = (replace(case, robust_steps=options.robust) for case in CASES)
    tell(rows_of(scene, cases), as_json=options.json, note=note)


if __name__ == "__main__":
    main()
