"""The synthetic room as files, as large as the bar asks: a million splats, 300 views, 512 channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.features.views import Regions
from liftcore.features.write_pack import write_pack
from liftcore.io.inria import write_inria_cameras
from liftcore.io.ply import write_splats
from liftcore.scene.cameras import Cameras

if TYPE_CHECKING:
    from pathlib import Path


DIFFERENT_MAPS = 12  # label maps that views take in turn: making one takes longer than lifting it


@dataclass(frozen=True)
class RoomSize:
    """How much there is to lift."""

    splats: int
    width: int
    height: int
    views: int
    channels: int
    levels: int = 4


BAR = RoomSize(1_000_000, 986, 728, 300, 512)
AGREEING = RoomSize(200_000, 640, 480, 8, 512)  # to compare both devices on: the processor lifts it in seconds


def write_room(folder: Path, size: RoomSize) -> tuple[Path, Path, Path]:
    """Splats, cameras and features of the room; always the same."""
    paths = folder / "room.ply", folder / "cameras.json", folder / "features.safetensors"
    cameras = room_cameras(size.views, size.width, size.height)
    write_splats(room_splats(size.splats), paths[0])
    write_inria_cameras(Cameras(tuple(cameras)), paths[1])
    chosen = enumerate(cameras[:DIFFERENT_MAPS])
    maps = [room_regions(camera, number, size.levels, size.channels) for number, camera in chosen]
    views = {camera.name: _with_own_codebook(maps[k % len(maps)], k) for k, camera in enumerate(cameras)}
    write_pack(paths[2], views, {"encoder": "random", "normalised": "true"})
    return paths


def _with_own_codebook(regions: Regions, seed: int) -> Regions:
    """The same labels over other vectors."""
    rows = torch.randn(regions.codebook.shape, generator=torch.Generator().manual_seed(seed))
    return Regions(regions.labels, torch.nn.functional.normalize(rows, dim=1).half())
