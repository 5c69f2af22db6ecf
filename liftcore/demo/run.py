"""`splatlift demo`: a scene through the real service, three questions in plain words, pictures of the answers."""

from __future__ import annotations

import io
import json
import sys
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from liftcore.demo.client import Client, Server
from liftcore.demo.scene_folder import DemoScene, Truth, find_scene
from liftcore.demo.write_scene import write_still_life
from liftcore.query.render import overlay
from liftcore.query.text import NO_WORDS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from liftcore.demo.still_life import StillLife

_TOLD = ("splats", "views", "channels")  # counts of an upload that people care about
_NAMING = 200  # best splats that vote on the name of what was found


@dataclass(frozen=True)
class Finding:
    """What one phrase found."""

    phrase: str
    object: str | None  # the object that most of the best splats belong to, where somebody knows
    splats: int  # selected
    score: float  # the best cosine
    threshold: float | None  # on the splats' scores
    explanation: str
    objects: list[dict[str, Any]]  # the things found, with their places
    query_ms: float
    mask_ms: float  # the mean over views, query excluded
    iou: float | None  # the mean over views with truth
    pictures: dict[str, str]  # what -> file name


def run_demo(
    scene: Path | None,
    out: Path,
    as_json: bool,
    phrases: Sequence[str] = (),
    generated: StillLife | None = None,
) -> int:
    """Run the demo and say what was found.

    Args:
        scene: a scene folder; None = the still life, generated.
        out: where the pictures go, and the service's data with the lift.
        as_json: print one JSON object on stdout and nothing else.
        phrases: what to look for; empty = three phrases that suit the scene, none if its features have no words.
        generated: the still life to take in place of the usual one.

    Returns:
        The exit status, 0.

    Raises:
        InvalidInput: the scene folder lacks something, or the service refused it.
        Unavailable: the service or the text encoder does not start.
    """
    begin = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    say = _Voice(quiet=as_json)
    if scene is None:
        say.line("Making a still life: a table, a mug, a bowl of fruit, a book, a lamp and a plant.")
        subject = write_still_life(out / "scene", phrases, generated)
    else:
        subject = find_scene(scene, phrases, out / "scene")
    data = out / "service"
    with Server(data, subject.encoder) as server:
        try:
            report = _converse(subject, server.url, out, say)
        except BaseException:
            print(f"--- the service's last words ---\n{server.log_tail}", file=sys.stderr)
            raise
    report["seconds"] = round(time.perf_counter() - begin, 1)
    report["out"] = str(out.resolve())
    report["lift_file"] = str((data / "lifts" / f"{report['lift']}.safetensors").resolve())
    if as_json:
        print(json.dumps(report))
    else:
        say.line(f"Pictures are in {report['out']}. All of it took {report['seconds']:.0f} s.")
        say.line(f"The lift is {report['lift_file']}")
    return 0


def _converse(subject: DemoScene, url: str, out: Path, say: _Voice) -> dict[str, Any]:
    say.line(f"The service listens on {url}.")
    client = Client(url)
    try:
        assets = {
            kind: client.upload(kind, path)
            for kind, path in (
                ("splats", subject.splats), ("cameras", subject.cameras), ("features", subject.features)
            )
        }  # fmt: skip
        say.line(f"Uploaded {', '.join(_counts(kind, asset) for kind, asset in assets.items())}.")
        order = {kind: assets[kind]["id"] for kind in ("splats", "cameras")}
        job, lift = client.lift({**order, "features": [assets["features"]["id"]]}, say.progress)
        took = (job["ended"] or 0) - (job["started"] or 0)
        say.line(f"Lifted {lift['channels']} channels onto {lift['count']:,} splats in {took:.1f} s.")
        pictures = _save_renders(client, lift["id"], subject.views[0], out)
        if not subject.phrases:
            say.line(_silence(subject, pictures))
        else:
            # The first question opens the lift; it is asked once apart, so that times are of warm queries.
            client.ask(lift["id"], subject.phrases[0], threshold="0")
        findings = []
        for phrase in subject.phrases:
            findings.append(_find(client, lift["id"], phrase, subject, out))
            say.finding(findings[-1])
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


def _save_renders(client: Client, lift: str, view: str, out: Path) -> dict[str, str]:
    """The colours and the features of the pictured view; what -> file name."""
    names = {"rgb": f"render-{view}.png", "pca": f"features-{view}.png"}
    for what, name in names.items():
        content, _ = client.picture("/render", lift=lift, view=view, what=what)
        (out / name).write_bytes(content)
    return names


def _silence(subject: DemoScene, pictures: dict[str, str]) -> str:
    """Why nothing is asked, and what to look at instead."""
    if subject.text_space == NO_WORDS:
        why = "Its features share a space with no text encoder: they have no words, so no phrase is asked."
    else:
        why = "Nothing says what this scene shows, so no phrase is asked; `--ask TEXT` asks yours."
    return f"  {why}\n      {pictures['pca']} shows three principal components of the features as colours."


def _counts(kind: str, asset: dict[str, Any]) -> str:
    numbers = ", ".join(f"{value} {name}" for name, value in asset["counts"].items() if name in _TOLD)
    return f"{kind} ({numbers})" if numbers else kind


def _find(client: Client, lift: str, phrase: str, subject: DemoScene, out: Path) -> Finding:
    answer, query_ms = client.ask(lift, phrase, top=str(_NAMING))
    masks, times = {}, []
    for view in subject.views:
        content, milliseconds = client.picture("/query/mask", lift=lift, text=phrase, view=view)
        masks[view] = _pixels(content) > 0
        times.append(milliseconds)
    best = answer["top"]
    return Finding(
        phrase=phrase,
        object=_name([entry["splat"] for entry in best], subject.truth),
        splats=answer["count"],
        score=best[0]["score"] if best else float("nan"),
        threshold=answer["threshold"]["value"],
        explanation=answer["threshold"]["explanation"],
        objects=client.objects(lift, phrase),
        query_ms=query_ms,
        mask_ms=sum(times) / len(times),
        iou=_mean_iou(phrase, masks, subject.truth),
        pictures=_save_pictures(client, lift, phrase, masks[subject.views[0]], (subject.views[0], out)),
    )


def _save_pictures(
    client: Client, lift: str, phrase: str, mask: np.ndarray, place: tuple[str, Path]
) -> dict[str, str]:
    view, out = place
    heat, _ = client.picture("/query/attention", lift=lift, text=phrase, view=view)
    image = _pixels((out / f"render-{view}.png").read_bytes())
    slug = "-".join("".join(c if c.isalnum() else " " for c in phrase.casefold()).split())
    names = {what: f"{slug}-{what}-{view}.png" for what in ("mask", "heat", "found")}
    Image.fromarray(mask.astype(np.uint8) * 255).save(out / names["mask"])
    (out / names["heat"]).write_bytes(heat)
    Image.fromarray(overlay(image, mask)).save(out / names["found"])
    return names


def _pixels(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image)


def _name(splats: Sequence[int], truth: Truth | None) -> str | None:
    if truth is None or not splats:
        return None
    objects = truth.splat_objects[np.array(splats)]
    known = objects[objects >= 0]
    return truth.names[int(np.bincount(known).argmax())] if len(known) else None


def _mean_iou(phrase: str, masks: dict[str, np.ndarray], truth: Truth | None) -> float | None:
    """Mean intersection over union over the views that show what the phrase means."""
    values = []
    for view, mask in masks.items():
        meant = None if truth is None else truth.mask_of(phrase, view)
        if meant is not None and meant.any():
            values.append(float((mask & meant).sum() / (mask | meant).sum()))
    return sum(values) / len(values) if values else None


class _Voice:
    """What the demo says: lines on stdout unless JSON goes there, progress on a terminal's stderr."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._live = sys.stderr.isatty()

    def line(self, text: str) -> None:
        if not self._quiet:
            print(text, flush=True)

    def progress(self, job: dict[str, Any]) -> None:
        if not self._live:
            return
        step = job.get("progress") or {}
        parts = f" {step['done']}/{step['total']} {step['unit']}" if step and step["total"] > 1 else ""
        done = f"{step['stage']}{parts}" if step else ""
        text = f"{job['state']}  {done}" if job["state"] in ("queued", "running") else ""
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def finding(self, found: Finding) -> None:
        what = f"the {found.object}" if found.object else "something"
        bar = "no threshold" if found.threshold is None else f"threshold {found.threshold:.2f}"
        iou = "" if found.iou is None else f", IoU {found.iou:.2f} against the truth of views that were not lifted"
        self.line(f'  "{found.phrase}": {what}')
        self.line(
            f"      {found.splats:,} splats, best score {found.score:.2f}, {bar}, "
            f"{found.query_ms:.0f} ms (mask {found.mask_ms:.0f} ms){iou}"
        )
        for number, thing in enumerate(found.objects, 1):
            place = ", ".join(f"{value:.2f}" for value in thing["centre"])
            self.line(f"      object {number}: {thing['splats']:,} splats around ({place})")
        self.line(f"      {found.pictures['found']}")
