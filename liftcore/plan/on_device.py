"""What a lift will take of a card's memory, whether that is there, and how the work is cut."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from liftcore.errors import Unavailable
from liftcore.plan.memory import ENTRIES_A_SPLAT, codebook_rows, most_levels
from liftcore.solve.device_blocks import GRAIN, SPARE, block_bytes, block_room, book_bytes, device_slices

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.device import Device
    from liftcore.observe.pack import FeaturePacks
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

MIB = 2**20


@dataclass(frozen=True)
class DevicePlan:
    """Bytes on the card at the peaks of the two phases, and the room that there is."""

    name: str  # of the card
    view: int  # the geometry's: scene and the largest view
    codebooks: int  # the solution's: a slice of channels of all codebooks
    block: int  # and W and the sums of all splats, were they one block
    grain: int  # of the smallest block
    slices: int  # of channels
    room: int | None  # for blocks; None on a device without limits of its own
    free: int | None

    @property
    def least(self) -> int:
        """Bytes without which no lift is possible."""
        return max(self.view, math.ceil((self.codebooks + self.grain) / SPARE))

    @property
    def fits(self) -> bool:
        """Whether they are there."""
        return self.free is None or self.least <= self.free

    @property
    def blocks(self) -> int:
        """About how many blocks of splats the solution goes in."""
        return 1 if self.room is None else max(1, math.ceil(self.block / max(self.room, self.grain)))

    @property
    def peak(self) -> int:
        """The estimated peak, cut as it will be."""
        return max(self.view, self.codebooks + self.block // self.blocks)

    def facts(self) -> dict[str, Any]:
        """What does not depend on what is free today."""
        parts = {"view": self.view, "codebooks": self.codebooks, "all_splats": self.block}
        return {"least_bytes": self.least, "parts": parts, "slices": self.slices}

    def today(self) -> dict[str, Any]:
        """What does."""
        return {"free_bytes": self.free, "fits": self.fits, "blocks": self.blocks, "peak_bytes": self.peak}

    def line(self) -> str:
        """For people."""
        free = "" if self.free is None else f" of {self.free / MIB:.0f} MiB free"
        cut = f"{self.blocks} blocks of splats" if self.blocks > 1 else "one block"
        slices = f" and {self.slices} slices of channels" if self.slices > 1 else ""
        parts = f"a view {self.view / MIB:.0f}, codebooks {self.codebooks / MIB:.0f}, W and sums of all splats"
        head = f"about {self.peak / MIB:.0f} MiB at the peak{free}" if self.fits else f"too little room{free}"
        return f"{head} ({parts} {self.block / MIB:.0f}); solved in {cut}{slices}"


def device_plan(
    device: Device,
    splats: Splats,
    packs: FeaturePacks,
    cameras: Mapping[str, Camera],
    seen_a_view: float,
) -> DevicePlan | None:
    """The plan of a lift on that device; None on the processor.

    Args:
        cameras: the views that are lifted, by name. seen_a_view: how many splats a view can see, in the mean.
    """
    if device.kind == "cpu":
        return None
    from liftcore.raster.gpu.memory import raster_bytes

    sizes = {(camera.width, camera.height) for camera in cameras.values()}
    levels = most_levels(packs, cameras)
    view = max(raster_bytes(splats.count, width, height, splats.kernel, levels) for width, height in sizes)
    rows = sum(codebook_rows(packs, name) for name in cameras)
    slices = device_slices(rows, packs.channels)
    width = slices[0][1]
    entries = int(len(cameras) * seen_a_view * ENTRIES_A_SPLAT * levels)
    free = device.free_bytes()
    return DevicePlan(
        name=device.name,
        view=view,
        codebooks=book_bytes(rows, width, unit=False),
        block=block_bytes(splats.count, entries, width),
        grain=block_bytes(min(GRAIN, splats.count), math.ceil(entries * min(1.0, GRAIN / splats.count)), width),
        slices=len(slices),
        room=None if free is None else block_room(free, rows, width, unit=False),
        free=free,
    )


def check_device_room(plan: DevicePlan, asked: str) -> list[str]:
    """What to say when the card has too little room and ``auto`` may take the processor.

    Raises:
        Unavailable: the same, and ``cuda`` was asked for.
    """
    if plan.fits:
        return []
    need, there = f"{plan.least / 2**30:.1f} GiB", f"{(plan.free or 0) / 2**30:.1f} GiB"
    if asked == "cuda":
        raise Unavailable(
            "device", expected=f"{need} of free memory on {plan.name}", got=there,
            hint="end what else runs there, take fewer splats, smaller images or fewer channels, or take device=cpu",
        )  # fmt: skip
    return [f"{plan.name} has {there} free and the lift needs {need}: the processor lifts"]
