"""What the query process computes: answers, scores, masks, maps and renders, over open scenes."""

from __future__ import annotations

import contextlib
import io
import json
import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from liftcore.artifact import load_lift
from liftcore.errors import SplatliftError
from liftcore.query.ask import Answer, Look, ask, look, top
from liftcore.query.encoders import TextEncoder, open_encoder
from liftcore.query.encoders.remembering import RememberingEncoder
from liftcore.query.example import Example, Vector, parse_example
from liftcore.query.pictures import attention_png, mask_png, render_png
from liftcore.query.products import cosines_of, norms_of
from liftcore.query.query import Query
from liftcore.query.scene import QueryScene
from liftcore.raster.warm_up import warm_up
from service.queries.frames import Frame

T = TypeVar("T")
LOOKS = 4  # views kept: the mask and the map of an answer are two readings of one render
WARM_UP_TEXT = "something"


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
        self._looks: Kept[Look] = Kept(LOOKS)
        self._encoders: dict[str, tuple[object, TextEncoder]] = {}  # spec -> version of its file, encoder
        self._opening = threading.RLock()  # of encoders, which the warm-up opens too
        self._operations: dict[str, Callable[[dict[str, Any]], Frame]] = {
            "query": self._query,
            "scores": self._scores,
            "mask": self._mask,
            "attention": self._attention,
            "render": self._render,
        }

    def warm_up(self, encoder: str, version: object) -> None:
        """Load what the first query would wait for: an encoder, and the compiled kernels.

        An encoder that does not open is told to whoever asks for it.
        """
        with contextlib.suppress(SplatliftError), self._opening:
            self._encoder(encoder, version).encode([WARM_UP_TEXT])
        for dtype in (torch.float16, torch.float32):
            row = torch.ones(1, 1, dtype=dtype)
            cosines_of(row, norms_of(row), row.to(torch.float32))
        warm_up()

    def reply(self, request: dict[str, Any]) -> Frame:
        """The reply to one request; ``operation`` says which.

        Raises:
            SplatliftError: what was asked cannot be answered.
        """
        return self._operations[request["operation"]](request)

    def _scene(self, request: dict[str, Any]) -> QueryScene:
        scene = self._scenes.get(request["lift"], lambda: open_scene(request))
        if "features" in request:
            scene.find_packs([Path(path) for path in request["features"]])
        return scene

    def _encoder(self, spec: str, version: object) -> TextEncoder:
        with self._opening:
            known = self._encoders.get(spec)
            if known is None or known[0] != version:  # a table that the operator replaced is another table
                known = self._encoders[spec] = (version, RememberingEncoder(open_encoder(spec)))
            return known[1]

    def _answer(self, request: dict[str, Any]) -> Answer:
        def make() -> Answer:
            spec = request["encoder"]
            encoder = None if spec is None else self._encoder(spec, request["encoder_version"])
            return ask(self._scene(request), query_of(request["query"]), encoder)

        return self._answers.get(_question(request), make)

    def _look(self, request: dict[str, Any]) -> Look:
        answer, view = self._answer(request), request["view"]
        return self._looks.get((_question(request), view), lambda: look(self._scene(request), answer, view))

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
        return Frame({}, render_png(self._scene(request), request["view"], request["what"]))


def use_one_library_thread() -> None:
    """Let the libraries compute in the calling thread.

    A query is a row of small operations, each of which would wait for a team of threads to meet; beside a lift that
    keeps the cores busy they meet late. The kernels bring threads of their own.
    """
    torch.set_num_threads(1)


def _question(request: dict[str, Any]) -> tuple[object, ...]:
    names = ("lift", "encoder", "encoder_version", "query")
    return tuple(json.dumps(request[name]) for name in names)


def query_of(asked: dict[str, Any]) -> Query:
    """The query of a request.

    Raises:
        InvalidQuery: it asks for nothing, or an example has no known notation.
    """
    like, unlike = ([_example(example, name) for example in asked[name]] for name in ("like", "unlike"))
    return Query(
        positives=(*asked["text"], *like),
        negatives=(*asked["negatives"], *unlike),
        threshold=asked["threshold"],
        instances=asked["instances"],
        keep=asked["keep"],
    )


def _example(example: str | list[float], argument: str) -> Example:
    return parse_example(example, argument) if isinstance(example, str) else Vector(tuple(example))


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
