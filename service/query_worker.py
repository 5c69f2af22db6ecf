"""Answer the requests of the query process: answers, scores, masks, maps, renders and splats over open scenes.

Run as ``python -m service.query_worker SOCKET SCENES CACHE_BYTES ENCODER``. The socket, a connection of
multiprocessing's, brings JSON lists of requests: the first of each is answered, the others wait behind it. When its
stdin closes it ends by itself. The compiled kernels and the encoder named are loaded beside the first requests, which
wait for no more than they need.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import math
import sys
import threading
import traceback
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, TypeVar

from cachetools import LRUCache

from liftcore import (
    Answer,
    Camera,
    Catalogue,
    Kernel,
    Objects,
    Query,
    Scene,
    Segmentation,
    SplatliftError,
    TextEncoder,
    ViewMask,
    WorldFrame,
    choose_device,
    open_encoder,
)
from liftcore.errors import InvalidQuery
from liftcore.files import cameras_of_views
from liftcore.models import Edit, OwnCamera, SceneTree, SelectionSummary, Viewpoint
from liftcore.text import OWN_WORDS
from service.child import end_with_parent, fault_of
from service.errors import NoSpace
from service.query_client import PIPE_BYTES, Frame, send_frame
from service.settings import encoder_version

WARM_UP_TEXT = "something"
EDITED = "edited"  # the name of a selection during an edit; names of questions are hexadecimal
WORD_FILES = {"word_labels": "splat_labels", "word_map": "labels", "word_picture": "picture"}  # for `blocks_of`
SPLATS_FILES = {"object": "object", "scores": "coloured"}
PRODUCT_BYTES = 128 << 20  # of cosines in one pass over a lift's features
COSINE_BYTES = 4  # of a splat and a direction
ANSWER_BYTES = 6  # of a splat: score, whether it has a feature, whether it is selected
ENTRY_BYTES = 2 << 10  # of a cache entry, beside its tensors and its question
WORD_COSINES = 1 << 31  # of splats times words: about a minute and a half on one core
MASK_PIXELS = 1 << 26  # of all views of an export: a minute, as for the largest picture
RELATION_BYTES = 512  # of a relation: a pydantic model with its dictionary
NUMBER_BYTES = 32  # of a number in a question: a Python float and its place in a tuple


Cached = Answer | Objects | ViewMask | Segmentation | Catalogue | SceneTree
K = TypeVar("K", bound=Cached)


class Answers:
    """Answer requests; a lift is identified by its path, a text encoder by its specification.

    Args:
        scenes: lifts that are kept open.
        cache_bytes: of the answers, objects and views that are kept; the last one is kept whatever its size.
    """

    def __init__(self, *, scenes: int, cache_bytes: int) -> None:
        self._scenes = LRUCache[str, Scene](scenes)
        limit = max(1, cache_bytes)
        self._cache = LRUCache[object, Cached](limit, lambda value: min(bytes_of(value), limit))
        self._encoders: dict[str, tuple[object, TextEncoder]] = {}  # spec -> version of its file, encoder
        self._opening = threading.RLock()  # for opening encoders, which the warm-up does too
        self._warm: set[Kernel] = set()  # kernels of splats whose compiled code is loaded or being loaded
        self._operations: dict[str, Callable[[dict[str, Any]], Frame]] = {
            "query": self._query,
            "objects": self._objects,
            "views": self._views,
            "segment": self._segment,
            "what": self._nearest_words,
            "askable": self._askable,
            "catalogue": self._catalogue,
            "tree": self._tree,
            "regions": self._regions,
            "device": self._device,
            "edit": self._edit,
            "export": self._export,
            "count_objects": self._count_objects,
        }

    @property
    def kept_bytes(self) -> int:
        """Bytes of the cached answers, objects and views."""
        return int(self._cache.currsize)

    def warm_up(self, encoder: str, version: object) -> None:
        """Load what the first query would wait for: an encoder and the compiled kernels.

        The error of an encoder that does not open goes to the queries that need it.
        """
        with contextlib.suppress(SplatliftError), self._opening:
            self._encoder(encoder, version).encode([WARM_UP_TEXT])
        Scene.warm_up()
        self._warm_kernel(Kernel.GAUSSIAN_3D)

    def reply(self, request: dict[str, Any], lookahead: Sequence[dict[str, Any]] = ()) -> Frame:
        """Return the reply to one request, by its ``operation``.

        Args:
            request: the query.
            lookahead: the requests that follow it. Queries of the same lift among them are answered in the same pass
                over its features, which costs little more than a single query, and are cached.

        Raises:
            SplatliftError: the request cannot be answered.
        """
        if request.get("lift") in self._scenes:  # each request describes its selection, whatever another request set
            self._scenes[request["lift"]].selections.clear()
        if "query" in request and _key(request) not in self._cache:
            self._answer_together([request, *lookahead])
        return self._operations.get(request["operation"], self._file)(request)

    def _answer_together(self, requests: Sequence[dict[str, Any]]) -> None:
        """Answer the first question, and others about its lift in the same pass; their errors are raised later."""
        scene = self._scene(requests[0])
        splats = len(scene.features)
        capacity = min(
            PRODUCT_BYTES // (COSINE_BYTES * splats), self._cache.maxsize // (ANSWER_BYTES * splats + ENTRY_BYTES)
        )
        questions: dict[str, Any] = {}
        for request in requests:
            is_alike = all(request.get(name) == requests[0].get(name) for name in ("lift", "selections"))
            if not is_alike or "query" not in request or _key(request) in self._cache:
                continue
            with contextlib.suppress(SplatliftError):
                question = self._question(request)
                if not questions or len(question.rows) <= capacity:
                    questions[_key(request)] = question
                    capacity -= len(question.rows)
        if questions:
            for key, answer in zip(questions, scene.answer(list(questions.values())), strict=True):
                self._cache[key] = answer

    def _cached(self, kind: type[K], key: object, make: Callable[[], K]) -> K:
        """Return the cached value of a key; compute it if there is none."""
        if key not in self._cache:
            self._cache[key] = make()
        value = self._cache[key]
        assert isinstance(value, kind)
        return value

    def _scene(self, request: dict[str, Any]) -> Scene:
        if request["lift"] not in self._scenes:
            if self._scenes.currsize == self._scenes.maxsize:  # never hold both the old and the new scene
                self._scenes.popitem()
            self._scenes[request["lift"]] = self._open(request)
        scene, world = self._scenes[request["lift"]], WorldFrame(**request.get("world", {}))
        if scene.world != world:
            scene.world = world
        for name, bits in request.get("selections", {}).items():
            _selected(scene, name, bits)
        if "features" in request:
            scene.find_packs([Path(path) for path in request["features"]])
        return scene

    def _open(self, request: dict[str, Any]) -> Scene:
        # Load the renderer meanwhile: pictures follow numbers.
        threading.Thread(target=self._warm_kernel, args=(Kernel(request["kernel"]),), daemon=True).start()
        return open_scene(request)

    def _warm_kernel(self, kernel: Kernel) -> None:
        if kernel not in self._warm:
            self._warm.add(kernel)
            Scene.warm_up(kernel)

    def _encoder(self, spec: str, version: object) -> TextEncoder:
        with self._opening:
            entry = self._encoders.get(spec)
            if entry is None or entry[0] != version:  # the operator may have replaced the file of a table
                entry = self._encoders[spec] = (version, open_encoder(spec, remembers=True))
            return entry[1]

    def _question(self, request: dict[str, Any]) -> Any:
        spec = request["encoder"]
        encoder = None if spec in (None, OWN_WORDS) else self._encoder(spec, request["encoder_version"])
        query = Query(**request["query"])
        return self._scene(request).prepare(query, encoder)

    def _answer(self, request: dict[str, Any]) -> Answer:
        return self._cached(Answer, _key(request), lambda: self._scene(request).answer([self._question(request)])[0])

    def _view_mask(self, request: dict[str, Any]) -> ViewMask:
        answer = self._answer(request)

        def make() -> ViewMask:
            scene, view = self._scene(request), view_of(request)
            return scene.view_mask(answer, view, find_objects=lambda: self._grouped(request))

        seen_from = json.dumps(request.get("camera", request.get("view")))
        return self._cached(ViewMask, (_key(request), "view", seen_from), make)

    def _grouped(self, request: dict[str, Any]) -> Objects:
        answer = self._answer(request)
        key = (_key(request), "objects", json.dumps(request.get("world")))
        return self._cached(Objects, key, lambda: self._scene(request).objects(answer))

    def _query(self, request: dict[str, Any]) -> Frame:
        scene, answer = self._scene(request), self._answer(request)
        if request["view"] is not None:
            scene.cameras[request["view"]]  # refuse an unknown view now rather than at its picture
        return Frame(scene.locate(answer, request["top"]).model_dump(mode="json"))

    def _objects(self, request: dict[str, Any]) -> Frame:
        document = self._answer(request).model_dump(mode="json", include=set(SelectionSummary.model_fields))
        return Frame(document | self._grouped(request).model_dump(mode="json"))

    def _file(self, request: dict[str, Any]) -> Frame:
        """Return a file of an answer, of named splats, of an object or of the scene."""
        scene, operation = self._scene(request), request["operation"]
        kind_asked = request.get("what", request.get("channel", ""))
        view = view_of(request) if "view" in request or "camera" in request else None
        if operation == "layer":
            blocks = scene.blocks_of(scene.colours(kind_asked))
        elif operation == "region_mask":
            mask = scene.region_mask(request["view"], request["level"], request["region"])
            blocks = scene.blocks_of(mask, "mask")
        elif operation in WORD_FILES:
            blocks = scene.blocks_of(self._segmentation(request), WORD_FILES[operation], view=view)
        elif "query" in request:
            view_mask = self._view_mask(request) if operation in ("mask", "attention") else None
            kind = SPLATS_FILES[kind_asked] if operation == "splats" else operation
            blocks = scene.blocks_of(self._answer(request), kind, view=view, view_mask=view_mask)
        else:  # one of its objects, its splats or a picture of it
            blocks = scene.blocks_of(
                request.get("object"), "" if operation == "splats" else kind_asked or "splats", view=view
            )
        if operation not in ("splats", "scene"):
            return _small_file(b"".join(blocks), request)
        write_draft(blocks, Path(request["draft"]))
        return Frame({})

    def _views(self, request: dict[str, Any]) -> Frame:
        cameras = self._scene(request).cameras
        if "view" in request:
            names_found = cameras_of_views([request["view"]], cameras).values()
            return Frame({"views": [_camera(cameras[name], name) for name in names_found], "more": False})
        first, count = request["first"], request["count"]
        names = list(itertools.islice(cameras, first, first + count))
        has_more = first + count < len(cameras)
        return Frame({"views": [_camera(cameras[name], name) for name in names], "more": has_more})

    def _text_encoder(self, request: dict[str, Any]) -> TextEncoder:
        lift_table = self._scene(request).table if request["encoder"] == OWN_WORDS else None
        return lift_table or self._encoder(request["encoder"], request["encoder_version"])

    def _words(self, request: dict[str, Any]) -> tuple[list[str], TextEncoder]:
        """Return the words of a request, or all of its table."""
        encoder = self._text_encoder(request)
        return self._scene(request).words(encoder) if request["words"] is None else request["words"], encoder

    def _segmentation(self, request: dict[str, Any]) -> Segmentation:
        def make() -> Segmentation:
            words, encoder = self._words(request)
            limit = max(1, WORD_COSINES // len(self._scene(request).features))
            if len(words) > limit:
                expected, got = f"at most {limit} words for the splats of this lift", f"{len(words)} of them"
                raise InvalidQuery("words", expected=expected, got=got, hint="ask for some of them at a time")
            return self._scene(request).segment(words, encoder=encoder)

        return self._cached(Segmentation, (_key(request), "words"), make)

    def _segment(self, request: dict[str, Any]) -> Frame:
        document = self._segmentation(request).summary.model_dump(mode="json")
        return _json(request, document, "named_words", document.pop("named_words"))

    def _nearest_words(self, request: dict[str, Any]) -> Frame:
        words, encoder = self._words(request)
        best = self._scene(request).nearest_words(request["example"], words, top=request["top"], encoder=encoder)
        return Frame({"words": [word.model_dump(mode="json") for word in best]})

    def _askable(self, request: dict[str, Any]) -> Frame:
        scene = self._scene(request)
        encoder = self._text_encoder(request)
        return Frame(scene.askable(request["text"], request["count"], encoder=encoder).model_dump(mode="json"))

    def _catalogue(self, request: dict[str, Any]) -> Frame:
        decides = (request.get(name) for name in ("lift", "encoder", "encoder_version", "world"))
        key = ("catalogue", json.dumps([*decides]))
        catalogue = self._cached(Catalogue, key, lambda: self._named_objects(request))
        first, last = request["first"], request["first"] + request["count"]
        if request["splat"] is not None:
            first, last = self._object_of(request)
        labels = {
            number: {"name": name, "hidden": is_hidden} for number, (name, is_hidden) in request["object_labels"]
        }
        objects = (
            item.model_dump(mode="json") | {"hidden": False} | _object_label(labels.get(item.id))
            for item in catalogue.iterate_objects(first, last, features=request["means"])
        )
        after = last if last < len(catalogue.objects) else None
        document = {"explanation": catalogue.explanation, "count": len(catalogue.objects), "next": after}
        return _json(
            request,
            document | {"world": catalogue.world.model_dump(mode="json"), "unit": catalogue.world.unit},
            "objects",
            objects,
        )

    def _object_of(self, request: dict[str, Any]) -> tuple[int, int]:
        """Return the rank of a splat's object and the next one, as a slice's ends; both equal if it has no object."""
        numbers, splat = self._scene(request).object, request["splat"]
        if numbers is None or splat >= len(numbers) or numbers[splat] < 0:
            return 0, 0
        return int(numbers[splat]), int(numbers[splat]) + 1

    def _tree(self, request: dict[str, Any]) -> Frame:
        def make() -> SceneTree:
            return self._named_tree(request, relations=request["relations"], up=_direction(request["up"]))

        decides = (request.get(name) for name in ("lift", "encoder", "encoder_version", "relations", "up", "world"))
        tree = self._cached(SceneTree, ("tree", json.dumps([*decides])), make)
        first, last = request["first"], request["first"] + request["count"]
        nodes = tree.nodes[first:last]
        ids = {item.id for item in nodes}
        relations = tuple(item for item in tree.relations if item.node in ids)
        page = tree.model_copy(update={"nodes": nodes, "relations": relations})
        document = page.model_dump(mode="json", exclude={"nodes"}) | {"next": last if last < tree.count else None}
        return _json(request, document, "nodes", (item.model_dump(mode="json") for item in page.nodes))

    def _regions(self, request: dict[str, Any]) -> Frame:
        regions = self._scene(request).regions(request["view"], request["x"], request["y"])
        return Frame({"regions": [region.model_dump(mode="json") for region in regions]})

    def _device(self, request: dict[str, Any]) -> Frame:
        try:
            choose_device(request["device"])
        except SplatliftError as error:
            return Frame({"lack": fault_of(error)})
        return Frame({"lack": None})

    def _edit(self, request: dict[str, Any]) -> Frame:
        """Return a selection after an edit: its count, and its bits compressed by zlib."""
        scene = self._scene(request)
        answer = self._answer(request) if "query" in request else None
        edit = Edit.model_validate(request["edit"])
        selection = _selected(scene, EDITED, request["before"]).edit(edit, answer)
        count, box = int(selection.splats.sum()), selection.box
        corners = None if box is None else {"low": box.low, "high": box.high}
        return Frame({"edit": edit.to_json(), "count": count, "box": corners}, zlib.compress(selection.bits))

    def _export(self, request: dict[str, Any]) -> Frame:
        """Write a ZIP of answers, of words or of objects, as the draft."""
        scene = self._scene(request)
        views = scene.metadata.views if request["of_view"] is None else (request["of_view"],)
        pixels = sum(math.prod(scene.cameras[view].photo_size) for view in views)
        if pixels > MASK_PIXELS:
            expected, got = f"views of at most {MASK_PIXELS} pixels together", f"{pixels} in {len(views)} views"
            raise InvalidQuery("view", expected=expected, got=got, hint="export the masks of a view at a time")
        source: Any
        if request["of"] == "questions":
            source = {part["name"]: self._answer(part["request"]) for part in request["parts"]}
            for part in request["parts"]:  # sets of answers, cached too
                self._scene(part["request"])
        elif request["of"] == "words":
            source = self._segmentation(request)
        else:
            source = self._labelled_objects(request)
        blocks = scene.blocks_of(source, "bundle", view=request["of_view"])
        write_draft(blocks, Path(request["draft"]))
        return Frame({})

    def _labelled_objects(self, request: dict[str, Any]) -> Catalogue | SceneTree:
        """Return the named objects of a lift by their names, with their parts."""
        labels = {number: {"name": name} for number, (name, _) in request["object_labels"] if name is not None}
        if self._scene(request).node is None:
            catalogue = self._named_objects(request)
            return replace(
                catalogue, objects=tuple(item.model_copy(update=labels.get(item.id)) for item in catalogue.objects)
            )
        tree = self._named_tree(request)
        return tree.model_copy(
            update={"nodes": tuple(item.model_copy(update=labels.get(item.id)) for item in tree.nodes)}
        )

    def _count_objects(self, request: dict[str, Any]) -> Frame:
        views = self._scene(request).object_views
        return Frame({"count": 0 if views is None else len(views)})

    def _named_tree(self, request: dict[str, Any], **options: Any) -> SceneTree:
        words, encoder = ([], None) if request["encoder"] is None else self._words(request)
        return self._scene(request).tree(words, encoder=encoder, **options)

    def _named_objects(self, request: dict[str, Any]) -> Catalogue:
        """Return the objects of a lift, named by the words of a table if the request has one."""
        words, encoder = ([], None) if request["encoder"] is None else self._words(request)
        return self._scene(request).catalogue(words, encoder=encoder)


def _selected(scene: Scene, name: str, bits: str) -> Any:
    """Return a selection of these splats; drop the history of a selection with the same name."""
    scene.selections.pop(name, None)
    return scene.select(name).edit(Edit(operation="set", bits=bits))


def _direction(up: str | None) -> tuple[float, float, float] | Literal["cameras"] | None:
    if up is None or up == "cameras":
        return up
    x, y, z = map(float, up.split(","))
    return x, y, z


def _object_label(label: dict[str, Any] | None) -> dict[str, Any]:
    """Return the label of an object: whether it is hidden, and its name, which has no score."""
    if label is None or label["name"] is None:
        return {} if label is None else {"hidden": label["hidden"]}
    return label | {"score": None}


def _small_file(content: bytes, request: dict[str, Any]) -> Frame:
    """Return an array or a picture: through the pipe, or as the draft."""
    if len(content) <= PIPE_BYTES:
        return Frame({}, content)
    write_draft([content], Path(request["draft"]))
    return Frame({})


def _json(request: dict[str, Any], document: dict[str, Any], name: str, items: Iterable[dict[str, Any]]) -> Frame:
    """Return a long JSON list whole, which the HTTP process passes on: through the pipe or as the draft."""
    dumps = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode
    head = dumps(request["head"] | document).removesuffix("}")
    return _small_file(f"{head},{dumps(name)}:[{','.join(map(dumps, items))}]}}".encode(), request)


def write_draft(blocks: Iterable[bytes], draft: Path) -> None:
    """Write a large answer to the file that the HTTP process reads and removes.

    Raises:
        NoSpace: the disk is full.
    """
    try:
        with draft.open("wb") as file:
            file.writelines(blocks)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        expected, hint = "room on the disk for the answer", "ask again later, or tell the operator"
        raise NoSpace("splats", expected=expected, got="a full disk", hint=hint) from None


def _key(request: dict[str, Any]) -> str:
    """Return the key of an answer in the cache: a digest, as a question may be as long as a body."""
    names = ("lift", "encoder", "encoder_version", "query" if "query" in request else "words")
    values = [*(request[name] for name in names), request.get("selections")]
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def bytes_of(value: Cached) -> int:
    """Return the bytes that an answer takes, with its question; or its objects, a view of it, or named splats."""
    if isinstance(value, Answer):
        tensors = value.scores.nbytes + value.has_feature.nbytes + value.selected.nbytes
        return ENTRY_BYTES + tensors + sum(map(_term_bytes, value.query.terms))
    if isinstance(value, Objects):
        return ENTRY_BYTES + value.numbers.nbytes
    if isinstance(value, Segmentation):
        return (
            ENTRY_BYTES + value.labels.nbytes + value.margin.nbytes + sum(len(word.encode()) for word in value.words)
        )
    if isinstance(value, Catalogue):
        return ENTRY_BYTES * (1 + len(value.objects)) + value.features.nbytes
    if isinstance(value, SceneTree):
        return ENTRY_BYTES * (1 + len(value.nodes)) + RELATION_BYTES * len(value.relations)
    return ENTRY_BYTES + value.attention.nbytes + value.row_sums.nbytes + value.mask.nbytes


def _term_bytes(term: Any) -> int:
    return NUMBER_BYTES * len(term.values) if hasattr(term, "values") else len(str(term).encode())


def view_of(request: dict[str, Any]) -> str | Camera:
    """Return the camera of a picture: a view of the scene, or the camera in the request.

    Raises:
        InvalidCameras: it is not a camera.
    """
    return Viewpoint(view=request.get("view"), camera=request.get("camera")).seen_from()


def open_scene(request: dict[str, Any]) -> Scene:
    """Open a lift with its splats and cameras at their present paths: data directories may move."""
    splats, cameras = Path(request["splats"]), Path(request["cameras"])
    return Scene(Path(request["lift"]), splats=splats, cameras=cameras)


def _camera(camera: Camera, name: str) -> dict[str, Any]:
    return OwnCamera.of(camera, name).model_dump(exclude_unset=True)


def reply_to(requests: list[dict[str, Any]], answers: Answers) -> Frame:
    """Return the answer to the first request, or its error as a header; the others are the next ones."""
    try:
        return answers.reply(requests[0], requests[1:])
    except SplatliftError as error:
        return Frame({"fault": fault_of(error, requests[0]["names"])})
    except Exception:
        traceback.print_exc()
        return Frame({"crash": True})


def _warm_up(answers: Answers, encoder: str) -> None:
    try:
        answers.warm_up(encoder, encoder_version(encoder))
    except Exception:  # the next request gets the same error
        traceback.print_exc()


def main() -> None:
    """Answer requests until the server has ended."""
    end_with_parent(sys.stdin.fileno())
    server = Connection(int(sys.argv[1]))
    answers = Answers(scenes=int(sys.argv[2]), cache_bytes=int(sys.argv[3]))
    threading.Thread(target=_warm_up, args=(answers, sys.argv[4]), daemon=True).start()
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            send_frame(server, reply_to(json.loads(server.recv_bytes()), answers))


if __name__ == "__main__":
    main()
