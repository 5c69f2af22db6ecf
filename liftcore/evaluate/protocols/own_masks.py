"""Our own way: the masks that ``splatlift query --mask`` makes, of the objects that were found."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.evaluate.protocols import Prediction
from liftcore.query.ask import Answer, ask
from liftcore.query.objects import Objects, objects
from liftcore.query.query import Query
from liftcore.query.view_mask import view_mask

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene


class OwnMasks:
    """The masks of a query on one lift (``Segmenter``)."""

    def __init__(
        self,
        scene: QueryScene,
        texts: Sequence[str],
        encoder: TextEncoder,
        threshold: str | float = "auto",
        negatives: Sequence[str] = (),
    ) -> None:
        self._scene = scene
        self._answers = {text: ask(scene, Query((text,), tuple(negatives), threshold), encoder) for text in texts}
        self._objects: dict[str, Objects] = {}

    def look(self, view: str) -> dict[str, Prediction]:
        """What each text finds in a view."""
        return {text: self._look(text, view) for text in self._answers}

    def _look(self, text: str, view: str) -> Prediction:
        def group(scene: QueryScene, answer: Answer) -> Objects:
            if text not in self._objects:
                self._objects[text] = objects(scene, answer)
            return self._objects[text]

        return Prediction(view_mask(self._scene, self._answers[text], view, group).mask.numpy(), None)
