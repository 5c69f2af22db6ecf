"""Waiting times of a browser on the page: the first picture, the script of moving the cut, and the whole journey.

``python -m tests.benchmarks.page [--shared DIR]`` prints seconds until the first picture, which the service makes,
and until the splats are drawn, by software here: of the tiny scene and of a room of 180,000 splats (plush of the
shared data, or random ones of its spread where it is not there). Then milliseconds of moving the cut on the tiny
scene's page, into which scenes of random splats are loaded; drawing is not counted there.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
from safetensors.numpy import save

from tests.browser.conftest import browsing, serving
from tests.browser.looking import READY
from tests.server import wait_for_end
from tests.tiny_scene import PROPERTIES, cameras_json, make_scene, ply

ROOM_SPLATS = 180_000  # splats
OPENINGS = 3  # of each scene: the first meets a service that just began
LATER = 10  # seconds within which a service has loaded its kernels
STAGE_READY = f"{READY} && document.querySelector('#stage').classList.contains('ready')"
POSTER = "document.querySelector('#poster')?.naturalWidth && !document.querySelector('#poster').hidden"
PICTURE = f"({POSTER}) || ({STAGE_READY})"  # the service's, which stands there until the splats are drawn
MARKS = """(() => {
  const [page] = performance.getEntriesByType('navigation');
  const [splats] = performance.getEntriesByType('resource').filter(({ name }) => name.endsWith('/splats'));
  const { requestStart: asked, responseStart: first, responseEnd: last, decodedBodySize: size } = splats;
  return { asked, first, last, megabytes: size / 1e6 };
})()"""

SIZES = (166_000, 2_000_000, 2_500_000)  # the page draws two million at most
MOVES = 9
SCENE = """(async count => {
  const bytes = new Uint8Array(32 * count), floats = new Float32Array(bytes.buffer);
  for (let row = 0; row < count; row += 1) {
    for (let at = 0; at < 6; at += 1) floats[8 * row + at] = at < 3 ? Math.random() - 0.5 : 0.002;
    bytes.set([200, 180, 90, 255, 255, 128, 128, 128], 32 * row + 24);
  }
  const begun = performance.now();
  await splatlift.viewer.load(bytes);
  const loaded = performance.now() - begun;
  const scores = Float32Array.from({ length: count }, Math.random);
  const bins = new Uint32Array(96).fill(1);
  const question = { ...splatlift.query.current, scores, low: 0, high: 1, cut: 0.5, bins, objects: [] };
  splatlift.query.questions = [question];
  const laid = performance.now();
  splatlift.query.setThreshold(0.5);
  const first = performance.now() - laid;
  const moves = [];
  for (let move = 0; move < MOVES; move += 1) {
    const from = performance.now();
    splatlift.query.setThreshold(0.1 + 0.08 * move);
    moves.push(performance.now() - from);
  }
  clearTimeout(splatlift.query.objectsTimer);
  return { loaded, first, moves, drawn: splatlift.viewer.count, of: splatlift.viewer.total };
})""".replace("MOVES", str(MOVES))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"), help="where plush is")
    options = parser.parse_args()
    tiny, room_scene = make_scene(), room_of(options.shared / "plush")
    with tempfile.TemporaryDirectory() as folder:
        first_pictures("the tiny scene", (tiny.splats, tiny.cameras, tiny.features), Path(folder) / "tiny")
        first_pictures("a room", room_scene, Path(folder) / "room")
        moves_of_the_cut(Path(folder) / "cut")


def room_of(plush: Path) -> tuple[bytes, bytes, bytes]:
    """Splats, cameras and a small pack of two views: what is waited for is the splats."""
    if plush.is_dir():
        splats, cameras = (plush / "point_cloud.ply").read_bytes(), (plush / "cameras.json").read_bytes()
        views = [record["img_name"].rsplit(".", 1)[0] for record in json.loads(cameras)[:2]]
    else:
        rng, rows = np.random.default_rng(0), np.zeros((ROOM_SPLATS, len(PROPERTIES)), np.float32)
        rows[:, :3] = rng.normal(0, [1, 0.8, 0.5], (ROOM_SPLATS, 3)) - [0, 0, 4]
        rows[:, 3:6], rows[:, 7:10], rows[:, 10] = rng.normal(0, 1, (ROOM_SPLATS, 3)), np.log(0.02), 1
        splats, cameras, views = ply(rows), cameras_json(), ["left", "right"]
    grid = np.eye(8, dtype=np.float32)[np.arange(12) % 8].reshape(3, 4, 8)
    pack = save({f"{view}/grid": grid for view in views}, metadata={"encoder": "by hand", "text_space": "none"})
    return splats, cameras, pack


def first_pictures(name: str, files: tuple[bytes, bytes, bytes], folder: Path) -> None:
    """Print the seconds from the address to the drawn picture: of a service that just began, then of one at rest."""
    with serving(folder / "data") as (address, _):
        splats = lift_at(address, files)
    with serving(folder / "data") as (address, _):
        for opening in range(OPENINGS):  # each in a new browser: what one draws by software may hold its next page
            with browsing(folder / f"profile-{opening}") as page:
                began = time.monotonic()
                page.open(address)
                page.until(PICTURE)
                seconds = time.monotonic() - began
                page.until(STAGE_READY)
                stage, marks = time.monotonic() - began, page.value(MARKS)
            label = "at once" if opening == 0 else "again"
            print(
                f"first picture of {name}, {splats} splats, {label}: {seconds:.2f} s,"
                f" its splats {stage:.2f} s (asked for after {marks['asked'] / 1000:.2f}, {marks['megabytes']:.1f} MB"
                f" from {marks['first'] / 1000:.2f} to {marks['last'] / 1000:.2f})",
                flush=True,
            )
            if opening == 0:
                time.sleep(LATER)


def moves_of_the_cut(folder: Path) -> None:
    """Print milliseconds of script on scenes of random splats, at an answer of the tiny scene."""
    tiny = make_scene()
    folder.mkdir()
    (folder / "table.safetensors").write_bytes(tiny.table)
    with serving(folder / "data", encoder=f"table:{folder}/table.safetensors") as (address, _):
        lift_at(address, (tiny.splats, tiny.cameras, tiny.features))
        with browsing(folder / "profile") as page:
            page.open(address)
            page.until(READY)
            page.write("#words", "lamp")
            page.press("#query button.main")
            page.until("splatlift.query.current?.answer")
            for size in SIZES:
                costs = page.value(f"{SCENE}({size})")
                print(
                    f"{costs['of']} splats, {costs['drawn']} drawn: unpacked in {costs['loaded']:.0f} ms, new scores"
                    f" {costs['first']:.1f} ms, a move of the cut {statistics.median(costs['moves']):.1f} ms"
                    f" (worst of {MOVES}: {max(costs['moves']):.1f})",
                    flush=True,
                )


def lift_at(address: str, files: tuple[bytes, bytes, bytes]) -> int:
    """Lift a scene there; the number of its splats."""
    with httpx.Client(base_url=address, timeout=600) as client:
        uploads = dict(zip(("splats", "cameras", "features"), files, strict=True))
        ids = {kind: client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in uploads.items()}
        order = ids | {"features": [ids["features"]], "settings": {"preset": "row-sum"}}
        job = wait_for_end(client, client.post("/lift", json=order).headers["location"])
        return client.get(f"/lifts/{job['id']}").json()["count"]


if __name__ == "__main__":
    main()
