"""What `splatlift demo` asks of a service and shows: an upload, a lift, questions, pictures of the answers."""

from __future__ import annotations

import io
import os
import sys
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
from PIL import Image

from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.query.render import overlay
from liftcore.text import NO_WORDS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from liftcore.demo.scene_folder import DemoScene

POLL_SECONDS = 0.25
TIMEOUT = httpx.Timeout(600.0, connect=10.0)  # the first query loads an encoder
ENDED = ("succeeded", "failed", "canceled")


class Client:
    """A conversation with a service on this machine. Answers of 4xx and 5xx become errors with the service's words.

    Raises:
        InvalidInput: the service refused a request.
        Unavailable: it cannot be reached, or failed itself.
    """

    def __init__(self, url: str) -> None:
        key = os.environ.get("SPLATLIFT_KEY")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        # A proxy of the environment has no part in it.
        self._http = httpx.Client(base_url=url, timeout=TIMEOUT, trust_env=False, headers=headers)

    def close(self) -> None:
        """End the conversation."""
        self._http.close()

    def upload(self, kind: str, path: Path) -> dict[str, Any]:
        """``PUT /assets/KIND``: the asset, with its id and counts."""
        with path.open("rb") as file:
            return self._call("PUT", f"/assets/{kind}", content=file).json()

    def lift(
        self, order: dict[str, Any], progress: Callable[[dict[str, Any]], None]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """``POST /lift`` and wait: the ended job and its lift."""
        job = self._call("POST", "/lift", json=order).json()
        while job["state"] not in ENDED:
            progress(job)
            time.sleep(POLL_SECONDS)
            job = self.get(f"/jobs/{job['id']}")
        progress(job)
        if job["state"] != "succeeded":
            raise _refusal("lift", job.get("problem") or {}, job["state"])
        return job, self.get(f"/lifts/{job['id']}")

    def get(self, path: str, **parameters: str) -> dict[str, Any]:
        """The JSON of any route."""
        return self._call("GET", path, params=parameters).json()

    def picture(self, path: str, **parameters: str) -> bytes:
        """A PNG of the service."""
        return self._call("GET", path, params=parameters).content

    def _call(self, method: str, path: str, **how: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **how)
        except httpx.HTTPError as error:
            raise Unavailable("service", expected=f"an answer to {method} {path}", got=repr(error)) from None
        if response.is_success:
            return response
        kind = response.headers.get("content-type", "")
        problem = response.json() if "json" in kind else {"detail": response.text[:200]}
        raise _refusal(f"{method} {path}", problem, str(response.status_code))


def _refusal(what: str, problem: dict[str, Any], status: str) -> SplatliftError:
    """The service's problem as an error of ours: field by field where it has the fields, else its sentence."""
    kind = Unavailable if problem.get("status", 0) >= 500 else InvalidInput
    if problem.get("expected") and problem.get("got"):
        argument = problem.get("argument") or what
        return kind(argument, expected=problem["expected"], got=problem["got"], hint=problem.get("hint") or "")
    return kind(what, expected="success", got=problem.get("detail") or problem.get("title") or status)


@dataclass(frozen=True)
class Finding:
    """What one phrase found."""

    phrase: str
    there: bool | None  # whether the scene has it; None: not known, or not sure
    why: str  # how that is known
    object: str | None  # what the masks show most of, where somebody knows
    splats: int  # selected
    score: float  # the best cosine
    threshold: float | None  # on the splats' scores
    explanation: str
    objects: list[dict[str, Any]]  # the things found, with their places
    query_ms: float
    mask_ms: float  # the mean over views, query excluded
    iou: float | None  # the mean over views with truth
    pictures: dict[str, str]  # what -> file name


def show(subject: DemoScene, url: str, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Upload, lift and ask; pictures go to ``out``, sentences to ``say``.

    Returns:
        What was done and found, as plain numbers.

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
        for what, name in pictures.items():
            (out / name).write_bytes(client.picture("/render", lift=lift["id"], view=subject.views[0], what=what))
        kind, asked = "text", subject.phrases
        if not asked:
            kind, asked = "like", (_middle(out / pictures["rgb"], subject.views[0]),)
            for line in _why_no_words(subject, asked[0]):
                say(line)
        # The first question opens the lift; it is asked once apart, so that times are of warm queries.
        client.get("/query", lift=lift["id"], **{kind: asked[0]}, threshold="0")
        findings = []
        for phrase in asked:
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
        "certificate": lift["certificate"],
        "view": subject.views[0],
        "text_space": subject.text_space,
        "pictures": pictures,
        "phrases": [asdict(finding) for finding in findings],
    }


def _counts(kind: str, asset: dict[str, Any]) -> str:
    told = ("splats", "views", "channels")  # counts that people care about
    numbers = ", ".join(f"{value} {name}" for name, value in asset["counts"].items() if name in told)
    return f"{kind} ({numbers})" if numbers else kind


def _show_progress(job: dict[str, Any]) -> None:
    if not sys.stderr.isatty():
        return
    step = job.get("progress") or {}
    parts = f" {step['done']}/{step['total']} {step['unit']}" if step and step["total"] > 1 else ""
    text = f"{job['state']}  {step['stage'] if step else ''}{parts}" if job["state"] not in ENDED else ""
    print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _middle(render: Path, view: str) -> str:
    """The pixel in the middle of a view, as an example of what to look for."""
    with Image.open(render) as picture:
        return f"{view}:{picture.width // 2},{picture.height // 2}"


def _why_no_words(subject: DemoScene, example: str) -> list[str]:
    if subject.text_space == NO_WORDS:
        why = "Its features share a space with no text encoder: they have no words"
    elif not subject.text_space:
        why = "Its pack does not name its text space (`splatlift pack retag` does)"
    else:
        why = "Nothing says what this scene shows (`--ask TEXT` asks in words)"
    return [f"  {why}, so it is asked for more of what the middle of the view shows, {example}."]


def _find(client: Client, lift: str, kind: str, phrase: str, subject: DemoScene, out: Path) -> Finding:
    asked = {"lift": lift, kind: phrase}
    begin = time.perf_counter()
    answer = client.get("/query", **asked)
    answered = time.perf_counter()
    masks = {view: _pixels(client.picture("/query/mask", view=view, **asked)) > 0 for view in subject.views}
    mask_seconds = (time.perf_counter() - answered) / len(masks)
    view, best, truth = subject.views[0], answer["top"], subject.truth
    slug = "-".join("".join(c if c.isalnum() else " " for c in phrase.casefold()).split())
    names = {what: f"{slug}-{what}-{view}.png" for what in ("mask", "heat", "found")}
    Image.fromarray(masks[view].astype(np.uint8) * 255).save(out / names["mask"])
    (out / names["heat"]).write_bytes(client.picture("/query/attention", view=view, **asked))
    seen = overlay(_pixels((out / f"render-{view}.png").read_bytes()), masks[view])
    Image.fromarray(seen).save(out / names["found"])
    return Finding(
        phrase=phrase,
        there=answer["present"],
        why=answer["why"],
        object=truth.name_of(masks) if truth else None,
        splats=answer["count"],
        score=best[0]["score"] if best else float("nan"),
        threshold=answer["threshold"]["value"],
        explanation=answer["threshold"]["explanation"],
        objects=client.get("/query/objects", **asked)["objects"],
        query_ms=1e3 * (answered - begin),
        mask_ms=1e3 * mask_seconds,
        iou=truth.mean_iou(phrase, masks) if truth else None,
        pictures=names,
    )


def _pixels(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image)


def _lines(found: Finding) -> list[str]:
    what = f"the {found.object}" if found.object else "something"
    if found.there is False:
        return [f'  "{found.phrase}" finds nothing', f"      {found.why}"]
    bar = "no threshold" if found.threshold is None else f"threshold {found.threshold:.2f}"
    iou = "" if found.iou is None else f", IoU {found.iou:.2f} against the truth of views that were not lifted"
    lines = [
        f'  "{found.phrase}": {what}',
        f"      {found.splats:,} splats, best score {found.score:.2f}, {bar}, "
        f"{found.query_ms:.0f} ms (mask {found.mask_ms:.0f} ms){iou}",
    ]
    if found.there is None:
        lines.append(f"      {found.why}")
    for number, thing in enumerate(found.objects, 1):
        place = ", ".join(f"{value:.2f}" for value in thing["centre"])
        lines.append(f"      object {number}: {thing['splats']:,} splats around ({place})")
    return [*lines, f"      {found.pictures['found']}"]
