"""Protocols of open-vocabulary segmentation: three of the field, whose numbers cannot be compared, and our own.

- P1 (LangSplat): features are rendered, a relevancy map is made in 2D and cut at 0.4. Localised when its peak lies in
  a box of the object.
- P2 (OpenGaussian): splats are selected in 3D and their silhouette is rendered alone. Localised at an IoU of at least
  0.25 (and 0.5).
- P3 (LaGa, Splat Feature Solver): splats are scored in 3D, scores are rendered and cut in 2D. Localised when the peak
  of the map lies in the object's mask.
- own: splats are selected in 3D, and a mask is where they are at least half of a ray, as a query makes it.
  Localised as P2 is.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor

from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.ask import ask
from liftcore.query.objects import Objects, objects
from liftcore.query.opened import OpenedLift
from liftcore.query.question import Answer, Query
from liftcore.query.render import view_mask
from liftcore.query.scene import Scene
from liftcore.query.scores import DEFAULT_NEGATIVES, relevancy
from liftcore.query.threshold import find_threshold
from liftcore.raster import open_raster
from liftcore.runtime.device import CPU
from liftcore.scene.cameras import Camera
from liftcore.text import TextEncoder

MEAN_FILTER = 30  # pixels
CUT = 0.4  # of the map stretched to -1..1
MAJORITY = 7  # pixels of the square that votes on a mask's pixel
SOLID = 0.7  # of a ray: from here on the selected splats alone make a silhouette
CHANNELS = 32  # rendered at a time


class EvaluationProtocol(StrEnum):
    """The protocol of a measurement."""

    P1 = "P1"
    P2 = "P2"
    P3 = "P3"
    OBJECTS = "own"


@dataclass(frozen=True)
class Prediction:
    """A protocol's prediction for a text in a view."""

    mask: np.ndarray  # [H, W] bool
    peak: tuple[int, int] | None  # x y of the highest value; None where the protocol has no such pixel


class Segmenter(ABC):
    """One protocol on one lift, for fixed texts.

    Args:
        threshold: a method or a number; P1 has its own.
        negatives: of each query; of P1 in place of LangSplat's four.
    """

    def __init__(
        self,
        scene: Scene,
        texts: Sequence[str],
        encoder: TextEncoder,
        threshold: str | float = "auto",
        negatives: Sequence[str] = (),
    ) -> None:
        self.scene, self.texts, self.encoder = scene, tuple(texts), encoder
        self.threshold, self.negatives = threshold, tuple(negatives)

    @abstractmethod
    def predict_view(self, view: str) -> dict[str, Prediction]:
        """Predict the mask of each text in a view."""

    def answers(self) -> dict[str, Answer]:
        """Query the splats for each text."""
        return {
            text: ask(self.scene, Query.of(text, self.negatives, threshold=self.threshold), self.encoder)
            for text in self.texts
        }


class RenderedFeatures(Segmenter):
    """P1: features are rendered, and the image is queried.

    A pixel's feature is ``sum_j A_ij x_j``, made a unit vector; its relevancy for a text is the least softmax
    against the negatives, sharpened tenfold.
    """

    @cached_property
    def _products(self) -> Tensor:
        """[P, n + N], the products of splats and words, for all views."""
        vectors = torch.as_tensor(self.encoder.encode([*self.texts, *(self.negatives or DEFAULT_NEGATIVES)]))
        # <A X, t> = A (X t): the products with the texts are rendered, not the features again for each.
        blocks = [block.float() @ vectors.T for block in self.scene.lift.features.split(65_536)]
        return torch.cat(blocks)

    def predict_view(self, view: str) -> dict[str, Prediction]:
        """Predict the mask of each text in a view."""
        cosines = self.cosines(view)
        shape, count, flat = cosines.shape[:2], len(self.texts), cosines.flatten(0, 1).numpy()
        predictions = {}
        for k, text in enumerate(self.texts):
            against = np.concatenate([flat[:, k : k + 1], flat[:, count:]], axis=1)
            predictions[text] = segment(relevancy(against, 1).reshape(shape))
        return predictions

    def cosines(self, view: str) -> Tensor:
        """Render the cosines [H, W, n + N] f32 of features to the texts and the negatives; 0 where nothing is hit."""
        return self.scene.image(view, self._cosines)

    def _cosines(self, camera: Camera) -> Tensor:
        scene = self.scene
        products = scene.raster.render(camera, self._products, scene.compositing)
        squares = torch.zeros(products.shape[:2], dtype=torch.float32)
        for part in scene.lift.features.split(CHANNELS, dim=1):
            squares += scene.raster.render(camera, part.float().contiguous(), scene.compositing).square().sum(dim=-1)
        lengths = squares.sqrt()[..., None]
        return torch.where(lengths > 0, products / lengths, 0.0).clamp(-1, 1)


def segment(relevance: np.ndarray) -> Prediction:
    """Segment a relevancy map [H, W] f32 as LangSplat does, and find its peak.

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
    """Return [H, W] bool: True if more than half of the square's pixels in the image are set."""
    share = uniform_filter(mask.astype(np.float64), MAJORITY, mode="constant")
    inside = uniform_filter(np.ones(mask.shape), MAJORITY, mode="constant")
    return share > 0.5 * inside + 1e-9


class SelectedSplats(Segmenter):
    """P2: splats are selected in 3D, and rendered without the others, so that nothing occludes them."""

    @cached_property
    def _selected(self) -> dict[str, np.ndarray]:
        """The splats that each text selects, for all views."""
        return {text: answer.selected for text, answer in self.answers().items()}

    def predict_view(self, view: str) -> dict[str, Prediction]:
        """Predict the mask of each text in a view."""
        splats, predictions = self.scene.splats, {}
        for text, selected in self._selected.items():
            logits = torch.where(torch.from_numpy(selected), splats.opacity_logits, -1e4)  # an opacity of zero
            raster = open_raster(replace(splats, opacity_logits=logits), CPU)
            sums = self.scene.image(
                view, lambda camera, raster=raster: raster.row_sums(camera, self.scene.compositing)
            )
            predictions[text] = Prediction((sums > SOLID).numpy(), None)
        return predictions


class RenderedScores(Segmenter):
    """P3: splats are scored in 3D, and scores are rendered; each map has a threshold of its own."""

    @cached_property
    def _values(self) -> Tensor:
        """[P, n + 1], the scores of the splats and ones, for all views."""
        # A splat without a feature adds nothing to a ray.
        columns = [np.where(answer.has_feature, answer.scores, np.float32(0.0)) for answer in self.answers().values()]
        columns.append(np.ones(len(self.scene.features), np.float32))
        return torch.from_numpy(np.stack(columns, axis=1))

    def predict_view(self, view: str) -> dict[str, Prediction]:
        """Predict the mask of each text in a view."""
        scene, predictions = self.scene, {}
        image = scene.image(view, lambda camera: scene.raster.render(camera, self._values, scene.compositing))
        hit = image[..., -1] >= MINIMUM_ROW_SUM
        for k, text in enumerate(self.texts):
            attention = image[..., k].contiguous()
            threshold = find_threshold(attention[hit], self.threshold)
            row, column = np.unravel_index(int(attention.argmax()), attention.shape)
            predictions[text] = Prediction((hit & (attention >= threshold.value)).numpy(), (int(column), int(row)))
        return predictions


class OwnMasks(Segmenter):
    """Our own protocol: the masks of ``splatlift query --mask``, of the answer's objects."""

    @cached_property
    def _answers(self) -> dict[str, Answer]:
        """The answers of the splats, for all views."""
        return self.answers()

    @cached_property
    def _objects(self) -> dict[str, Objects]:
        """The objects of each text, computed on first use."""
        return {}

    def predict_view(self, view: str) -> dict[str, Prediction]:
        """Predict the mask of each text in a view."""
        return {text: self._predict_view(text, view) for text in self._answers}

    def _predict_view(self, text: str, view: str) -> Prediction:
        def group(scene: OpenedLift, answer: Answer) -> Objects:
            if text not in self._objects:
                self._objects[text] = objects(scene, answer)
            return self._objects[text]

        return Prediction(view_mask(self.scene, self._answers[text], view, group).mask, None)


SEGMENTERS: dict[EvaluationProtocol, type[Segmenter]] = {
    EvaluationProtocol.P1: RenderedFeatures,
    EvaluationProtocol.P2: SelectedSplats,
    EvaluationProtocol.P3: RenderedScores,
    EvaluationProtocol.OBJECTS: OwnMasks,
}
