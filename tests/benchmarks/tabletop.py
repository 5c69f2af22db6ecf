"""Accuracy on the tabletop scene, beside the baselines that its data README gives.

    python -m tests.benchmarks.tabletop DIR [--robust N] [--json]

Each row is one lift. Splat accuracy is the share of splats whose most similar class vector is their own class, over
the splats whose evidence from the 52 views of ``features.safetensors`` exceeds 0.5, whatever the lift. mIoU is of the
argmax over the class scores, rendered in the held-out views with the opacity gain of the lift.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidInput
from liftcore.evaluate.accuracy import class_ious, class_scores, rendered_scores, splat_accuracy
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.features.pack import open_packs
from liftcore.features.views import NO_LABEL, Regions
from liftcore.io.cameras import read_cameras
from liftcore.io.ply import read_splats
from liftcore.lift import lift
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.settings import LiftSettings
from tests.benchmarks.scene_files import cameras_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from torch import Tensor

    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Cameras

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
    def settings(self) -> LiftSettings:
        """The weights of the row, without a certificate."""
        return LiftSettings.of(
            preset="row-sum",
            power=self.power,
            lift_gain=self.gain,
            render_gain=self.gain,
            grid_reading=self.grid_reading,
            robust_steps=self.robust_steps,
            certificate_rays=0,
        )

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
        for view in open_packs([self.folder / f"{EVIDENCE_PACK}.safetensors"]).views:
            weights = self.raster.region_weights(self.cameras[view], nothing, CompositingParams(), Weighting())
            evidence[weights.evidence_splats.numpy()] += weights.evidence.numpy()
        return torch.from_numpy(evidence > EVIDENCE_OVER)

    def measure(self, case: Case) -> Figures:
        """Lift, classify the splats, and look from the held-out views."""
        start = time.perf_counter()
        splats, pack = self.folder / "point_cloud.ply", self.folder / f"{case.pack}.safetensors"
        features = lift(splats, cameras_of(self.folder), [pack], case.settings).features
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
        return Figures(
            splat_accuracy(scores, self.objects, self.counted),
            miou,
            seconds,
        )

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
        hint="docs/accuracy.md says under Experiments what they hold, and which experiments need none",
    )  # fmt: skip


def measure_all(folder: Path, cases: Sequence[Case] = CASES) -> dict[str, Any]:
    """All cases as plain numbers, with the hardware that took the seconds."""
    scene = Tabletop(folder)
    rows = [{"name": case.name, "baseline": asdict(case), **asdict(scene.measure(case))} for case in cases]
    counted = int(scene.counted.sum())
    return {"splats": scene.raster.splats.count, "evidence_over_half": counted, "rows": rows, "hardware": hardware()}


def table_of(document: dict[str, Any]) -> str:
    """The rows beside their baselines, and the machine, for people."""
    head = f"{'features, weights':<38}{'accuracy':>9}{'base':>7}{'mIoU':>8}{'base':>7}{'lift s':>8}"
    lines = [head]
    for row in document["rows"]:
        base = [f"{row['baseline'][key]:.3f}" if row["baseline"][key] else "-" for key in ("accuracy", "miou")]
        lines.append(
            f"{row['name']:<38}{row['accuracy']:>9.4f}{base[0]:>7}"
            f"{row['miou']:>8.4f}{base[1]:>7}{row['seconds']:>8.1f}"
        )
    lines.append(machine_line(document["hardware"]))
    return "\n".join(lines)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.tabletop", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="the tabletop scene")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--robust", type=int, default=0, metavar="N", help="lift with N robust steps")
    options = parser.parse_args()
    document = measure_all(options.folder, [replace(case, robust_steps=options.robust) for case in CASES])
    print(json.dumps(document) if options.json else table_of(document))


if __name__ == "__main__":
    main()
