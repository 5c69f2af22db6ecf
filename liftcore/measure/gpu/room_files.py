"""The synthetic room as files, as large as the bar asks: a million splats, 300 views, 512 channels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from liftcore.measure.synthetic import room_cameras, room_regions, room_splats
from liftcore.observe.observation import RegionMap
from liftcore.observe.write_pack import write_pack
from liftcore.scene.cameras import Cameras
from liftcore.scene.inria import write_inria_cameras
from liftcore.scene.ply import write_splats

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.scene.cameras import Camera

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


class _Regions(Mapping[str, RegionMap]):
    """A region map a view: one of some label maps, with a codebook of its own."""

    def __init__(self, cameras: list[Camera], size: RoomSize) -> None:
        self._names = {camera.name: number for number, camera in enumerate(cameras)}
        chosen = enumerate(cameras[:DIFFERENT_MAPS])
        self._maps = [room_regions(camera, number, size.levels, size.channels) for number, camera in chosen]

    def __getitem__(self, view: str) -> RegionMap:
        number = self._names[view]
        regions = self._maps[number % len(self._maps)]
        rows = torch.randn(regions.codebook.shape, generator=torch.Generator().manual_seed(number))
        return RegionMap(regions.labels, torch.nn.functional.normalize(rows, dim=1).half())

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def write_room(folder: Path, size: RoomSize) -> tuple[Path, Path, Path]:
    """Splats, cameras and features of the room; always the same."""
    paths = folder / "room.ply", folder / "cameras.json", folder / "features.safetensors"
    cameras = room_cameras(size.views, size.width, size.height)
    write_splats(room_splats(size.splats), paths[0])
    write_inria_cameras(Cameras(tuple(cameras)), paths[1])
    write_pack(paths[2], _Regions(cameras, size), {"encoder": "random", "normalised": "true"})
    return paths
