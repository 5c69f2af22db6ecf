"""The one renderer of a public registry that ran here on a CPU: the torch reference of ``metal-gauss``, by autograd.

It is no dependency: ``pip install --no-deps metal-gauss==0.2.1`` makes this peer appear. It renders three channels a
call, so the F channels and the count take (F + 1) / 3 renders a view, each with its own projection and lists: the
package has no other way. Its walk differs a little from the one that the others share: alphas are capped at 0.999, a
ray has no stop of its own, and a splat is listed for tiles within three sigma.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import torch

from tests.benchmarks.peers.work import Answer, Work, answer_of, dense_target, torch_threads

if TYPE_CHECKING:
    from torch import Tensor

PACKAGE, VERSION = "metal-gauss", "0.2.1"  # that was tried
CHANNELS = 3  # a call


class MetalGauss:
    """See ``tests.benchmarks.peers.peer.Peer``."""

    name = "metal-gauss"
    computes = "the same gradient through the package's own torch renderer, three channels a render"

    def missing(self) -> str:
        """The package, unless it is installed."""
        try:
            version(PACKAGE)
        except PackageNotFoundError:
            return f"it is not installed (`pip install --no-deps {PACKAGE}=={VERSION}`)"
        return ""

    def lift(self, work: Work) -> Answer:
        """View by view, three channels by three."""
        render = import_module("metal_gauss.torch_ref").render
        splats = work.splats
        scene = splats.means, splats.quats, splats.log_scales.exp(), torch.sigmoid(splats.opacity_logits)
        sums = torch.zeros(splats.count, work.channels + 1)
        with torch_threads(work.threads):
            for camera, regions in work.views:
                target = dense_target(camera, regions)
                intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
                pose = torch.tensor(camera.viewmat, dtype=torch.float32)
                view = intrinsics, pose, camera.width, camera.height
                for first in range(0, target.shape[2], CHANNELS):
                    part = target[:, :, first : first + CHANNELS]
                    sums[:, first : first + CHANNELS] += _gradient(render, scene, view, part)
        return answer_of(sums)


def _gradient(render: Any, scene: tuple[Tensor, ...], view: tuple[Any, ...], part: Tensor) -> Tensor:
    """``A^T`` of up to three channels [H, W, c] f32 of a view, [P, c] f32."""
    wanted = part.shape[2]
    x = torch.zeros(len(scene[0]), CHANNELS, requires_grad=True)
    image = render(*scene, None, *view, tile=16, background=None, colors=x, max_radius_frac=torch.inf)[0]
    (gradient,) = torch.autograd.grad(image[:, :, :wanted], x, grad_outputs=part)
    return gradient[:, :wanted]
