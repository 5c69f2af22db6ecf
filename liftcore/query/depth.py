"""How far a scene is from a camera, ray by ray, and as a grey picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.base import CompositingParams

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.query.scene import QueryScene

_SHOWN = (0.01, 0.99)  # quantiles of the covered pixels' depths: a floater before the lens dims no picture
_LEVELS = 254  # between the farthest covered pixel, at 1, and the nearest, at 255; 0 is for what no splat covers


@dataclass(frozen=True)
class ShownDepth:
    """Depths as a grey picture: a level of 1 is ``far`` or farther, 255 ``near`` or nearer, and 0 no depth."""

    levels: np.ndarray  # [H, W] u8
    span: tuple[float, float] | None  # near and far, scene units; None when no pixel is covered

    def text(self) -> dict[str, str]:
        """What a PNG of it says of itself: ``depth-near`` and ``depth-far``, in decimals that read back exactly."""
        return {} if self.span is None else dict(zip(("depth-near", "depth-far"), map(repr, self.span), strict=True))


def expected_depth(scene: QueryScene, view: str) -> tuple[Tensor, Tensor]:
    """The expected depth of the rays of a view, ``sum_j w_j z_j / sum_j w_j``.

    z_j is the depth of a splat's centre along the camera's axis, not along the ray. Opacities are as trained.

    Args:
        scene: an opened lift.
        view: the name of a camera.

    Returns:
        Depths [H, W] f32 in scene units, 0 where no splat covers the pixel; and where one does, [H, W] bool.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: its image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    pose = torch.from_numpy(scene.cameras[view].viewmat[2].copy())
    depths = (scene.splats.means.double() @ pose[:3] + pose[3]).to(torch.float32)
    values = torch.stack([depths, torch.ones_like(depths)], dim=1)
    walk = CompositingParams(antialiased=scene.walk.antialiased)
    image = scene.image(view, lambda camera: scene.raster.render(camera, values, walk))
    covered = image[..., 1] > 0
    return torch.where(covered, image[..., 0] / image[..., 1], 0.0), covered


def shown_depth(scene: QueryScene, view: str) -> ShownDepth:
    """The expected depths of a view, near bright, from the 1st to the 99th percentile of the covered pixels.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: its image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    depths, covered = (tensor.numpy() for tensor in expected_depth(scene, view))
    levels = np.zeros(depths.shape, dtype=np.uint8)
    if not covered.any():
        return ShownDepth(levels, None)
    near, far = (float(depth) for depth in np.quantile(depths[covered], _SHOWN))
    nearness = (far - depths[covered]) / (far - near) if far > near else np.ones(int(covered.sum()))
    levels[covered] = 1 + np.round(_LEVELS * nearness.clip(0.0, 1.0))
    return ShownDepth(levels, (near, far))
