"""``splatlift demo``: run the main job through the real service, on the published example or on a scene of yours."""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
from PIL import Image

from liftcore import read_features
from liftcore.cli import Parser
from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.files import identify, visible_files
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

LISTENING = "listening on "  # the begin of the service's first line
STOP_SECONDS = 20
LAST_WORDS = 3_000  # characters of the service's log, after a failure
POLL_SECONDS = 0.25
TIMEOUT = httpx.Timeout(600.0, connect=10.0)  # the first query loads an encoder
FINAL_STATES = ("succeeded", "failed", "canceled")


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    cameras = "cameras.json, transforms.json, cameras.zip or sparse/0"
    holds = f"its .ply, .sog, .spz or .splat; {cameras}; a feature pack; text_table.safetensors if any"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=f"a scene of yours ({holds}); else the shipped one")
    parser.add_argument(
        "--ask", action="append", default=[], metavar="TEXT", help="what to look for; may be given several times"
    )
    parser.add_argument("--pack", type=Path, metavar="FILE", help="of several feature packs of the scene, which one")
    parser.add_argument("--out", type=Path, default=Path("demo-output"), metavar="DIR", help="of pictures and lift")


def run(options: argparse.Namespace) -> int:
    """Find the scene, run the service as a user would, and report the results."""

    def say(line: str) -> None:
        if not options.json:
            print(line, flush=True)

    begin, out, data = time.perf_counter(), options.out, options.out / "service"
    out.mkdir(parents=True, exist_ok=True)
    if options.scene is None:
        say("12 published splat objects on a table (sources: scene/LICENCES.md), with CLIP's vectors of words.")
    folder = options.scene or unpack_tabletop(out / "scene")
    subject = find_scene(folder, options.ask, out / "scene", options.pack)
    if subject.other_packs:
        other_packs = ", ".join(subject.other_packs)
        say(f"Features are those of {subject.features.name}; --pack takes others that are here: {other_packs}.")
    with serving(data, subject.encoder, out / "service.log") as url:
        say(f"The service listens on {url}.")
        report = show(subject, url, out, say)
    report |= {"seconds": round(time.perf_counter() - begin, 1), "out": str(out.resolve())}
    report["lift_file"] = str((data / "lifts" / f"{report['lift']}.safetensors").resolve())
    say(f"Pictures are in {report['out']}. All of it took {report['seconds']:.0f} s.")
    say(f"The lift is {report['lift_file']}")
    if options.json:
        print(json.dumps(report))
    return 0


@contextmanager
def serving(data: Path, encoder: str, log: Path) -> Iterator[str]:
    """Run ``splatlift serve`` on a free port during the block; yield its address.

    Args:
        data: the service's directory. encoder: its text encoder. log: the file of its output.

    Raises:
        Unavailable: the service does not start; the message holds the end of its log.
    """
    options = ["--port", "0", "--data", str(data), "--encoder", encoder]
    command = [sys.executable, "-m", "liftcore.cli", "serve", *options]
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr, text=True
        ) as server,
    ):
        try:
            first_line = server.stdout.readline() if server.stdout else ""
            if first_line.startswith(LISTENING):
                yield first_line.removeprefix(LISTENING).strip()
        except BaseException:
            print(f"--- the service's last words ---\n{_last_words(log)}", file=sys.stderr)
            raise
        finally:
            server.terminate()
            try:
                server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()
    if not first_line.startswith(LISTENING):
        got = f"an early end; its last words: {_last_words(log)}"
        raise Unavailable("service", expected="a service that starts", got=got)


def _last_words(log: Path) -> str:
    return log.read_text(errors="replace")[-LAST_WORDS:].strip() or "not a word"


class Client:
    """HTTP client of a service on this machine. Answers of 4xx and 5xx become errors with the service's message.

    Raises:
        InvalidInput: the service refused a request.
        Unavailable: it cannot be reached, or failed itself.
    """

    def __init__(self, url: str) -> None:
        key = os.environ.get("SPLATLIFT_KEY")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        # ignore a proxy of the environment
        self._http = httpx.Client(base_url=url, timeout=TIMEOUT, trust_env=False, headers=headers)

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def upload(self, kind: str, path: Path) -> dict[str, Any]:
        """Upload a file by ``PUT /assets/KIND``; return the asset, with its id and counts."""
        with path.open("rb") as file:
            return self._call("PUT", f"/assets/{kind}", content=file).json()

    def lift(
        self, order: dict[str, Any], progress: Callable[[dict[str, Any]], None]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Send ``POST /lift`` and wait; return the job and its lift."""
        job = self._call("POST", "/lift", json=order).json()
        while job["state"] not in FINAL_STATES:
            progress(job)
            time.sleep(POLL_SECONDS)
            job = self.get(f"/jobs/{job['id']}")
        progress(job)
        if job["state"] != "succeeded":
            raise _refusal("lift", job.get("problem") or {}, job["state"])
        return job, self.get(f"/lifts/{job['id']}")

    def get(self, path: str, **parameters: str) -> dict[str, Any]:
        """Return the JSON of any route."""
        return self._call("GET", path, params=parameters).json()

    def picture(self, path: str, **parameters: str) -> bytes:
        """Return a PNG of the service."""
        return self._call("GET", path, params=parameters).content

    def _call(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **options)
        except httpx.HTTPError as error:
            raise Unavailable("service", expected=f"an answer to {method} {path}", got=repr(error)) from None
        if response.is_success:
            return response
        kind = response.headers.get("content-type", "")
        problem = response.json() if "json" in kind else {"detail": response.text[:200]}
        raise _refusal(f"{method} {path}", problem, str(response.status_code))


def _refusal(operation: str, problem: dict[str, Any], status: str) -> SplatliftError:
    """Return the service's problem as an error: with its fields if it has them, else with its sentence."""
    kind = Unavailable if problem.get("status", 0) >= 500 else InvalidInput
    if problem.get("expected") and problem.get("got"):
        argument = problem.get("argument") or operation
        return kind(argument, expected=problem["expected"], got=problem["got"], hint=problem.get("hint") or "")
    return kind(operation, expected="success", got=problem.get("detail") or problem.get("title") or status)


@dataclass(frozen=True)
class Finding:
    """Result of one phrase."""

    phrase: str
    present: bool | None  # the scene has it; None: unknown or uncertain
    reason: str  # of the presence
    object: str | None  # name of the object that the masks show most, if names are known
    splats: int  # selected
    score: float  # the best cosine
    threshold: float | None  # for the splats' scores
    explanation: str
    objects: list[dict[str, Any]]  # the selected objects, with their places
    query_ms: float
    mask_ms: float  # mean over views, without the query
    iou: float | None  # mean over views with labels
    pictures: dict[str, str]  # kind -> file name


def show(subject: DemoScene, url: str, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Upload, lift and query; write pictures to ``out`` and sentences to ``say``.

    Returns:
        The results, as plain values.

    Raises:
        InvalidInput: the service refused the scene. Unavailable: it failed.
    """
    client = Client(url)
    try:
        files = {"splats": subject.splats, "cameras": subject.cameras, "features": subject.features}
        assets = {kind: client.upload(kind, path) for kind, path in files.items()}
        say(f"Uploaded {', '.join(_counts(kind, asset) for kind, asset in assets.items())}.")
        order = {kind: assets[kind]["id"] for kind in ("splats", "cameras")}
        job, lift = client.lift({**order, "features": [assets["features"]["id"]]}, _show_progress)
        took = (job["ended"] or 0) - (job["started"] or 0)
        say(f"Lifted {lift['channels']} channels onto {lift['count']:,} splats in {took:.1f} s.")
        pictures = {"rgb": f"render-{subject.views[0]}.png", "pca": f"features-{subject.views[0]}.png"}
        for picture, name in pictures.items():
            (out / name).write_bytes(client.picture("/render", lift=lift["id"], view=subject.views[0], what=picture))
        kind, phrases = "text", subject.phrases
        if not phrases:
            kind, phrases = "like", (_middle(out / pictures["rgb"], subject.views[0]),)
            for line in _why_no_words(subject, phrases[0]):
                say(line)
        # The first query opens the lift and is not timed.
        client.get("/query", lift=lift["id"], **{kind: phrases[0]}, threshold="0")
        findings = []
        for phrase in phrases:
            findings.append(_find(client, lift["id"], kind, phrase, subject, out))
            for line in _lines(findings[-1]):
                say(line)
    finally:
        client.close()
    return {
        "scene": subject.name,
        "lift": lift["id"],
        "splats": lift["count"],
        "channels": lift["channels"],
        "views": len(lift["views"]),
        "lift_seconds": took,
        "diagnostics": lift["diagnostics"],
        "view": subject.views[0],
        "text_space": subject.text_space,
        "pictures": pictures,
        "phrases": [asdict(finding) for finding in findings],
    }


def _counts(kind: str, asset: dict[str, Any]) -> str:
    names = ("splats", "views", "channels")  # counts to show
    numbers = ", ".join(f"{value} {name}" for name, value in asset["counts"].items() if name in names)
    return f"{kind} ({numbers})" if numbers else kind


def _show_progress(job: dict[str, Any]) -> None:
    if not sys.stderr.isatty():
        return
    step = job.get("progress") or {}
    parts = f" {step['completed']}/{step['total']} {step['unit']}" if step and step["total"] > 1 else ""
    text = f"{job['state']}  {step['stage'] if step else ''}{parts}" if job["state"] not in FINAL_STATES else ""
    print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _middle(render: Path, view: str) -> str:
    """Return the pixel in the middle of a view, as an example to search for."""
    with Image.open(render) as picture:
        return f"{view}:{picture.width // 2},{picture.height // 2}"


def _why_no_words(subject: DemoScene, example: str) -> list[str]:
    if subject.text_space == NO_WORDS:
        reason = "Its features share a space with no text encoder: they have no words"
    elif not subject.text_space:
        reason = "Its pack does not name its text space (`splatlift pack retag` does)"
    else:
        reason = "Nothing says what this scene shows (`--ask TEXT` asks in words)"
    return [f"  {reason}, so it is asked for more of what the middle of the view shows, {example}."]


def _find(client: Client, lift: str, kind: str, phrase: str, subject: DemoScene, out: Path) -> Finding:
    parameters = {"lift": lift, kind: phrase}
    begin = time.perf_counter()
    answer = client.get("/query", **parameters)
    answer_time = time.perf_counter()
    masks = {view: _pixels(client.picture("/query/mask", view=view, **parameters)) > 0 for view in subject.views}
    mask_seconds = (time.perf_counter() - answer_time) / len(masks)
    from liftcore import ViewMask

    view, best, truth = subject.views[0], answer["top"], subject.truth
    slug = "-".join("".join(c if c.isalnum() else " " for c in phrase.casefold()).split())
    names = {picture: f"{slug}-{picture}-{view}.png" for picture in ("mask", "heat", "found")}
    Image.fromarray(masks[view].astype(np.uint8) * 255).save(out / names["mask"])
    (out / names["heat"]).write_bytes(client.picture("/query/attention", view=view, **parameters))
    overlay = ViewMask.overlay(_pixels((out / f"render-{view}.png").read_bytes()), masks[view])
    Image.fromarray(overlay).save(out / names["found"])
    return Finding(
        phrase=phrase,
        present=answer["present"],
        reason=answer["reason"],
        object=truth.name_of(masks) if truth else None,
        splats=answer["count"],
        score=best[0]["score"] if best else float("nan"),
        threshold=answer["threshold"]["value"],
        explanation=answer["threshold"]["explanation"],
        objects=client.get("/query/objects", **parameters)["objects"],
        query_ms=1e3 * (answer_time - begin),
        mask_ms=1e3 * mask_seconds,
        iou=truth.mean_iou(phrase, masks) if truth else None,
        pictures=names,
    )


def _pixels(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image)


def _lines(finding: Finding) -> list[str]:
    noun = f"the {finding.object}" if finding.object else "something"
    if finding.present is False:
        return [f'  "{finding.phrase}" finds nothing', f"      {finding.reason}"]
    bar = "no threshold" if finding.threshold is None else f"threshold {finding.threshold:.2f}"
    iou = "" if finding.iou is None else f", IoU {finding.iou:.2f} against the truth of views that were not lifted"
    lines = [
        f'  "{finding.phrase}": {noun}',
        f"      {finding.splats:,} splats, best score {finding.score:.2f}, {bar}, "
        f"{finding.query_ms:.0f} ms (mask {finding.mask_ms:.0f} ms){iou}",
    ]
    if finding.present is None:
        lines.append(f"      {finding.reason}")
    for number, item in enumerate(finding.objects, 1):
        place = ", ".join(f"{value:.2f}" for value in item["centre"])
        lines.append(f"      object {number}: {item['splats']:,} splats around ({place})")
    return [*lines, f"      {finding.pictures['found']}"]


# Content of a scene folder: splats, cameras, a feature pack, words, and labels if there are any

SHIPPED = Path(__file__).with_name("tabletop")
_CAMERA_FILES = ("cameras.json", "transforms.json", "cameras.zip")
_TABLE = "text_table.safetensors"
_ENCODERS = {space: encoder for encoder, space in BUILT_IN.items()}
_PHRASES = 3  # queries by default


@dataclass(frozen=True)
class Truth:
    """Labels of a scene."""

    names: tuple[str, ...]  # object names
    masks: Mapping[str, np.ndarray]  # view -> [H, W] integers, rows of names; -1 = none
    objects_of_phrases: Mapping[
        str, tuple[str, ...]
    ]  # phrase, no article -> names of its objects; empty if the scene has none
    phrases: tuple[str, ...]  # phrases to query

    def mask_of(self, phrase: str, view: str) -> np.ndarray | None:
        """Return [H, W] bool, True at the phrase's objects; None if the phrase or the view has no truth."""
        names = self.objects_of_phrases.get(_bare(phrase))
        if names is None or view not in self.masks:
            return None
        rows = [self.names.index(name) for name in names]
        return np.isin(self.masks[view], rows)

    def name_of(self, masks: Mapping[str, np.ndarray]) -> str | None:
        """Return the name of the object with most pixels in these masks [H, W] bool; None if there is none."""
        labels = np.concatenate([self.masks[view][mask] for view, mask in masks.items() if view in self.masks])
        objects = labels[labels >= 0]
        return self.names[int(np.bincount(objects).argmax())] if len(objects) else None

    def mean_iou(self, phrase: str, masks: Mapping[str, np.ndarray]) -> float | None:
        """Return the mean intersection over union of masks [H, W] bool, over the views with the phrase's objects."""
        pairs = [(mask, self.mask_of(phrase, view)) for view, mask in masks.items()]
        visible = [(mask, target) for mask, target in pairs if target is not None and target.any()]
        values = [(mask & target).sum() / (mask | target).sum() for mask, target in visible]
        return float(np.mean(values)) if values else None


@dataclass(frozen=True)
class DemoScene:
    """A scene ready for upload."""

    name: str
    splats: Path
    cameras: Path
    features: Path
    other_packs: tuple[str, ...]  # file names of other packs, which are not used
    encoder: str  # specification of the text encoder
    text_space: str  # of the features; "none" if no text encoder shares it, "" if unknown
    phrases: tuple[str, ...]  # empty: no text queries, or no words known
    views: tuple[str, ...]  # the view of the picture first; views with labels if there are any
    truth: Truth | None


def unpack_tabletop(folder: Path) -> Path:
    """Write the example as plain files: splats, cameras, a pack of 18 views, labels; return the folder.

    It is 12 published splat objects on a table. No photo went through CLIP: a region's vector is the text vector of
    its word with noise, moved so far from all words as vectors of photos are (cosine .29 to its own word, .22 to
    others). Of the masks 30 % are merged with a neighbour, 15 % split, 10 % of another word. Sources and licences are
    in ``tabletop/LICENCES.md``; what made the files is ``tests/benchmarks/demo_scene.py``.
    """
    import zstandard

    folder.mkdir(parents=True, exist_ok=True)
    for file in SHIPPED.iterdir():
        content = file.read_bytes()
        if file.suffix == ".zst":
            (folder / file.stem).write_bytes(zstandard.ZstdDecompressor().decompress(content))
        else:
            (folder / file.name).write_bytes(content)
    return folder


def find_scene(folder: Path, phrases: Sequence[str], scratch: Path, pack: Path | None = None) -> DemoScene:
    """Return a scene folder: files are found by name, a COLMAP model is zipped for the upload.

    Args:
        folder: holds splats (``.ply``, ``.sog``, ``.spz`` or ``.splat``), cameras (``cameras.json``,
            ``transforms.json``, ``sparse/0``) and a pack.
        phrases: of the queries; empty = those in ``truth.json``, else the three of its objects that fill most of the
            pictured view, and nothing where the features have no words.
        scratch: the folder for the zipped model.
        pack: the feature pack; None takes ``features.safetensors``, else the first by name.

    Raises:
        InvalidInput: something is missing, or there are no words to ask the phrases with; the error says what.
    """
    if not folder.is_dir():
        raise InvalidInput("--scene", expected="a folder", got=f"nothing at {folder}")
    truth = _read_truth(folder)
    cameras = _cameras(folder, scratch)
    packs = _packs(folder)
    table, features = folder / _TABLE, pack or packs[0]
    text_space = read_features(features).text_space
    askable = table.is_file() or text_space in (*_ENCODERS, OWN_WORDS)
    if phrases and not askable:
        raise InvalidInput(
            "--ask", expected=f"words in the space of the features, as {_TABLE} in {folder.name}",
            got=f"none, and features whose text space is {text_space or 'not named'}",
            hint="leave --ask out, and it is asked by example" if text_space == NO_WORDS
            else "or use 'splatlift lift' and 'splatlift query --encoder', which take any text encoder",
        )  # fmt: skip
    return DemoScene(
        name=folder.name,
        splats=_splats(folder),
        cameras=cameras,
        features=features,
        other_packs=tuple(path.name for path in packs if not path.exists() or path.resolve() != features.resolve()),
        encoder=f"table:{table}" if table.is_file() else _ENCODERS.get(text_space, next(iter(BUILT_IN))),
        text_space=text_space,
        phrases=tuple(phrases) or (truth.phrases if truth and askable and text_space != NO_WORDS else ()),
        views=tuple(truth.masks) if truth else _some_views(cameras),
        truth=truth,
    )


def _splats(folder: Path) -> Path:
    """Return the splats of a folder, or of the last iteration that a 3DGS trainer wrote."""
    kind = identify(folder)
    if not kind.accepted_over_http:
        got = f"{kind.splats[0]} alone" if kind.splats else "none"
        raise InvalidInput(f"splats of {folder.name}", expected="splats that the service takes", got=got)
    return folder / kind.accepted_over_http[0]


def _cameras(folder: Path, scratch: Path) -> Path:
    """Return the file of the cameras; a COLMAP model of several files as a zip in ``scratch``."""
    from liftcore.files import camera_files

    candidates = [folder / name for name in _CAMERA_FILES if (folder / name).is_file()]
    files = [file for file in camera_files(candidates[0] if candidates else folder) if file.is_file()]
    if not files:
        names = ", ".join([*_CAMERA_FILES, "sparse/0"])
        raise InvalidInput(f"cameras of {folder.name}", expected=f"one of {names}", got="none")
    if len(files) == 1:
        return files[0]
    scratch.mkdir(parents=True, exist_ok=True)
    packed = scratch / "cameras.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return packed


def _packs(folder: Path) -> list[Path]:
    """Return the feature packs of a folder, ``features.safetensors`` first."""
    packs = [path for path in visible_files(folder, "*.safetensors") if identify(path).kind == "features"]
    if not packs:
        raise InvalidInput(f"features of {folder.name}", expected="a feature pack (.safetensors)", got="none")
    return sorted(packs, key=lambda path: path.name != "features.safetensors")


def _read_truth(folder: Path) -> Truth | None:
    """Read ``truth.json`` (objects, queries, meaning of phrases) and ``truth.safetensors`` (``VIEW/mask``)."""
    from safetensors.numpy import load_file

    names_file, arrays_file = folder / "truth.json", folder / "truth.safetensors"
    if not (names_file.is_file() and arrays_file.is_file()):
        return None
    document = json.loads(names_file.read_text())
    arrays = load_file(arrays_file)
    names = tuple(str(item["class"]) for item in document["objects"])
    synonyms = {_bare(name): (name,) for name in names}
    masks = {key.removesuffix("/mask"): mask for key, mask in arrays.items() if key.endswith("/mask")}
    return Truth(
        names=names,
        masks={view: masks[view] for view in document.get("held_out_views", masks)},
        objects_of_phrases=synonyms
        | {_bare(phrase): tuple(item_names) for phrase, item_names in document.get("phrases", {}).items()},
        phrases=tuple(document.get("ask", [f"the {name}" for name in _in_view(names, masks, document)])),
    )


def _bare(phrase: str) -> str:
    """Return a phrase without its article, in lower case."""
    return re.sub(r"^(an?|the)\s+", "", phrase.strip().casefold())


def _in_view(names: Sequence[str], masks: Mapping[str, np.ndarray], document: Mapping) -> list[str]:
    """Return the names of the objects that fill most of the pictured view."""
    labels = next((masks[view] for view in document.get("held_out_views", masks) if view in masks), np.empty(0, int))
    counts = np.bincount(labels[(labels >= 0) & (labels < len(names))], minlength=len(names))
    return [names[int(row)] for row in np.argsort(-counts, kind="stable")[:_PHRASES] if counts[row]]


def _some_views(cameras: Path) -> tuple[str, ...]:
    from liftcore import read_cameras

    views = [camera.name for camera in read_cameras(cameras).values()]
    return (views[len(views) // 2],)
