"""P2, OpenGaussian's protocol: splats are selected in 3D, and their silhouette is seen alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from liftcore.evaluate.protocols import Prediction
from liftcore.query.ask import ask
from liftcore.query.query import Query

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene

SOLID = 0.7  # of a ray: from here on the selected splats alone make a silhouette
_GONE = -1e4  # an opacity logit of nothing


class SelectedSplats:
    """P2 on one lift (``Segmenter``). What stood before the selected splats is gone, so it hides nothing."""

    def __init__(
        self,
        scene: QueryScene,
        texts: Sequence[str],
        encoder: TextEncoder,
        threshold: str | float = "auto",
        negatives: Sequence[str] = (),
    ) -> None:
        self._scene = scene
        self._selected = {
            text: ask(scene, Query((text,), tuple(negatives), threshold), encoder).selected for text in texts
        }

    def look(self, view: str) -> dict[str, Prediction]:
        """What each text finds in a view."""
        return {
            text: Prediction((self.silhouette(view, selected) > SOLID).numpy(), None)
            for text, selected in self._selected.items()
        }

    def silhouette(self, view: str, selected: Tensor) -> Tensor:
        """[H, W] f32, ``A 1`` of a scene of the selected splats [P] bool alone."""
        from liftcore.raster.cpu.raster import CpuRaster

        splats = self._scene.splats
        logits = torch.where(selected, splats.opacity_logits, _GONE)
        alone = CpuRaster(replace(splats, opacity_logits=logits))
        return self._scene.image(view, lambda camera: alone.row_sums(camera, self._scene.walk))
