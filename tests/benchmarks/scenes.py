"""A scene to measure on: a synthetic room of many views, with known mistakes.

    python -m tests.benchmarks.scenes room FOLDER --splats 500000 --views 160

Every view of the room has regions on four levels, from walls and balls to their parts, seen with occlusion. A part
has a random unit vector; what a view says of it has noise of norm NOISE. Of all regions a tenth say another part's
vector, and of three tenths the vector is mixed with another's.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import liftcore as lc
from liftcore.io.splats import write_splats
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.values.pack import as_views, write_pack
from liftcore.values.views import NO_LABEL, ViewFeatures
from tests.benchmarks.room import PART_LEVELS, room_cameras, room_parts, room_splats
from tests.inria_file import write_inria_cameras

NOISE = 0.45
WRONG, MERGED = 0.1, 0.3  # shares of a view's regions
SHRUNK = 2  # label maps have every other pixel


@dataclass(frozen=True)
class RoomSpec:
    """The parameters of a room."""

    splats: int
    views: int
    size: tuple[int, int]  # width and height of the views, pixels
    channels: int
    seed: int = 0


def write_room(folder: Path, spec: RoomSpec) -> None:
    """Write ``point_cloud.ply``, ``cameras.json`` and ``features.safetensors``."""
    folder.mkdir(parents=True, exist_ok=True)
    splats, cameras = room_splats(spec.splats, spec.seed), room_cameras(spec.views, *spec.size)
    write_splats(folder / "point_cloud.ply", splats)
    write_inria_cameras(lc.Cameras(tuple(cameras)), folder / "cameras.json")
    views = as_views(observed_views(CpuRaster(splats), cameras, spec))
    write_pack(folder / "features.safetensors", views, {"encoder": "random parts", "normalised": "true"})


def observed_views(
    raster: CpuRaster, cameras: Sequence[lc.Camera], spec: RoomSpec
) -> Iterator[tuple[str, ViewFeatures]]:
    """Iterate over views by name, with their observed features."""
    parts = room_parts(spec.splats, spec.seed)  # [P, PART_LEVELS], numbers of parts on each level
    fine, counts = parts[:, -1], parts.max(axis=0) + 1
    shape = int(counts.sum()), spec.channels
    vectors = _unit(np.random.default_rng((spec.seed, 1)).standard_normal(shape))  # level by level
    rows = np.full((PART_LEVELS, fine.max() + 2), NO_LABEL)  # of a finest part its vector on each level; none is last
    rows[:, fine] = (np.cumsum(counts) - counts + parts).T
    for number, camera in enumerate(cameras):
        rng = np.random.default_rng((spec.seed, number))
        labels = torch.from_numpy(fine.astype(np.int32))
        strongest = raster.strongest_labels(_shrunk(camera), labels, lc.CompositingParams()).numpy()
        visible_rows, labels = np.unique(rows[:, strongest], return_inverse=True)
        first = int(visible_rows[0] == NO_LABEL)
        vectors_seen = _noisy(_mistaken(vectors[visible_rows[first:]], vectors, rng), rng)
        yield (
            camera.name,
            lc.Regions(torch.from_numpy((labels - first).astype(np.int32)), torch.from_numpy(vectors_seen).half()),
        )


def _mistaken(book: np.ndarray, vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    other_vectors = vectors[rng.integers(0, len(vectors), len(book))]
    fate = rng.uniform(size=(len(book), 1))
    return _unit(np.where(fate < WRONG, other_vectors, np.where(fate < WRONG + MERGED, book + other_vectors, book)))


def _noisy(book: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _unit(book + NOISE * _unit(rng.standard_normal(book.shape)))


def _unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def _shrunk(camera: lc.Camera) -> lc.Camera:
    sizes = {"width": camera.width // SHRUNK, "height": camera.height // SHRUNK}
    lengths = {name: getattr(camera, name) / SHRUNK for name in ("fx", "fy", "cx", "cy")}
    return camera.replace(**sizes, **lengths)


def main() -> None:
    """Write the scene."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.scenes", description=__doc__)
    spec = parser.add_subparsers(dest="kind", required=True).add_parser("room")
    spec.add_argument("folder", type=Path)
    for name, default in (("splats", 500_000), ("views", 160), ("width", 986), ("height", 728), ("channels", 512)):
        spec.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    size = options.width, options.height
    write_room(options.folder, RoomSpec(options.splats, options.views, size, options.channels))


if __name__ == "__main__":
    main()
