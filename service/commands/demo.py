"""``splatlift demo``: run the main job through the real service, on the published example."""

from __future__ import annotations

import argparse
import io
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image

from liftcore.cli import Parser
from liftcore.errors import Unavailable
from service.errors import Fault

SHIPPED = Path(__file__).with_name("tabletop")
FILES = {"splats": "point_cloud.spz", "cameras": "cameras.json", "features": "features.safetensors"}
STOP_SECONDS = 20
LAST_CHARACTERS = 3_000  # of the service's log, after a failure
TIMEOUT = httpx.Timeout(600.0, connect=10.0)  # the first query loads an encoder


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    of_text = "what to look for; may be given several times"
    parser.add_argument("--ask", action="append", default=[], metavar="TEXT", help=of_text)
    parser.add_argument("--out", type=Path, default=Path("demo-output"), metavar="DIR", help="of pictures and lift")


def run(options: argparse.Namespace) -> int:
    """Run the service as a user would, and report the results."""

    def say(line: str) -> None:
        if not options.json:
            print(line, flush=True)

    begin, out, data = time.perf_counter(), options.out, options.out / "service"
    out.mkdir(parents=True, exist_ok=True)
    say("12 published splat objects on a table (sources: scene/LICENCES.md), with CLIP's vectors of words.")
    folder = unpack_tabletop(out / "scene")
    with serving(data, out / "service.log") as url:
        say(f"The service listens on {url}.")
        try:
            report = show(folder, options.ask, url, out, say)
        except httpx.HTTPError as error:
            raise Unavailable("service", expected="an answer to each request", got=repr(error)) from None
    report |= {"out": str(out.resolve()), "seconds": round(time.perf_counter() - begin, 1)}
    report["lift_file"] = str((data / "lifts" / f"{report['lift']}.safetensors").resolve())
    say(f"Pictures are in {report['out']}. All of it took {report['seconds']:.0f} s.")
    say(f"The lift is {report['lift_file']}")
    if options.json:
        print(json.dumps(report))
    return 0


@contextmanager
def serving(data: Path, log: Path) -> Iterator[str]:
    """Run ``splatlift serve`` on a free port during the block; yield its address."""
    command = [sys.executable, "-m", "liftcore.cli", "serve", "--port", "0", "--data", str(data), "--json"]
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
            require_no(response.json())

    hooks = {"response": [require_success]}  # a proxy of the environment is ignored
    return httpx.Client(base_url=url, timeout=TIMEOUT, trust_env=False, event_hooks=hooks)


def require_no(problem: dict[str, Any] | None) -> None:
    """Raise a problem of the service as an error."""
    if problem is not None:
        raise Fault(problem)


def lift_files(client: httpx.Client, files: Mapping[str, Path]) -> tuple[dict[str, Any], float]:
    """Upload files by their kinds, lift, and wait; return the lift, and its seconds."""
    order: dict[str, Any] = {
        kind: client.put(f"/assets/{kind}", content=path.read_bytes()).json()["id"] for kind, path in files.items()
    }
    job = client.post("/lift", json=order | {"features": [order["features"]]}).json()
    while job["state"] in ("queued", "running"):
        time.sleep(0.25)
        job = client.get(f"/jobs/{job['id']}").json()
    require_no(job["problem"])
    return client.get(f"/lifts/{job['id']}").json(), job["ended"] - job["started"]


def show(folder: Path, phrases: Sequence[str], url: str, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Upload, lift and query; write pictures to ``out`` and sentences to ``say``; return the results.

    Without phrases those of the truth are asked.
    """
    truth = read_truth(folder)
    with client_of(url) as client:
        lift, took = lift_files(client, {kind: folder / name for kind, name in FILES.items()})
        views = tuple(truth.masks)
        say(f"Lifted {lift['channels']} channels onto {lift['count']:,} splats in {took:.1f} s.")
        picture = f"render-{views[0]}.png"
        render = client.get("/render", params={"lift": lift["id"], "view": views[0]})
        (out / picture).write_bytes(render.content)
        phrases = phrases or truth.questions
        findings = [ask(client, lift["id"], phrase, truth, out, say) for phrase in phrases]
    return {
        "lift": lift["id"], "splats": lift["count"], "channels": lift["channels"], "views": lift["view_count"],
        "lift_seconds": took, "diagnostics": lift["diagnostics"], "view": views[0], "picture": picture,
        "phrases": findings,
    }  # fmt: skip


def ask(
    client: httpx.Client, lift: str, phrase: str, truth: Truth, out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Ask one phrase: write its pictures, say what it selects, and return that."""
    parameters, view = {"lift": lift, "text": phrase}, next(iter(truth.masks))
    answer = client.get("/query", params=parameters).json()
    masks = {
        name: pixels(client.get("/query/mask", params=parameters | {"view": name}).content) > 0
        for name in truth.masks
    }
    slug = "-".join(re.findall(r"\w+", phrase.casefold()))
    names = {picture: f"{slug}-{picture}-{view}.png" for picture in ("heat", "found")}
    (out / names["heat"]).write_bytes(client.get("/query/attention", params=parameters | {"view": view}).content)
    shade = np.where(masks[view][..., None], 1.0, 0.35)
    picture = pixels((out / f"render-{view}.png").read_bytes()) * shade
    Image.fromarray(picture.astype(np.uint8)).save(out / names["found"])
    iou = truth.mean_iou(phrase, masks)
    if answer["present"] is False:
        say(f'  "{phrase}" finds nothing\n      {answer["reason"]}')
    else:
        against = "" if iou is None else f", IoU {iou:.2f} against the truth of views that were not lifted"
        say(f'  "{phrase}": {answer["count"]:,} splats{against}\n      {names["found"]}')
    return {
        "phrase": phrase, "present": answer["present"], "reason": answer["reason"], "splats": answer["count"],
        "threshold": answer["threshold"]["value"], "iou": iou, "pictures": names,
    }  # fmt: skip


def pixels(png: bytes) -> np.ndarray:
    """Return the pixels of a PNG."""
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image)


# The example


@dataclass(frozen=True)
class Truth:
    """Labels of a scene."""

    names: tuple[str, ...]  # object names
    masks: Mapping[str, np.ndarray]  # view -> [H, W] integers, rows of names; -1 = none
    questions: tuple[str, ...]  # phrases that show what it can do

    def mean_iou(self, phrase: str, masks: Mapping[str, np.ndarray]) -> float | None:
        """Return the mean intersection over union of masks [H, W] bool, over the views with the object named so."""
        name = re.sub(r"^(an?|the)\s+", "", phrase.casefold())
        rows = [row for row, other in enumerate(self.names) if other == name]
        targets = {view: np.isin(self.masks[view], rows) for view in masks}
        pairs = [(mask, targets[view]) for view, mask in masks.items() if targets[view].any()]
        values = [(mask & target).sum() / (mask | target).sum() for mask, target in pairs]
        return float(np.mean(values)) if values else None


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


def read_truth(folder: Path) -> Truth:
    """Read ``truth.json`` (objects, meaning of phrases) and ``truth.safetensors`` (``VIEW/mask``)."""
    from safetensors.numpy import load_file

    document, masks = json.loads((folder / "truth.json").read_text()), load_file(folder / "truth.safetensors")
    names = tuple(item["class"] for item in document["objects"])
    views = {view: masks[f"{view}/mask"] for view in document["held_out_views"]}
    return Truth(names, views, tuple(document["ask"]))
