"""What a lift will take of a card's memory, whether that is there, and how the work is cut."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from liftcore.errors import Unavailable
from liftcore.plan.memory import all_columns, codebook_rows, most_levels, weight_bytes
from liftcore.solve.device_blocks import GRAIN, SPARE, block_bytes, book_bytes, device_slices

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.device import Device
    from liftcore.features.pack import FeaturePacks
    from liftcore.plan.entries import PlannedEntries
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.settings import LiftSettings

MIB = 2**20
ROOM_SPARE = 0.9  # of the free memory, as liftcore.raster.gpu.room has it (which loads triton)
FEW_BLOCKS = 8  # of splats: W does not stay where the solution would have to go in more of them for its sake


@dataclass(frozen=True)
class DevicePlan:
    """Bytes on the card at the peaks of the two phases, and the room that there is."""

    name: str  # of the card
    view: int  # the geometry's: scene and the largest view, in one piece
    least_view: int  # the same in the smallest pieces
    weights: int  # W of all views
    codebooks: int  # the solution's: a slice of channels of all codebooks
    block: int  # and W and the sums of all splats, were they one block
    grain: int  # of the smallest block
    slices: int  # of channels
    free: int | None  # on the card; None on a device without limits of its own

    @property
    def least(self) -> int:
        """Bytes without which no lift is possible."""
        return max(self.least_view, math.ceil((self.codebooks + self.grain) / SPARE))

    @property
    def fits(self) -> bool:
        """Whether they are there."""
        return self.free is None or self.least <= self.free

    @property
    def whole_views(self) -> bool:
        """Whether views are walked in one piece, with the scene on the card."""
        return self.free is None or self.view <= ROOM_SPARE * self.free

    @property
    def kept(self) -> int:
        """Bytes of W that stay on the card between the phases, where views and many blocks find room beside them."""
        if self.free is None:
            return self.weights
        beside = max(self.view, self.codebooks + max(self.grain, self.block // FEW_BLOCKS))
        return min(self.weights, max(0, int(SPARE * self.free) - beside))

    @property
    def room(self) -> int | None:
        """Bytes for a block of splats; None for no limit."""
        return None if self.free is None else int(SPARE * self.free) - self.codebooks - self.kept

    @property
    def blocks(self) -> int:
        """About how many blocks of splats the solution goes in."""
        return 1 if self.room is None else max(1, math.ceil(self.block / max(self.room, self.grain)))

    @property
    def peak(self) -> int:
        """The estimated peak, cut as it will be."""
        view = self.view if self.whole_views or self.free is None else int(ROOM_SPARE * self.free)
        return self.kept + max(view, self.codebooks + self.block // self.blocks)

    def facts(self) -> dict[str, Any]:
        """What does not depend on what is free today."""
        parts = {"view": self.view, "region_weights": self.weights, "codebooks": self.codebooks}
        return {"least_bytes": self.least, "parts": parts | {"all_splats": self.block}, "slices": self.slices}

    def today(self) -> dict[str, Any]:
        """What does."""
        cut = {"whole_views": self.whole_views, "blocks": self.blocks, "kept_bytes": self.kept}
        return {"free_bytes": self.free, "fits": self.fits, **cut, "peak_bytes": self.peak}

    def line(self) -> str:
        """For people."""
        free = "" if self.free is None else f" of {self.free / MIB:.0f} MiB free"
        views = "views in one piece" if self.whole_views else "views in strips, the scene in blocks from the host"
        cut = f"{self.blocks} blocks of splats" if self.blocks > 1 else "one block"
        slices = f" and {self.slices} slices of channels" if self.slices > 1 else ""
        parts = f"a view {self.view / MIB:.0f}, codebooks {self.codebooks / MIB:.0f}, W and sums of all splats"
        head = f"about {self.peak / MIB:.0f} MiB at the peak{free}" if self.fits else f"too little room{free}"
        stays = f"{self.kept / MIB:.0f} of {self.weights / MIB:.0f} MiB of W stay there"
        return f"{head} ({parts} {self.block / MIB:.0f}); {views}; {stays}; solved in {cut}{slices}"


def device_plan(
    device: Device,
    splats: Splats,
    packs: FeaturePacks,
    cameras: Mapping[str, Camera],
    planned: PlannedEntries,
    settings: LiftSettings,
) -> DevicePlan | None:
    """The plan of a lift on that device; None on the processor.

    Args:
        cameras: the views that are lifted, by name. planned: what the walks will make.
    """
    if device.kind == "cpu":
        return None
    from liftcore.raster.gpu.memory import least_raster_bytes, raster_bytes

    levels = most_levels(packs, cameras)
    views = [
        (splats.count, camera.width, camera.height, splats.kernel, levels)
        for camera in {(camera.width, camera.height): camera for camera in cameras.values()}.values()
    ]
    rows = all_columns(packs, cameras, settings)
    least = sum(codebook_rows(packs, name) for name in cameras)  # columns, for which slices are widest
    slices = device_slices(least, packs.channels)
    width = slices[0][1]
    seen = len(cameras) * planned.splats
    entries = int(seen * planned.entries)
    return DevicePlan(
        name=device.name,
        view=max(raster_bytes(*view) for view in views),
        least_view=max(least_raster_bytes(*view) for view in views),
        weights=weight_bytes(seen, planned.entries),
        codebooks=book_bytes(rows, width, unit=False),
        block=block_bytes(splats.count, entries, width),
        grain=block_bytes(min(GRAIN, splats.count), math.ceil(entries * min(1.0, GRAIN / splats.count)), width),
        slices=len(slices),
        free=device.free_bytes(),
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
