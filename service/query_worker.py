"""Answer the requests of the query process: answers, scores, masks, maps, renders and splats over open scenes.

Run as ``python -m service.query_worker LIFELINE ENCODER``. A request is an order (`service.process`) of the task
``reply``, with an ``operation``.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import zstandard

from liftcore import (
    Answer,
    Camera,
    Kernel,
    Query,
    Scene,
    Segmentation,
    SplatliftError,
    TextEncoder,
    ViewMask,
    WorldFrame,
    open_encoder,
)
from liftcore.errors import InvalidQuery
from liftcore.files import cameras_of_views, finite
from liftcore.models import Edit, OwnCamera, SceneTree, SelectionSummary, Viewpoint
from liftcore.text import OWN_WORDS, CachingEncoder
from service.process import do_orders
from service.settings import encoder_version

if TYPE_CHECKING:
    from service.process import Reporter

EDITED = "edited"  # the name of a selection during an edit; those of stored selections are hexadecimal
SCENES = 2  # lifts that are kept open
CACHE_BYTES = 256 << 20  # of answers and views that are kept
ENTRY_BYTES = 2 << 10  # of what is no array in a cached value: an object, a word
PIPE_BYTES = 256 << 10  # of a document in the pipe; a larger one is a file, so that a slow client keeps no memory
DOCUMENTS = ("query", "objects", "segment", "nearest_words", "suggested_words", "scene_objects", "tree")
VALUES = ("views", "edit", "count_objects")  # for the HTTP process
WORD_COSINES = 1 << 31  # of splats times words: about a minute and a half on one core
MASK_PIXELS = 1 << 26  # of all views of an export: a minute, as for the largest picture
WORD_FILES = ("labels", "map", "picture")  # of many words
VIEW_LINKS = ("render", "mask", "attention")  # links of an answer that end with a view
Request = dict[str, Any]


class Cache:
    """The values that were used last, by their bytes; the newest one is kept whatever its size."""

    def __init__(self, limit: int) -> None:
        self._limit, self._count, self._values = limit, 0, OrderedDict[object, tuple[Any, int]]()

    def get(self, key: object, make: Callable[[], Any]) -> Any:
        """Return the value of a key; compute it if there is none."""
        if key not in self._values:
            value = make()
            self._values[key] = value, bytes_of(value)
            self._count += self._values[key][1]
            while self._count > self._limit and len(self._values) > 1:
                self._count -= self._values.popitem(last=False)[1][1]
        self._values.move_to_end(key)
        return self._values[key][0]


def bytes_of(value: Any) -> int:
    """Return about the bytes of an answer, a view of it, or a list of objects: its arrays, and so much an item."""
    fields = [*vars(value).values(), *(getattr(value, "__pydantic_private__", None) or {}).values()]
    items = itertools.chain.from_iterable(field if isinstance(field, tuple | list) else (field,) for field in fields)
    return sum(getattr(item, "nbytes", ENTRY_BYTES) for item in items)


class Answers:
    """Answer requests; a lift is identified by its path, a text encoder by its specification."""

    def __init__(self, encoder: str) -> None:
        self._scenes = OrderedDict[str, Scene]()
        self._cache = Cache(CACHE_BYTES)
        self._encoders: dict[str, tuple[object, TextEncoder]] = {}  # spec -> version of its file, encoder
        self._opening = threading.RLock()  # for opening encoders, which the warm-up does too
        self._warm = set[Kernel]()  # kernels of splats whose compiled code is loaded or being loaded
        threading.Thread(target=self._warm_up, args=(encoder,), daemon=True).start()

    def _warm_up(self, encoder: str) -> None:
        """Load what the first query would wait for: an encoder and the compiled kernels."""
        with contextlib.suppress(SplatliftError), self._opening:  # the error goes to the queries that need it
            self._encoder(encoder, encoder_version(encoder)).encode(["something"])
        Scene.warm_up()
        self._warm_kernel(Kernel.GAUSSIAN_3D)

    def reply(self, request: Request, _: Reporter) -> dict[str, Any]:
        """Answer by a value or a ``document``; large ones and files are written to the draft."""
        operation = request["operation"]
        if request["lift"] in self._scenes:  # each request describes its selections, whatever another request set
            self._scenes[request["lift"]].selections.clear()
        if operation in VALUES:
            return getattr(self, operation)(request)
        if operation in DOCUMENTS:
            document = json_of(request["head"] | getattr(self, operation)(request))
            if len(document) <= PIPE_BYTES:
                return {"document": document.decode()}
            blocks: Iterable[bytes] = [document]
        else:
            blocks = self._file(request)
        with Path(request["draft"]).open("wb") as file:
            file.writelines(blocks)
        return {}

    # Open scenes, encoders and answers

    def _scene(self, request: Request) -> Scene:
        path = request["lift"]
        if path not in self._scenes:
            if len(self._scenes) == SCENES:  # never hold both the old and the new scene
                self._scenes.popitem(last=False)
            # Load the renderer meanwhile: pictures follow numbers.
            threading.Thread(target=self._warm_kernel, args=(Kernel(request["kernel"]),), daemon=True).start()
            splats, cameras = Path(request["splats"]), Path(request["cameras"])
            self._scenes[path] = Scene(Path(path), splats=splats, cameras=cameras)
        self._scenes.move_to_end(path)
        scene, world = self._scenes[path], WorldFrame(**request["world"])
        if scene.world != world:
            scene.world = world
        for name, bits in request.get("selections", {}).items():
            _select(scene, name, bits)
        return scene

    def _warm_kernel(self, kernel: Kernel) -> None:
        if kernel not in self._warm:
            self._warm.add(kernel)
            Scene.warm_up(kernel)

    def _encoder(self, spec: str, version: object) -> TextEncoder:
        with self._opening:
            entry = self._encoders.get(spec)
            if entry is None or entry[0] != version:  # the operator may have replaced the file of a table
                entry = self._encoders[spec] = (version, CachingEncoder(open_encoder(spec)))
            return entry[1]

    def _text_encoder(self, request: Request) -> TextEncoder:
        lift_table = self._scene(request).table if request["encoder"] == OWN_WORDS else None
        return lift_table or self._encoder(request["encoder"], request["encoder_version"])

    def _words(self, request: Request) -> tuple[list[str], TextEncoder | None]:
        """Return the words of a request, or all of its table; none without an encoder."""
        if request["encoder"] is None:
            return [], None
        encoder = self._text_encoder(request)
        words = request.get("words")
        return self._scene(request).words(encoder) if words is None else words, encoder

    def _answer(self, request: Request) -> Answer:
        def make() -> Answer:
            spec, scene = request["encoder"], self._scene(request)
            encoder = None if spec in (None, OWN_WORDS) else self._encoder(spec, request["encoder_version"])
            return scene.ask(Query(**request["query"]), encoder=encoder, places=False)

        return self._cache.get(_key(request, "query"), make)

    def _view_mask(self, request: Request) -> ViewMask:
        def make() -> ViewMask:
            return self._scene(request).view_mask(self._answer(request), view_of(request))

        return self._cache.get(_key(request, "query", "view", "camera"), make)

    def _segmentation(self, request: Request) -> Segmentation:
        def make() -> Segmentation:
            words, encoder = self._words(request)
            limit = max(1, WORD_COSINES // len(self._scene(request).features))
            if len(words) > limit:
                expected, got = f"at most {limit} words for the splats of this lift", f"{len(words)} of them"
                raise InvalidQuery("words", expected=expected, got=got, hint="ask for some of them at a time")
            return self._scene(request).segment(words, encoder=encoder)

        return self._cache.get(_key(request, "words"), make)

    def _named_tree(self, request: Request) -> SceneTree:
        """Return the tree of a lift with the names that people gave, which have no score."""
        words, encoder = self._words(request)
        tree = self._cache.get(
            _key(request, "world", "tree"), lambda: self._scene(request).tree(words, encoder=encoder)
        )
        labels = request["object_labels"]
        names = {int(number): {"name": name, "score": None} for number, (name, _) in labels.items() if name}
        return tree.replace(nodes=tuple(node.model_copy(update=names.get(node.id)) for node in tree.nodes))

    # Documents

    def query(self, request: Request) -> dict[str, Any]:
        scene, answer = self._scene(request), self._answer(request)
        if request["view"] is not None:
            scene.cameras[request["view"]]  # refuse an unknown view now rather than at its picture
        view = request["view"] or scene.best_view(answer)
        of_view = {} if view is None else {"view": view}
        needs_splats = () if answer.count else ("objects", "object")
        links = {
            name: f"{link}&{urlencode(of_view)}" if name in VIEW_LINKS else link
            for name, link in request["links"].items()
            if name not in needs_splats and (of_view or name not in VIEW_LINKS)
        }
        document = scene.locate(answer, request["top"]).model_dump(mode="json")
        return document | {"view": view, "links": links}

    def objects(self, request: Request) -> dict[str, Any]:
        answer = self._answer(request)
        document = answer.model_dump(mode="json", include=set(SelectionSummary.model_fields))
        return document | self._scene(request).objects(answer).model_dump(mode="json")

    def segment(self, request: Request) -> dict[str, Any]:
        return self._segmentation(request).summary.model_dump(mode="json")

    def nearest_words(self, request: Request) -> dict[str, Any]:
        words, encoder = self._words(request)
        best = self._scene(request).nearest_words(request["example"], words, top=request["top"], encoder=encoder)
        return {"words": [word.model_dump(mode="json") for word in best]}

    def suggested_words(self, request: Request) -> dict[str, Any]:
        encoder = self._text_encoder(request)
        words = self._scene(request).suggested_words(request["text"], request["limit"], encoder=encoder)
        return words.model_dump(mode="json")

    def scene_objects(self, request: Request) -> dict[str, Any]:
        tree, labels = self._named_tree(request), request["object_labels"]
        first, last = request["first"], request["first"] + request["count"]
        objects = [
            item.model_dump(mode="json") | {"hidden": labels.get(str(item.id), ("", False))[1]}
            for item in tree.objects[first:last]
        ]
        count = len(tree.objects)
        head = tree.model_dump(mode="json", exclude={"nodes"})
        return head | {"count": count, "next": last if last < count else None, "objects": objects}

    def tree(self, request: Request) -> dict[str, Any]:
        tree, first, last = self._named_tree(request), request["first"], request["first"] + request["count"]
        page = tree.model_copy(update={"nodes": tree.nodes[first:last]})
        return page.model_dump(mode="json") | {"next": last if last < tree.count else None}

    # Values for the HTTP process

    def views(self, request: Request) -> dict[str, Any]:
        scene, (first, count) = self._scene(request), request["range"]
        names: Iterable[str] = itertools.islice(scene.cameras, first, first + count)
        if "view" in request:
            names = cameras_of_views([request["view"]], scene.cameras).values()
        lifted_views = set(scene.metadata.views)
        cameras = [
            OwnCamera.of(scene.cameras[name], name).model_dump(exclude_unset=True) | {"lifted": name in lifted_views}
            for name in names
        ]
        return {"views": cameras, "next": first + count if first + count < len(scene.cameras) else None}

    def edit(self, request: Request) -> dict[str, Any]:
        """Return a selection after an edit: its count, box, and bits."""
        scene = self._scene(request)
        answer = self._answer(request) if "query" in request else None
        edit = Edit.model_validate(request["edit"])
        selection = _select(scene, EDITED, request["before"]).edit(edit, answer)
        box = None if selection.box is None else asdict(selection.box)
        bits = selection.bits.hex()
        return {"count": int(selection.splats.sum()), "box": finite(box), "bits": bits}

    def count_objects(self, request: Request) -> dict[str, Any]:
        views = self._scene(request).object_views
        return {"count": 0 if views is None else len(views)}

    # Files

    def _file(self, request: Request) -> Iterable[bytes]:
        """Return a file of an answer, of many words, of a lift or of the scene."""
        scene, operation = self._scene(request), request["operation"]
        view = view_of(request) if "view" in request or "camera" in request else None
        if operation == "export":
            return self._export(request)
        if operation == "colours":
            return scene.blocks_of(scene.colours(request["layer"]))
        if operation in WORD_FILES:
            return scene.blocks_of(self._segmentation(request), operation, view=view)
        if "query" in request:
            view_mask = self._view_mask(request) if operation in ("mask", "attention") else None
            return scene.blocks_of(self._answer(request), operation, view=view, view_mask=view_mask)
        scene = scene.without(request.get("hide", ()))
        blocks = scene.blocks_of(None, request.get("channel", "splats"), view=view)
        return compressed(blocks) if request.get("compressed") else blocks

    def _export(self, request: Request) -> Iterable[bytes]:
        """Return a file with labels: those of answers, of words or of objects."""
        scene = self._scene(request)
        views = scene.metadata.views if request["of_view"] is None else (request["of_view"],)
        views = views if request["content"] == "masks" else ()
        pixels = sum(math.prod(scene.cameras[view].photo_size) for view in views)
        if pixels > MASK_PIXELS:
            expected, got = f"views of at most {MASK_PIXELS} pixels together", f"{pixels} in {len(views)} views"
            raise InvalidQuery("view", expected=expected, got=got, hint="export the masks of a view at a time")
        source: Any
        if request["of"] == "questions":
            source = {part["name"]: self._answer(part["request"]) for part in request["parts"]}
            for part in request["parts"]:  # the selections of cached answers too
                self._scene(part["request"])
        elif request["of"] == "words":
            source = self._segmentation(request)
        else:
            source = self._named_tree(request)
        return scene.blocks_of(source, request["content"], view=request["of_view"], suffix=request["suffix"])


def _select(scene: Scene, name: str, bits: str) -> Any:
    """Return a selection of these splats; drop the history of a selection with the same name."""
    scene.selections.pop(name, None)
    return scene.select(name).edit(Edit(operation="set", bits=bits))


def _key(request: Request, *names: str) -> str:
    """Return the key of a value in the cache: a digest, as a question may be as long as a body."""
    decides = ("lift", "encoder", "encoder_version", "selections", *names)
    values = [[name, request.get(name)] for name in decides if name in request]
    return hashlib.sha256(json.dumps([names, values]).encode()).hexdigest()


def json_of(document: dict[str, Any]) -> bytes:
    """Return a document as JSON, which has no infinite numbers: boxes of huge splats may hold them."""
    try:
        return json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    except ValueError:
        return json.dumps(finite(document), allow_nan=False, separators=(",", ":")).encode()


def compressed(blocks: Iterable[bytes]) -> Iterable[bytes]:
    """Compress blocks as zstd, at the level that costs less time than any network takes for what it saves."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    yield from map(compressor.compress, blocks)
    yield compressor.flush()


def view_of(request: Request) -> str | Camera:
    """Return the camera of a picture: a view of the scene, or the camera in the request."""
    return Viewpoint(view=request.get("view"), camera=request.get("camera")).seen_from()


if __name__ == "__main__":
    do_orders(lambda: Answers(sys.argv[2]))
