"""How long a warm question takes: ``python -m tests.benchmarks.query_bench --splats 1000000 --channels 512``.

A lift of random unit features is written to a real lift file, opened as any other, and asked for another direction
each time, so that no answer is remembered. With ``--view WxH`` the same splats are a synthetic room, and each
question is also seen from a camera: ``ask_and_mask_ms`` with the splats that its threshold selects, so many of a
random lift that nothing is grouped, and ``ask_and_objects_mask_ms`` with a tenth of all, which are grouped unless
they are more than masks group. Prints one JSON object.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore import __version__
from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware
from liftcore.evaluate.synthetic import room_cameras, room_splats
from liftcore.io.inria import write_inria_cameras
from liftcore.io.lift_file import input_file, save_lift
from liftcore.io.ply import write_splats
from liftcore.query.ask import Answer, ask
from liftcore.query.render import mask_png, view_mask
from liftcore.query.scene import QueryScene
from liftcore.result import InputFile, LiftMetadata, LiftResult
from liftcore.scene.cameras import Cameras
from liftcore.settings import LiftSettings

SEED = 0
BLOCK = 65_536  # rows of random features made at once


class RandomTexts:
    """A text encoder whose vectors are random: every text a direction of its own."""

    name = "random"

    def __init__(self, channels: int) -> None:
        self.channels = channels

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n texts -> [n, F] f32 unit rows, seeded by the text."""
        rows = [torch.randn(self.channels, generator=torch.Generator().manual_seed(int(text))) for text in texts]
        return torch.nn.functional.normalize(torch.stack(rows), dim=1).numpy()


def write_random_lift(folder: Path, splats: int, channels: int, size: tuple[int, int] | None) -> Path:
    """A lift file of random unit features [P, F] f16; with a size also the room and the camera that it names."""
    generator = torch.Generator().manual_seed(SEED)
    features = torch.empty(splats, channels, dtype=torch.float16)
    for first in range(0, splats, BLOCK):
        block = torch.randn(min(BLOCK, splats - first), channels, generator=generator)
        features[first : first + len(block)] = torch.nn.functional.normalize(block, dim=1)
    nothing = InputFile(path=str(folder / "nothing"), sha256="0" * 64)
    scene = [nothing, nothing]
    if size is not None:
        write_splats(room_splats(splats), folder / "splats.ply")
        write_inria_cameras(Cameras(tuple(room_cameras(1, *size))), folder / "cameras.json")
        scene = [input_file(folder / name) for name in ("splats.ply", "cameras.json")]
    metadata = LiftMetadata(
        version=__version__, settings=LiftSettings.of(), splats=scene[0], cameras=scene[1], features=(),
        encoder="random", text_space="random", views=(), certificate={}, timings={},
    )  # fmt: skip
    ones = torch.ones(splats)
    save_lift(
        LiftResult(features, ones, ones.clone(), torch.ones(splats, dtype=torch.bool), metadata), folder / "lift"
    )
    return folder / "lift"


def run(splats: int, channels: int, repeats: int, size: tuple[int, int] | None = None) -> dict[str, Any]:
    """Time questions; plain numbers, ready for JSON."""
    with tempfile.TemporaryDirectory() as folder:
        scene = QueryScene.open(write_random_lift(Path(folder), splats, channels, size))
        encoder = RandomTexts(channels)
        begin = time.perf_counter()
        answer = ask(scene, "0", encoder)
        result: dict[str, Any] = {"splats": splats, "channels": channels, "dtype": "float16", "repeats": repeats}
        result["first_ask_ms"] = 1e3 * (time.perf_counter() - begin)
        result["ask_ms"] = _times(lambda k: ask(scene, str(k), encoder), repeats)
        if size is not None:
            view = next(iter(scene.cameras))
            view_mask(scene, answer, view)
            result["ask_and_mask_ms"] = _times(
                lambda k: mask_png(view_mask(scene, ask(scene, str(k), encoder), view)), repeats
            )
            result["ask_and_objects_mask_ms"] = _times(
                lambda k: mask_png(view_mask(scene, _tenth(ask(scene, str(k), encoder)), view)), repeats
            )
    return result | {"hardware": hardware()}


def _tenth(answer: Answer) -> Answer:
    """The same with the best tenth of the splats selected."""
    return replace(answer, selected=answer.scores >= np.quantile(answer.scores, 0.9))


def _times(work: Callable[[int], object], repeats: int) -> dict[str, float]:
    times = []
    for k in range(1, repeats + 1):
        begin = time.perf_counter()
        work(k)
        times.append(1e3 * (time.perf_counter() - begin))
    return {"best": min(times), "median": statistics.median(times), "worst": max(times)}


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise InvalidInput("--view", expected="WIDTHxHEIGHT in pixels", got=repr(text))
    return int(width), int(height)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--channels", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--view", metavar="WxH", help="also time masks of this size")
    options = parser.parse_args(arguments)
    size = _size(options.view) if options.view else None
    print(json.dumps(run(options.splats, options.channels, options.repeats, size)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
