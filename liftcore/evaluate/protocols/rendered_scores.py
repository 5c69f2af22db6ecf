"""P3, the protocol of LaGa and of Splat Feature Solver: splats are scored in 3D, and scores are rendered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.evaluate.protocols import Prediction
from liftcore.query.ask import ask
from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.query import Query
from liftcore.query.threshold import find_threshold

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene


class RenderedScores:
    """P3 on one lift (``Segmenter``), for all texts in one rendering; each map has a threshold of its own."""

    def __init__(
        self,
        scene: QueryScene,
        texts: Sequence[str],
        encoder: TextEncoder,
        threshold: str | float = "auto",
        negatives: Sequence[str] = (),
    ) -> None:
        self._scene = scene
        self._texts = tuple(texts)
        self._threshold = threshold
        columns = []
        for text in texts:
            answer = ask(scene, Query((text,), tuple(negatives), threshold), encoder)
            # A splat without a feature adds nothing to a ray.
            columns.append(torch.where(answer.seen, answer.scores, 0.0))
        self._values = torch.stack([*columns, torch.ones(scene.lift.features.shape[0])], dim=1)  # [P, n + 1]

    def look(self, view: str) -> dict[str, Prediction]:
        """What each text finds in a view."""
        scene = self._scene
        image = scene.image(view, lambda camera: scene.raster.render(camera, self._values, scene.walk))
        met = image[..., -1] >= MINIMUM_ROW_SUM
        found = {}
        for k, text in enumerate(self._texts):
            attention = image[..., k].contiguous()
            threshold = find_threshold(attention[met], self._threshold)
            row, column = np.unravel_index(int(attention.argmax()), attention.shape)
            found[text] = Prediction((met & (attention >= threshold.value)).numpy(), (int(column), int(row)))
        return found
