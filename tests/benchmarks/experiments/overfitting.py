"""Least squares believes wrong masks: the residual falls while the splats get worse, unless it is damped.

From the row-sum lift of the tabletop scene with its hard masks, conjugate gradients go towards the smallest
``|A X - B|^2`` with several dampings. All runs in the channels ``X C^T``, C the class vectors: closed form and least
squares are linear in B, so these are exactly the class scores of the full solutions, at the cost of 14 channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.evaluate.accuracy import splat_accuracy
from liftcore.features.pack import open_packs
from liftcore.features.views import Regions, ViewFeatures
from liftcore.raster.base import CompositingParams
from liftcore.solve.all_rays import AllRays
from liftcore.solve.channels import Channels
from liftcore.solve.least_squares import solve_block
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure
    from torch import Tensor

    from tests.benchmarks.experiments.subject import Subject

TITLE = "Least squares under wrong masks"
SOURCE = "the closed form against the smallest |A X - B|^2 (paper, Sec. 3.2), several dampings"
PACK = "features_hard"
DAMPINGS = (0.0, 0.1, 0.3, 1.0)
STEPS = 20
COLUMNS = ("damping", "steps", "residual", "accuracy", "cosine", "miou")
_SMALL = 1e-12


@dataclass(frozen=True)
class Truth:
    """What the splats really are."""

    classes: Tensor  # [K, F] f32, unit vectors
    objects: Tensor  # [P] int, the class of every splat
    counted: Tensor  # [P] bool, the splats that count

    def judge(self, scores: Tensor) -> dict[str, float]:
        """Accuracy of the scores [P, K], and their mean cosine to the true ones, centred on the classes' mean."""
        true = (self.classes @ self.classes.T)[self.objects.long()]
        left, right = (part - part.mean(dim=1, keepdim=True) for part in (scores, true))
        cosines = torch.nn.functional.cosine_similarity(left, right, dim=1, eps=_SMALL)
        return {
            "accuracy": splat_accuracy(scores, self.objects, self.counted),
            "cosine": float(cosines[self.counted].mean()),
        }


def scored(observation: ViewFeatures, classes: Tensor) -> Regions:
    """A region map whose codebook [M, K] holds the scores of the classes [K, F]."""
    assert isinstance(observation, Regions)
    return Regions(observation.labels, observation.codebook.float() @ classes.T)


def closed_form(rays: AllRays, channels: int) -> Tensor:
    """``D^-1 A^T B`` [P, C] f32 in all channels of the observations."""
    part = Channels(0, channels, None)
    sums, _ = rays.gradient(np.zeros((rays.count, channels), np.float32), part.project)
    scale = np.divide(1.0, rays.row_sums, out=np.zeros(rays.count), where=rays.row_sums > 0)
    return torch.from_numpy(sums * scale.astype(np.float32)[:, None])


def follow(rays: AllRays, first: Tensor, truth: Truth, damping: float, steps: int) -> tuple[dict[str, Any], Tensor]:
    """Residual, accuracy and cosine after every step from ``first`` [P, K] on, and the last scores [P, K]."""
    judged = [truth.judge(first)]

    def watch(step: int, solution: np.ndarray, rest: np.ndarray) -> None:
        judged.append(truth.judge(first + torch.from_numpy(solution)))

    part = Channels(0, first.shape[1], None)
    block = solve_block(rays, part, first, rays.row_sums > 0, (damping, steps), watch)
    path = {
        "damping": damping,
        "residual": [loss / max(rays.rows, 1) for loss in block.losses],
        "accuracy": [point["accuracy"] for point in judged],
        "cosine": [point["cosine"] for point in judged],
    }
    return path, first + torch.from_numpy(block.step)


def measure(subject: Subject) -> dict[str, Any]:
    """The paths of all dampings on the tabletop scene, and held-out mIoU at their ends."""
    scene = Tabletop(subject.folder)
    packs = open_packs([subject.folder / f"{PACK}.safetensors"])
    names = packs.views[:: subject.every]
    views = [scene.cameras[name] for name in names]
    rays = AllRays(
        scene.raster,
        scene.raster.splats.count,
        views,
        lambda view: scored(packs.observation(names[view]), scene.classes),
        CompositingParams(),
    )
    truth = Truth(scene.classes, scene.objects, scene.counted & torch.from_numpy(rays.row_sums > 0))
    first = closed_form(rays, len(scene.classes))
    paths, rows = [], []
    for damping in DAMPINGS:
        path, last = follow(rays, first, truth, damping, STEPS)
        paths.append(path)
        ends = {name: path[name][-1] for name in ("residual", "accuracy", "cosine")}
        rows.append({"damping": damping, "steps": len(path["residual"]) - 1, **ends, "miou": _miou(scene, last)})
    start = {name: paths[0][name][0] for name in ("residual", "accuracy", "cosine")}
    rows.insert(0, {"damping": None, "steps": 0, **start, "miou": _miou(scene, first)})
    note = f"{len(names)} views of {PACK}, {int(truth.counted.sum())} splats; residual in the class scores, a row"
    return {"columns": COLUMNS, "rows": rows, "paths": paths, "note": note}


def _miou(scene: Tabletop, scores: Tensor) -> float:
    """Mean IoU of the rendered scores' argmax in the held-out views."""
    return scene.miou(
        scene.raster.render(scene.cameras[view], scores, CompositingParams()) for view in scene.held_out
    )


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Residual and accuracy against the step, a line a damping."""
    panels = figure.subplots(1, 2)
    labels = {"residual": "residual |A x - b|² a row", "accuracy": "splat accuracy"}
    for axes, (name, label) in zip(panels, labels.items(), strict=True):
        for path in document["paths"]:
            axes.plot(path[name], label=f"{path['damping']:g}")
        axes.set_xlabel("CG step")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(title="damping")
    figure.suptitle(document["title"])
