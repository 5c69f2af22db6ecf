"""``splatlift demo``: run the main job through the real service, on the published example or on a scene of yours."""

from __future__ import annotations

import argparse
import io
import json
import re
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image

from liftcore import read_cameras, read_features
from liftcore.cli import Parser
from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.files import camera_files, identify, visible_files
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS

SHIPPED = Path(__file__).with_name("tabletop")
CAMERA_FILES = ("cameras.json", "transforms.json", "cameras.zip")
TABLE = "text_table.safetensors"
ENCODERS = {space: encoder for encoder, space in BUILT_IN.items()}
STOP_SECONDS = 20
LAST_CHARACTERS = 3_000  # of the service's log, after a failure
TIMEOUT = httpx.Timeout(600.0, connect=10.0)  # the first query loads an encoder


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    cameras = "cameras.json, transforms.json, cameras.zip or sparse/0"
    holds = f"its .ply, .sog, .spz or .splat; {cameras}; a feature pack; {TABLE} if any"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=f"a scene of yours ({holds}); else the shipped one")
    of_text = "what to look for; may be given several times"
    parser.add_argument("--ask", action="append", default=[], metavar="TEXT", help=of_text)
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
    scene = find_scene(options.scene or unpack_tabletop(out / "scene"), options.ask, out / "scene")
    with serving(data, scene.encoder, out / "service.log") as url:
        say(f"The service listens on {url}.")
        try:
            report = show(scene, url, out, say)
        except httpx.HTTPError as error:
            raise Unavailable("service", expected="an answer to each request", got=repr(error)) from None
    report |= {"seconds": round(time.perf_counter() - begin, 1), "out": str(out.resolve())}
    report["lift_file"] = str((data / "lifts" / f"{report['lift']}.safetensors").resolve())
    say(f"Pictures are in {report['out']}. All of it took {report['seconds']:.0f} s.")
    say(f"The lift is {report['lift_file']}")
    if options.json:
        print(json.dumps(report))
    return 0


@contextmanager
def serving(data: Path, encoder: str, log: Path) -> Iterator[str]:
    """Run ``splatlift serve`` on a free port during the block; yield its address."""
    options = ["--port", "0", "--data", str(data), "--encoder", encoder, "--json"]
    command = [sys.executable, "-m", "liftcore.cli", "serve", *options]
    with (
        log.open("wb") as stderr,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True) as server,
    ):
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            if not line:
                text = log.read_text(errors="replace")[-LAST_CHARACTERS:].strip()
                got = f"an early end; its last words: {text or 'not a word'}"
                raise Unavailable("service", expected="a service that starts", got=got)
            yield json.loads(line)["address"]
        finally:
            server.terminate()
            try:
                server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()


def client_of(url: str) -> httpx.Client:
    """Return a client of a service, which raises its problems as errors."""

    def require_success(response: httpx.Response) -> None:
        if response.is_error:
            response.read()
            raise error_of(response.json())

    hooks = {"response": [require_success]}  # a proxy of the environment is ignored
    return httpx.Client(base_url=url, timeout=TIMEOUT, trust_env=False, event_hooks=hooks)


def error_of(problem: dict[str, Any]) -> SplatliftError:
    """Return a problem of the service as an error."""
    kind = Unavailable if problem["status"] >= 500 else InvalidInput
    got, expected = problem.get("got", problem["detail"]), problem.get("expected", "success")
    return kind(problem.get("argument", "service"), expected=expected, got=got, hint=problem.get("hint", ""))


def wait_for_lift(client: httpx.Client, order: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Order a lift and wait; return the job and its lift."""
    job = client.post("/lift", json=order).json()
    while job["state"] in ("queued", "running"):
        time.sleep(0.25)
        job = client.get(f"/jobs/{job['id']}").json()
    if job["state"] == "failed":
        raise error_of(job["problem"])
    return job, client.get(f"/lifts/{job['id']}").json()


def show(scene: DemoScene, url: str, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Upload, lift and query; write pictures to ``out`` and sentences to ``say``; return the results."""
    with client_of(url) as client:
        files = {"splats": scene.splats, "cameras": scene.cameras, "features": scene.features}
        ids = {
            kind: client.put(f"/assets/{kind}", content=path.read_bytes()).json()["id"]
            for kind, path in files.items()
        }
        job, lift = wait_for_lift(client, ids | {"features": [ids["features"]]})
        took, view = job["ended"] - job["started"], scene.views[0]
        say(f"Lifted {lift['channels']} channels onto {lift['count']:,} splats in {took:.1f} s.")
        pictures = {"rgb": f"render-{view}.png", "pca": f"features-{view}.png"}
        for channel, name in pictures.items():
            parameters = {"lift": lift["id"], "view": view, "channel": channel}
            (out / name).write_bytes(client.get("/render", params=parameters).content)
        kind, phrases = "text", scene.phrases
        if not phrases:
            with Image.open(out / pictures["rgb"]) as picture:
                kind, phrases = "like", (f"{view}:{picture.width // 2},{picture.height // 2}",)
            say(
                f"  Nothing says what its words are, so it is asked for more of the middle of the view, {phrases[0]}."
            )
        # The first query opens the lift and is not timed.
        client.get("/query", params={"lift": lift["id"], kind: phrases[0], "threshold": "0"})
        findings = [ask(client, lift["id"], kind, phrase, scene, out, say) for phrase in phrases]
    names = ("count", "channels", "diagnostics")
    splats, channels, diagnostics = (lift[name] for name in names)
    return {
        "scene": scene.name, "lift": lift["id"], "splats": splats, "channels": channels, "views": lift["view_count"],
        "lift_seconds": took, "diagnostics": diagnostics, "view": view, "text_space": scene.text_space,
        "pictures": pictures, "phrases": findings,
    }  # fmt: skip


def ask(
    client: httpx.Client, lift: str, kind: str, phrase: str, scene: DemoScene, out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Ask one phrase: write its pictures, say what it selects, and return that."""
    parameters, view, truth = {"lift": lift, kind: phrase}, scene.views[0], scene.truth
    begin = time.perf_counter()
    answer = client.get("/query", params=parameters).json()
    middle = time.perf_counter()
    masks = {
        name: pixels(client.get("/query/mask", params=parameters | {"view": name}).content) > 0
        for name in scene.views
    }
    mask_ms = 1e3 * (time.perf_counter() - middle) / len(masks)
    slug = "-".join(re.findall(r"\w+", phrase.casefold()))
    names = {picture: f"{slug}-{picture}-{view}.png" for picture in ("mask", "heat", "found")}
    Image.fromarray(masks[view].astype(np.uint8) * 255).save(out / names["mask"])
    (out / names["heat"]).write_bytes(client.get("/query/attention", params=parameters | {"view": view}).content)
    shade = np.where(masks[view][..., None], 1.0, 0.35)
    Image.fromarray((pixels((out / f"render-{view}.png").read_bytes()) * shade).astype(np.uint8)).save(
        out / names["found"]
    )
    iou = truth.mean_iou(phrase, masks) if truth else None
    label, value = truth.name_of(masks) if truth else None, answer["threshold"]["value"]
    if answer["present"] is False:
        say(f'  "{phrase}" finds nothing\n      {answer["reason"]}')
    else:
        against = "" if iou is None else f", IoU {iou:.2f} against the truth of views that were not lifted"
        say(f'  "{phrase}": {f"the {label}" if label else "something"}')
        say(f"      {answer['count']:,} splats, {1e3 * (middle - begin):.0f} ms (mask {mask_ms:.0f} ms){against}")
        say(f"      {names['found']}")
    return {
        "phrase": phrase, "present": answer["present"], "reason": answer["reason"], "object": label,
        "splats": answer["count"], "score": answer["top"][0]["score"] if answer["top"] else None, "threshold": value,
        "explanation": answer["threshold"]["explanation"], "query_ms": 1e3 * (middle - begin), "mask_ms": mask_ms,
        "iou": iou, "pictures": names,
    }  # fmt: skip


def pixels(png: bytes) -> np.ndarray:
    """Return the pixels of a PNG."""
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image)


# Content of a scene folder: splats, cameras, a feature pack, words, and labels if there are any


@dataclass(frozen=True)
class Truth:
    """Labels of a scene."""

    names: tuple[str, ...]  # object names
    masks: Mapping[str, np.ndarray]  # view -> [H, W] integers, rows of names; -1 = none
    objects_of_phrases: Mapping[str, Sequence[str]]  # phrase without article -> names of its objects

    def name_of(self, masks: Mapping[str, np.ndarray]) -> str | None:
        """Return the name of the object with most pixels in these masks [H, W] bool; None if there is none."""
        labels = np.concatenate([self.masks[view][mask] for view, mask in masks.items()])
        counts = np.bincount(labels[labels >= 0], minlength=1)
        return self.names[int(counts.argmax())] if counts.any() else None

    def mean_iou(self, phrase: str, masks: Mapping[str, np.ndarray]) -> float | None:
        """Return the mean intersection over union of masks [H, W] bool, over the views with the phrase's objects."""
        names = self.objects_of_phrases.get(bare(phrase), ())
        rows = [self.names.index(name) for name in names]
        targets = {view: np.isin(self.masks[view], rows) for view in masks}
        pairs = [(mask, targets[view]) for view, mask in masks.items() if targets[view].any()]
        values = [(mask & target).sum() / (mask | target).sum() for mask, target in pairs]
        return float(np.mean(values)) if values else None


def bare(phrase: str) -> str:
    """Return a phrase without its article, in lower case."""
    return re.sub(r"^(an?|the)\s+", "", phrase.strip().casefold())


@dataclass(frozen=True)
class DemoScene:
    """A scene ready for upload."""

    name: str
    splats: Path
    cameras: Path
    features: Path
    encoder: str  # specification of the text encoder
    text_space: str  # of the features; "none" if no text encoder shares it, "" if unknown
    phrases: tuple[str, ...]  # empty: no text queries, or no words known
    views: tuple[str, ...]  # the view of the picture first; views with labels if there are any
    truth: Truth | None


def unpack_tabletop(folder: Path) -> Path:
    """Write the example as plain files: splats, cameras, a pack of 18 views, labels; return the folder.

    It is 12 published splat objects on a table. No photo went through CLIP: a region's vector is the text vector of
    its word with noise, moved so far from all words as vectors of photos are. Of the masks 30 % are merged with a
    neighbour, 15 % split, 10 % of another word. What made the files is
    ``tests/benchmarks/demo_scene.py`` at 3229a850.
    """
    import zstandard

    folder.mkdir(parents=True, exist_ok=True)
    for file in SHIPPED.iterdir():
        content, is_packed = file.read_bytes(), file.suffix == ".zst"
        name = file.stem if is_packed else file.name
        (folder / name).write_bytes(zstandard.ZstdDecompressor().decompress(content) if is_packed else content)
    return folder


def find_scene(folder: Path, phrases: Sequence[str], scratch: Path) -> DemoScene:
    """Return a scene folder: files are found by their content, a COLMAP model is zipped into ``scratch``.

    Without phrases those in ``truth.json`` are asked.
    """
    if not folder.is_dir():
        raise InvalidInput("--scene", expected="a folder", got=f"nothing at {folder}")
    splats = identify(folder).accepted_over_http
    packs = [path for path in visible_files(folder, "*.safetensors") if identify(path).kind == "features"]
    for kind, paths in (("features", packs), ("splats", splats)):
        if not paths:
            expected = f"{kind} that the service takes"
            raise InvalidInput(f"{kind} of {folder.name}", expected=expected, got="none")
    features = min(packs, key=lambda path: (path.name != "features.safetensors", path.name))
    cameras, table, truth = find_cameras(folder, scratch), folder / TABLE, read_truth(folder)
    text_space = read_features(features).text_space
    is_askable = table.is_file() or text_space in (*ENCODERS, OWN_WORDS)
    if phrases and not is_askable:
        got = f"none, and features whose text space is {text_space or 'not named'}"
        expected = f"words in the space of the features, as {TABLE} in {folder.name}"
        raise InvalidInput("--ask", expected=expected, got=got, hint="leave --ask out, and it is asked by example")
    if truth is not None and not phrases and is_askable and text_space != NO_WORDS:
        phrases = json.loads((folder / "truth.json").read_text()).get("ask", [f"the {truth.names[0]}"])
    views = list(truth.masks) if truth else [camera.name for camera in read_cameras(cameras).values()]
    encoder = f"table:{table}" if table.is_file() else ENCODERS.get(text_space, next(iter(BUILT_IN)))
    return DemoScene(
        folder.name, folder / splats[0], cameras, features, encoder, text_space, tuple(phrases), tuple(views), truth
    )


def find_cameras(folder: Path, scratch: Path) -> Path:
    """Return the file of the cameras; a COLMAP model of several files as a zip in ``scratch``."""
    candidates = [folder / name for name in CAMERA_FILES if (folder / name).is_file()]
    files = [file for file in camera_files(candidates[0] if candidates else folder) if file.is_file()]
    if not files:
        names = ", ".join([*CAMERA_FILES, "sparse/0"])
        raise InvalidInput(f"cameras of {folder.name}", expected=f"one of {names}", got="none")
    if len(files) == 1:
        return files[0]
    scratch.mkdir(parents=True, exist_ok=True)
    packed = scratch / "cameras.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return packed


def read_truth(folder: Path) -> Truth | None:
    """Read ``truth.json`` (objects, meaning of phrases) and ``truth.safetensors`` (``VIEW/mask``), if any."""
    from safetensors.numpy import load_file

    names_file, arrays_file = folder / "truth.json", folder / "truth.safetensors"
    if not (names_file.is_file() and arrays_file.is_file()):
        return None
    document = json.loads(names_file.read_text())
    names = tuple(str(item["class"]) for item in document["objects"])
    masks = {name.removesuffix("/mask"): mask for name, mask in load_file(arrays_file).items()}
    phrases = {bare(name): (name,) for name in names}
    phrases |= {bare(phrase): tuple(objects) for phrase, objects in document.get("phrases", {}).items()}
    return Truth(names, {view: masks[view] for view in document.get("held_out_views", masks)}, phrases)
