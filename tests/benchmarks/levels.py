"""Reweighting where masks of parts and of wholes say different things: generated scenes of many kinds.

    python -m tests.benchmarks.levels [--kinds TEXT] [--seeds N ...] [--json]

A ``heap`` is piles of balls on a cloth, each ball a part of its pile; the ``still life`` is that of the tests; in the
``room`` walls and balls have parts, and these have parts. Every thing and every part has a random vector, and that of
a part has the cosine ``alike`` to its whole's. ``wrong`` is the share of masks that are merged with a neighbour (half
of them), cut in two or misnamed. Levels are ``named``; or a view's masks come in one heap (``unnamed``), as SAM gives
them; or each view has one level (``mixed``), on which a thing is shown whole or by its parts, by chance. ``partly``:
half of the finest parts have no masks. A cell has the mIoU of held-out views over the things and over each level of
parts, by the nearest of the level's vectors. ``together`` is ``default`` with all levels judged together, as it was
up to 0.4. ``gain`` is that of ``default`` over ``row-sum`` in the mean of the levels, ``least`` in the worst of them.
``--kinds`` chooses the rows whose name has the text.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

import liftcore as lc
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.values.views import NO_LABEL, ViewFeatures
from tests.benchmarks.base import command_line, print_rows
from tests.benchmarks.room import room_cameras, room_parts, room_splats
from tests.benchmarks.tabletop import Truth, evaluated_splats
from tests.still_life import surfaces
from tests.still_life.masks import Mistakes, mistaken_regions
from tests.still_life.objects import Piece, still_life_pieces
from tests.still_life.scene import still_life

CHANNELS = 64
COMMON = 0.3  # of a vector, that all have
ROOM_SPLATS, ROOM_SIZE, ROOM_LEVELS = 12_000, (320, 240), 3
PILES, MOST_PARTS = 9, 4
SCENES = ("heap", "still life", "room")


@dataclass(frozen=True)
class Kind:
    """The parameters of a generated scene."""

    scene: str = "heap"  # or "still life", "room"
    views: int = 22  # of which every fifth is held out
    wrong: float = 0.3  # of the masks
    cosine: float = 0.0  # cosine of parts and wholes
    levels: str = "named"  # or "unnamed", "mixed"
    partly: bool = False
    seed: int = 7
    density: float = 0.5  # of the splats

    @property
    def name(self) -> str:
        """As the table prints it."""
        parts = f"{self.views} views", f"{self.wrong:.0%} wrong", f"alike {self.cosine:g}", self.levels
        return ", ".join([self.scene, *parts, *(["partly"] if self.partly else [])])


KINDS = (
    *(Kind(scene, wrong=wrong) for scene in SCENES for wrong in (0.0, 0.1, 0.3)),
    *(Kind(scene, views=views) for scene in SCENES for views in (8, 50)),
    *(Kind(scene, cosine=cosine) for scene in SCENES for cosine in (0.5, 1.0)),
    *(Kind(scene, partly=True) for scene in SCENES),
    *(Kind(scene, wrong=wrong, levels="unnamed") for scene in SCENES for wrong in (0.1, 0.3)),
    *(Kind(scene, wrong=wrong, levels="mixed") for scene in SCENES for wrong in (0.0, 0.3)),
)


@dataclass(frozen=True)
class Generated:
    """A generated scene, and the truth of each level."""

    views: Mapping[str, ViewFeatures]
    truths: Sequence[Truth]  # of things first

    def miou(self, **settings: Any) -> list[float]:
        """The mIoU of each level after a lift."""
        lifted = self.truths[0].lift(self.views, progress=False, **settings)
        return [truth.evaluate(lifted).miou for truth in self.truths]


@dataclass(frozen=True)
class Scene:
    """Splats and cameras, and which thing and part each splat is of."""

    raster: CpuRaster
    cameras: lc.Cameras
    held_out: frozenset[str]
    owners: np.ndarray  # [P, L], numbers of the things and parts on each level

    @property
    def above(self) -> np.ndarray:
        """[K, L]: of each finest part its number on each level."""
        table = np.zeros((self.owners[:, -1].max() + 1, self.owners.shape[1]), np.int64)
        table[self.owners[:, -1]] = self.owners
        return table

    def labels(self, camera: lc.Camera) -> np.ndarray:
        """[L, H, W]: what each ray shows on each level, -1 for nothing."""
        finest = torch.from_numpy(self.owners[:, -1].astype(np.int32))
        strongest = self.raster.strongest_labels(camera, finest, lc.CompositingParams()).numpy()
        return np.where(strongest >= 0, self.above[strongest].transpose(2, 0, 1), NO_LABEL)


def scene_of(kind: Kind) -> Scene:
    """The scene of a kind."""
    if kind.scene == "room":
        count = round(2 * kind.density * ROOM_SPLATS)
        cameras = room_cameras(kind.views, *ROOM_SIZE)
        splats, owners = room_splats(count, kind.seed), room_parts(count, kind.seed)[:, :ROOM_LEVELS]
        held_out = frozenset(camera.name for camera in cameras[2::5])
        return Scene(CpuRaster(splats), lc.Cameras(tuple(cameras)), held_out, owners)
    pieces = still_life_pieces() if kind.scene == "still life" else heap(kind.seed)
    scene = still_life(kind.seed, kind.views, kind.density, pieces)
    owners = np.stack([scene.splat_objects, scene.splat_parts], axis=1)
    cameras = lc.Cameras(tuple(halved(camera) for camera in scene.cameras.values()))
    return Scene(CpuRaster(scene.splats), cameras, frozenset(scene.held_out), owners)


def heap(seed: int) -> list[Piece]:
    """Piles on a cloth, of one to MOST_PARTS balls each."""
    rng = np.random.default_rng(seed)
    cloth = surfaces.rectangle((-4.5, -3.5, 0.0), (9.0, 0.0, 0.0), (0.0, 7.0, 0.0))
    pieces = [Piece("cloth", "cloth", cloth, (0.7, 0.2, 0.2), 2000)]
    for number in range(PILES):
        x, y = -3.0 + 3.0 * (number % 3) + rng.uniform(-0.5, 0.5), -2.0 + 2.0 * (number // 3) + rng.uniform(-0.4, 0.4)
        z = 0.0
        for part in range(rng.integers(1, MOST_PARTS + 1)):
            width, height = rng.uniform(0.25, 0.9), rng.uniform(0.2, 0.5)
            ball = surfaces.ellipsoid((x, y, z + height), (width, width, height))
            z += 1.6 * height
            red, green, blue = rng.uniform(0.1, 0.9, 3).tolist()
            pieces.append(
                Piece(f"pile {number}", f"{number}.{part}", ball, (red, green, blue), int(120 + 500 * width))
            )
    return pieces


def generate(kind: Kind) -> Generated:
    """The scene of a kind with its masks."""
    scene, rng = scene_of(kind), np.random.default_rng((kind.seed, 5))
    vectors, share = vectors_of(scene.owners, kind.cosine, rng), kind.wrong
    book, count = torch.from_numpy(np.concatenate(vectors)).float(), [len(part) for part in vectors]
    mistakes = Mistakes(0.5 * share, 0.25 * share, 0.25 * share, 0.03, 1.0 if share else 0.0, 0.35)
    unlabelled = rng.random(count[-1]) < (0.5 if kind.partly else 0.0)
    views, pixel_labels = (
        dict[str, ViewFeatures](),
        {view: scene.labels(scene.cameras[view]) for view in scene.held_out},
    )
    for name, camera in scene.cameras.items():
        if name in scene.held_out:
            continue
        labels = scene.labels(camera)
        labels[-1][(labels[-1] >= 0) & unlabelled[labels[-1]]] = NO_LABEL
        if kind.levels == "mixed":
            has_whole = rng.random(count[0]) < 0.5
            labels = one_level(labels, has_whole, count)
            exact = lc.Regions(torch.from_numpy(labels.astype(np.int32)), book)
        else:
            starts = np.cumsum([0, *count[:-1]])[:, None, None]
            exact = lc.Regions(
                torch.from_numpy(np.where(labels >= 0, labels + starts, NO_LABEL).astype(np.int32)), book
            )
        regions = mistaken_regions(exact, mistakes, rng)
        views[name] = without_levels(regions) if kind.levels == "unnamed" else regions
    counts = evaluated_splats(scene.raster.splats, scene.cameras, views)
    truths = []
    for level, classes in enumerate(vectors):
        words = tuple(f"{level}.{number}" for number in range(count[level]))
        held_out = {view: torch.from_numpy(labels[level]) for view, labels in pixel_labels.items()}
        owners = torch.from_numpy(scene.owners[:, level])
        truths.append(
            Truth(scene.raster, scene.cameras, words, torch.from_numpy(classes).float(), owners, counts, held_out)
        )
    return Generated(views, truths)


def halved(camera: lc.Camera) -> lc.Camera:
    """The camera with half of the pixels a side."""
    sizes = {"width": camera.width // 2, "height": camera.height // 2}
    return camera.replace(**sizes, **{name: getattr(camera, name) / 2 for name in ("fx", "fy", "cx", "cy")})


def one_level(labels: np.ndarray, has_whole: np.ndarray, count: Sequence[int]) -> np.ndarray:
    """[1, H, W] rows of the codebook: one region an object if ``has_whole`` [K] bool, else its finest parts are."""
    objects, parts = labels[0], labels[-1]
    as_whole = (objects >= 0) & (has_whole[objects] | (parts < 0))
    return np.where(as_whole, objects, np.where(parts >= 0, parts + sum(count[:-1]), NO_LABEL))[None]


def without_levels(regions: lc.Regions) -> lc.Regions:
    """The masks of all levels, whose levels nobody names."""
    planes = regions.labels.numpy()
    planes_of = [(level == row, int(row)) for level in planes for row in np.unique(level[level >= 0])]
    masks, rows = [mask for mask, _ in planes_of], [row for _, row in planes_of]
    return lc.Regions.from_masks(torch.from_numpy(np.stack(masks)), regions.codebook[rows])


def vectors_of(owners: np.ndarray, cosine: float, rng: np.random.Generator) -> list[np.ndarray]:
    """[K, CHANNELS] of each level; of parts with the cosine ``cosine`` to their wholes, but for what all share."""
    common, vectors = unit(rng.standard_normal((1, CHANNELS))), list[np.ndarray]()
    for level in range(owners.shape[1]):
        unit_rows = unit(rng.standard_normal((owners[:, level].max() + 1, CHANNELS)))
        if level:
            above = np.empty_like(unit_rows)
            above[owners[:, level]] = vectors[-1][owners[:, level - 1]]
            unit_rows = unit(unit_rows - (unit_rows * above).sum(axis=1, keepdims=True) * above)
            unit_rows = cosine * above + (1 - cosine**2) ** 0.5 * unit_rows
        vectors.append(unit_rows)
    return [unit(part + COMMON * common) for part in vectors]


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length one."""
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@contextmanager
def levels_together() -> Iterator[None]:
    """Have lifts judge all levels as one."""
    with patch("liftcore.lifting.pipeline.needs_separate_levels", lambda *_: False):
        yield


def measured(kind: Kind) -> dict[str, Any]:
    """The row of a kind."""
    scene = generate(kind)
    row_sum = scene.miou(preset="row-sum")
    with levels_together():
        combined = scene.miou()
    default = scene.miou()
    gains = np.array(default) - row_sum
    cells = {"row-sum": row_sum, "together": combined, "default": default}
    cells_text = {name: " / ".join(f"{value:.3f}" for value in values) for name, values in cells.items()}
    return {"scene": f"{kind.name}, seed {kind.seed}", **cells_text, "gain": gains.mean(), "least": gains.min()}


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.levels",
        __doc__,
        ("--kinds", {"default": "", "metavar": "TEXT", "help": "rows whose name has it, as 'heap, 22 views'"}),
        ("--seeds", {"nargs": "*", "type": int, "default": (7, 8)}),
    )
    options = parser.parse_args()
    kinds = [replace(kind, seed=seed) for kind in KINDS if options.kinds in kind.name for seed in options.seeds]
    print_rows((measured(kind) for kind in kinds), as_json=options.json)


if __name__ == "__main__":
    main()
