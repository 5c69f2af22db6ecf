"""What the query process computes: answers, scores, masks, maps and renders, over open scenes."""

from __future__ import annotations

import io
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from liftcore.artifact import load_lift
from liftcore.query.ask import Answer, Look, ask, look, top
from liftcore.query.encoders import TextEncoder, open_encoder
from liftcore.query.pictures import attention_png, mask_png, render_png
from liftcore.query.scene import QueryScene
from service.queries.frames import Frame

T = TypeVar("T")


class Kept(Generic[T]):
    """The few values used last."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: OrderedDict[object, T] = OrderedDict()

    def get(self, key: object, make: Callable[[], T]) -> T:
        """The value of a key, made when it is not here."""
        if key not in self._values:
            while len(self._values) >= self._size:  # first, so that the old and the new need no room together
                self._values.popitem(last=False)
            self._values[key] = make()
        self._values.move_to_end(key)
        return self._values[key]


class Answers:
    """Replies to requests; a lift is known by its path, a text encoder by its specification."""

    def __init__(self, *, scenes: int, answers: int) -> None:
        self._scenes: Kept[QueryScene] = Kept(scenes)
        self._answers: Kept[Answer] = Kept(answers)
        self._encoders: dict[str, TextEncoder] = {}
        self._operations: dict[str, Callable[[dict[str, Any]], Frame]] = {
            "query": self._query,
            "scores": self._scores,
            "mask": self._mask,
            "attention": self._attention,
            "render": self._render,
        }

    def reply(self, request: dict[str, Any]) -> Frame:
        """The reply to one request; ``operation`` says which.

        Raises:
            SplatliftError: what was asked cannot be answered.
        """
        return self._operations[request["operation"]](request)

    def _scene(self, request: dict[str, Any]) -> QueryScene:
        return self._scenes.get(request["lift"], lambda: open_scene(request))

    def _encoder(self, spec: str) -> TextEncoder:
        if spec not in self._encoders:
            self._encoders[spec] = open_encoder(spec)
        return self._encoders[spec]

    def _answer(self, request: dict[str, Any]) -> Answer:
        negatives = tuple(request["negatives"])
        key = (request["lift"], request["encoder"], request["text"], negatives, request["threshold"])
        scene = self._scene(request)
        encoder = self._encoder(request["encoder"])
        return self._answers.get(
            key,
            lambda: ask(scene, request["text"], encoder, negatives=negatives, threshold=request["threshold"]),
        )

    def _look(self, request: dict[str, Any]) -> Look:
        return look(self._scene(request), self._answer(request), request["view"])

    def _query(self, request: dict[str, Any]) -> Frame:
        scene, answer = self._scene(request), self._answer(request)
        if request["view"] is not None:
            scene.cameras.get(request["view"])  # links to pictures of a view that is not there help nobody
        return Frame(describe(scene, answer, request["top"]))

    def _scores(self, request: dict[str, Any]) -> Frame:
        file = io.BytesIO()
        np.save(file, self._answer(request).scores.to(torch.float32).numpy())
        return Frame({}, file.getvalue())

    def _mask(self, request: dict[str, Any]) -> Frame:
        return Frame({}, mask_png(self._look(request)))

    def _attention(self, request: dict[str, Any]) -> Frame:
        return Frame({}, attention_png(self._look(request)))

    def _render(self, request: dict[str, Any]) -> Frame:
        return Frame({}, render_png(self._scene(request), request["view"]))


def open_scene(request: dict[str, Any]) -> QueryScene:
    """The lift, with its splats and cameras where the store has them now: data directories may move."""
    path = Path(request["lift"])
    lift = load_lift(path)
    moved = {
        name: getattr(lift.metadata, name).model_copy(update={"path": request[name]})
        for name in ("splats", "cameras")
    }
    return QueryScene(replace(lift, metadata=lift.metadata.model_copy(update=moved)), path)


def describe(scene: QueryScene, answer: Answer, count: int) -> dict[str, Any]:
    """The answer in numbers, as JSON takes them; ``count`` of the best splats."""
    found = top(answer, scene, count)
    return {
        "statistics": {name: _finite(value) for name, value in answer.statistics.items()},
        "threshold": {
            "value": _finite(answer.threshold),
            "method": answer.threshold_method,
            "explanation": answer.explanation,
        },
        "count": answer.count,
        "top": [asdict(splat) for splat in found.best],
        "box": None if found.box is None else {"low": found.box[0], "high": found.box[1]},
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
