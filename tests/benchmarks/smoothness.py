"""What the smoothness of features gains and costs: lifts of each pack with several lambdas.

    python -m tests.benchmarks.smoothness SCENE [--every N] [--packs NAME ...] [--lambdas L ...]
        [--colours KIND] [--json]

``chosen`` is the lambda that ``auto`` took. One colour, or a random one a splat, says
nothing of the scene.

With truth in the layout of ``tabletop``: splat accuracy, argmax mIoU and the worst class of each pack
(`tests.benchmarks.tabletop`). With ``grids_test.safetensors`` instead: fidelity, the mean cosine about the maps' mean
of rendered features with the maps of views that were not lifted.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import cosine_similarity

import liftcore as lc
from liftcore.scene.cameras import Camera
from liftcore.scene.harmonics import SH_C0
from liftcore.values.views import FeatureGrid
from tests.benchmarks.base import command_line, read_pack, read_scene, tell
from tests.benchmarks.tabletop import tabletop

LAMBDAS = ("0", "0.3", "1", "4", "auto")
COLOURS = ("true", "one", "random")
TEST_MAPS = "grids_test"
FULL = 0.5  # of a ray that the scene takes, for its cell to be judged
CHANNELS = 64  # rendered at a time

Judge = Callable[[lc.LiftResult], dict[str, float]]


def rows(folder: Path, pack: str, every: int, lambdas: list[str], colours: str) -> Iterator[dict[str, Any]]:
    """A lift of the preset ``default`` with each lambda; seconds are those of the step and of all other steps."""
    splats, cameras = read_scene(folder)
    splats, views = coloured(splats, colours), read_pack(folder, pack, every)
    judge = truth_judge(folder) if (folder / "truth.json").is_file() else fidelity_judge(folder, splats, cameras)
    for smoothness in lambdas:
        strength = smoothness if smoothness == "auto" else float(smoothness)
        result = lc.lift(splats, cameras, views, certificate_rays=0, smoothness=strength, progress=False).cpu()
        timings = result.metadata.timings
        step = timings.get("smooth", 0.0) + timings.get("halves", 0.0)
        facts = result.diagnostics.get("smoothing", {"smoothness": 0.0})
        head = {"pack": pack, "views": len(views), "smoothness": smoothness, "chosen": facts["smoothness"]}
        yield head | judge(result) | {"step s": step, "lift s": sum(timings.values()) - step}


def coloured(splats: lc.Splats, kind: str) -> lc.Splats:
    """The splats with their own colours, one colour, or a random colour each."""
    if kind == "true":
        return splats
    shape, generator = (splats.count, 1, 3), torch.Generator().manual_seed(1)
    colours = torch.zeros(shape) if kind == "one" else (torch.rand(shape, generator=generator) - 0.5) / SH_C0
    return replace(splats, sh=colours)


def truth_judge(folder: Path) -> Judge:
    """Figures of a lift against the classes of splats and pixels."""
    truth = tabletop(folder)

    def judge(lifted: lc.LiftResult) -> dict[str, float]:
        found = truth.judge(lifted)
        return {"accuracy": found.accuracy, "mIoU": found.miou, "worst class": found.worst}

    return judge


def fidelity_judge(folder: Path, splats: lc.Splats, cameras: lc.Cameras) -> Judge:
    """Fidelity of a lift to maps of other views."""
    maps = {name: grid for name, grid in read_pack(folder, TEST_MAPS).items() if isinstance(grid, FeatureGrid)}
    mean = torch.stack([one.grid.float().mean(dim=(0, 1)) for one in maps.values()]).mean(dim=0)

    def cosines(lifted: lc.LiftResult, name: str) -> torch.Tensor:
        grid = maps[name].grid.float()
        height, width, channels = grid.shape
        camera = at_cells(cameras[name], width, height)
        parts = [lifted.features[:, first : first + CHANNELS].float() for first in range(0, channels, CHANNELS)]
        shown = torch.cat([lc.render(splats, camera, part) for part in parts], dim=2)
        filled = lc.render(splats, camera, torch.ones(splats.count, 1))[:, :, 0]
        shown = shown / filled.clamp_min(FULL)[:, :, None]
        return cosine_similarity(shown - mean, grid - mean, dim=2)[filled >= FULL]

    def judge(lifted: lc.LiftResult) -> dict[str, float]:
        return {"fidelity": float(torch.cat([cosines(lifted, name) for name in maps]).mean())}

    return judge


def at_cells(camera: Camera, width: int, height: int) -> Camera:
    """The camera with one pixel a cell of a map of its image."""
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return lc.Camera(camera.viewmat, K, width, height, name=camera.name)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.smoothness",
        __doc__,
        ("folder", {"type": Path}),
        ("--every", {"type": int, "default": 1, "metavar": "N", "help": "take every n-th view"}),
        ("--packs", {"nargs": "+", "default": ["grids"], "metavar": "NAME"}),
        ("--lambdas", {"nargs": "+", "default": list(LAMBDAS), "metavar": "L"}),
        ("--colours", {"default": "true", "choices": COLOURS}),
    )
    options = parser.parse_args()
    given = options.every, options.lambdas, options.colours
    table = [row for pack in options.packs for row in rows(options.folder, pack, *given)]
    tell(table, as_json=options.json)


if __name__ == "__main__":
    main()
