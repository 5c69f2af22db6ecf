"""How good a run's features are: against the exact ones, the held-out views, and masks when there are some."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.evaluate.accuracy import class_ious, rendered_scores, view_cosines
from liftcore.io.class_masks import read_masks
from liftcore.query.encoders.table import TableEncoder
from liftcore.query.in_photo import in_photo
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.views import cameras_of_views

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.evaluate.tradeoff.order import Order, Scene
    from liftcore.io.lift_file import LiftResult
    from liftcore.lift import Sources
    from liftcore.scene.cameras import Cameras

LOW_QUANTILE = 0.05
ROWS = 1 << 16  # compared at a time


def judge(order: Order, sources: Sources, reference: tuple[Tensor, Tensor], made: LiftResult) -> dict[str, Any]:
    """The figures of accuracy; None where there is nothing to compare with.

    Args:
        reference: features [P, F] and evidence [P] of the exact run, empty before it.
    """
    figures = cosine_figures(made.features, *reference)
    raster, walk = CpuRaster(sources.splats, order.threads), made.metadata.settings.render_params
    rows = [
        view_cosines(raster, sources.cameras[view], sources.packs[view], made.features, walk)
        for view in order.held_out
    ]
    cosines = np.concatenate(rows) if rows else np.zeros(0)
    figures["held_out_cosine"] = float(cosines.mean()) if cosines.size else None
    figures["mask_iou"] = None
    if order.scene.labels is not None and order.labelled:
        classes = class_vectors(order.scene)
        masks = labelled_masks(order.scene, sources.cameras)
        found = []
        for view in order.labelled:
            scores = in_photo(
                sources.cameras[view],
                lambda camera: rendered_scores(raster, camera, made.features, classes, walk),
            )
            found.append(_resized(scores.argmax(dim=2), masks[view]))
        truth = [masks[view].flatten() for view in order.labelled]
        ious = class_ious(torch.cat(found), torch.cat(truth), len(classes))
        mean = float(ious.nanmean())
        figures["mask_iou"] = None if math.isnan(mean) else mean  # masks that name no class
    return figures


def cosine_figures(features: Tensor, exact: Tensor, evidence: Tensor) -> dict[str, float | None]:
    """How near the features [P, F] are to the exact ones, over the splats that the exact run saw.

    The mean weighted by evidence, the plain mean, and the quantile below which LOW_QUANTILE of the splats lie. A
    splat that this run did not see counts zero. None where the exact run saw nothing.
    """
    nothing: dict[str, float | None] = {"cosine": None, "cosine_plain": None, "cosine_q05": None}
    if not exact.shape[0]:
        return nothing
    parts, seen = [], []
    for first in range(0, exact.shape[0], ROWS):
        one, other = features[first : first + ROWS].float(), exact[first : first + ROWS].float()
        parts.append(torch.nn.functional.cosine_similarity(one, other, dim=1).double())
        seen.append((other != 0).any(dim=1))
    chosen = torch.cat(seen)
    cosines, weights = torch.cat(parts)[chosen], evidence[chosen].double()
    if not float(weights.sum()) > 0:
        return nothing
    return {
        "cosine": float((cosines * weights).sum() / weights.sum()),
        "cosine_plain": float(cosines.mean()),
        "cosine_q05": float(np.quantile(cosines.numpy(), LOW_QUANTILE)),
    }


def class_vectors(scene: Scene) -> Tensor:
    """The unit vectors [K, F] of the classes' words."""
    if scene.table is None:
        raise ValueError("labels come with a table of their words")
    return torch.as_tensor(TableEncoder.open(scene.table).encode(scene.classes))


def labelled_masks(scene: Scene, cameras: Cameras) -> dict[str, Tensor]:
    """Camera -> its [h, w] i64 of class numbers, as `liftcore.io.class_masks.read_masks` has it."""
    if scene.labels is None:
        raise ValueError("there are no labels")
    masks = read_masks(scene.labels, len(scene.classes))
    return {camera: masks[view] for view, camera in cameras_of_views(masks, cameras).items()}


def _resized(labels: Tensor, mask: Tensor) -> Tensor:
    """The labels [H, W] at the centres of the mask's pixels, flat."""
    rows = ((2 * torch.arange(mask.shape[0]) + 1) * labels.shape[0]) // (2 * mask.shape[0])
    columns = ((2 * torch.arange(mask.shape[1]) + 1) * labels.shape[1]) // (2 * mask.shape[1])
    return labels[rows][:, columns].flatten()
