"""What a browser waits for on the page: the first picture, and the script of moving the cut.

``python -m tests.benchmarks.page`` prints milliseconds on the tiny scene's service, into whose page scenes of random
splats are loaded. Drawing itself is the card's; here it is software, and not counted.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from tests.api.following import ended
from tests.api.tiny_scene import make_scene
from tests.browser.conftest import browsing, serving
from tests.browser.looking import READY

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
  const question = { ...splatlift.ask.now, scores, low: 0, high: 1, cut: 0.5, bins, things: [] };
  splatlift.ask.questions = [question];
  const laid = performance.now();
  splatlift.ask.cut(0.5);
  const first = performance.now() - laid;
  const moves = [];
  for (let move = 0; move < MOVES; move += 1) {
    const from = performance.now();
    splatlift.ask.cut(0.1 + 0.08 * move);
    moves.push(performance.now() - from);
  }
  clearTimeout(splatlift.ask.soon);
  return { loaded, first, moves, drawn: splatlift.viewer.count, of: splatlift.viewer.total };
})""".replace("MOVES", str(MOVES))


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    scene = make_scene()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "table.safetensors").write_bytes(scene.table)
        with serving(Path(folder) / "data", encoder=f"table:{folder}/table.safetensors") as (address, _):
            lift_at(address)
            with browsing(Path(folder) / "profile") as page:
                begun = time.monotonic()
                page.open(address)
                page.until(READY)
                print(f"first picture of the tiny scene: {1000 * (time.monotonic() - begun):.0f} ms")
                page.write("#words", "lamp")
                page.press("#query button.main")
                page.until("splatlift.ask.now?.answer")
                for size in SIZES:
                    told = page.value(f"{SCENE}({size})")
                    print(
                        f"{told['of']} splats, {told['drawn']} drawn: unpacked in {told['loaded']:.0f} ms, new scores"
                        f" {told['first']:.1f} ms, a move of the cut {statistics.median(told['moves']):.1f} ms"
                        f" (worst of {MOVES}: {max(told['moves']):.1f})"
                    )


def lift_at(address: str) -> None:
    """Lift the tiny scene there."""
    import httpx

    scene = make_scene()
    with httpx.Client(base_url=address, timeout=600) as client:
        put = {kind: getattr(scene, kind) for kind in ("splats", "cameras", "features")}
        ids = {kind: client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in put.items()}
        order = ids | {"features": [ids["features"]], "settings": {"preset": "row-sum"}}
        ended(client, client.post("/lift", json=order).headers["location"])


if __name__ == "__main__":
    main()
