"""P1, LangSplat's protocol: features are rendered, and words are asked of the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.ndimage import uniform_filter

from liftcore.evaluate.protocols import Prediction
from liftcore.query.scores import DEFAULT_NEGATIVES, relevancy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene
    from liftcore.scene.cameras import Camera

MEAN_FILTER = 30  # pixels
CUT = 0.4  # of the map stretched to -1..1
MAJORITY = 7  # pixels of the square that votes on a mask's pixel
_SLICE = 32  # channels rendered at a time
_ROWS = 65_536  # splats compared at a time


class RenderedFeatures:
    """P1 on one lift (``Segmenter``).

    A pixel's feature is ``sum_j A_ij x_j``, made a unit vector; its relevancy for a text is the least softmax
    against the negatives, sharpened tenfold.
    """

    def __init__(
        self,
        scene: QueryScene,
        texts: Sequence[str],
        encoder: TextEncoder,
        negatives: Sequence[str] = DEFAULT_NEGATIVES,
    ) -> None:
        self._scene = scene
        self._texts = tuple(texts)
        vectors = encoder.encode([*texts, *negatives])
        features = scene.lift.features
        # <A X, t> = A (X t): the products with the texts are rendered, not the features again for each.
        blocks = [features[start : start + _ROWS].float() @ vectors.T for start in range(0, len(features), _ROWS)]
        self._products = torch.cat(blocks)  # [P, n + N]

    def look(self, view: str) -> dict[str, Prediction]:
        """What each text finds in a view."""
        cosines = self.cosines(view)
        shape, count = cosines.shape[:2], len(self._texts)
        flat = cosines.flatten(0, 1)
        found = {}
        for k, text in enumerate(self._texts):
            against = torch.cat([flat[:, k : k + 1], flat[:, count:]], dim=1)
            found[text] = segment(relevancy(against, 1).reshape(shape).numpy())
        return found

    def cosines(self, view: str) -> Tensor:
        """[H, W, n + N] f32, of the rendered features to the texts and the negatives; 0 where nothing is seen."""
        return self._scene.image(view, self._cosines)

    def _cosines(self, camera: Camera) -> Tensor:
        scene, features = self._scene, self._scene.lift.features
        products = scene.raster.render(camera, self._products, scene.walk)
        squares = torch.zeros(products.shape[:2])
        for start in range(0, features.shape[1], _SLICE):
            part = features[:, start : start + _SLICE].to(torch.float32).contiguous()
            squares += scene.raster.render(camera, part, scene.walk).square().sum(dim=-1)
        lengths = squares.sqrt()[..., None]
        return torch.where(lengths > 0, products / lengths, 0.0).clamp(-1, 1)


def segment(relevance: np.ndarray) -> Prediction:
    """LangSplat's mask and peak of a relevancy map [H, W] f32.

    The map is averaged over 30 x 30 pixels; half of that and half of the map itself is stretched to -1..1 and cut
    at 0.4; each pixel then takes the majority of the 7 x 7 around it. The peak is the averaged map's.
    """
    smooth = uniform_filter(relevance.astype(np.float64), MEAN_FILTER, mode="mirror")
    blend = 0.5 * (smooth + relevance)
    low, high = blend.min(), blend.max()
    stretched = 2 * (blend - low) / (high - low + 1e-9) - 1
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return Prediction(_majority(stretched.clip(0, 1) > CUT), (int(column), int(row)))


def _majority(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool, whether more than half of the square's pixels that lie in the image are set."""
    share = uniform_filter(mask.astype(np.float64), MAJORITY, mode="constant")
    inside = uniform_filter(np.ones(mask.shape), MAJORITY, mode="constant")
    return share > 0.5 * inside + 1e-9
