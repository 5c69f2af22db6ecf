"""The plan of a lift: what the scene needs, found out before the work and kept with its certificate."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from liftcore.device import CPU
from liftcore.io.transforms import frame_warning
from liftcore.plan.coverage import WELL_COVERED, spare_views, view_order, views_to_show
from liftcore.plan.entries import planned_entries
from liftcore.plan.memory import (
    all_weight_bytes,
    check_memory,
    check_weights,
    dense_warning,
    features_room,
    free_memory,
    memory_parts,
    weights_in_files,
)
from liftcore.plan.on_device import check_device_room, device_plan
from liftcore.plan.pilot import PILOT_VIEWS, fly_pilot
from liftcore.plan.rank import ENOUGH, Rank, codebook_rank
from liftcore.plan.visibility import visibility
from liftcore.raster.cpu.raster import views_at_a_time
from liftcore.scene.cameras import distortion_warning
from liftcore.solve.map_shapes import shape_warnings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from liftcore.device import Device
    from liftcore.features.pack import FeaturePacks
    from liftcore.plan.on_device import DevicePlan
    from liftcore.plan.pilot import Pilot
    from liftcore.plan.visibility import Visibility
    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Splats
    from liftcore.settings import LiftSettings

FEW_VIEWS = 32  # and below, view_cosine takes all: a pilot would cost what it saves
SHOWN_VIEWS = 6  # names in a line for people
MIB = 2**20


@dataclass(frozen=True)
class Plan:
    """What a lift is about to do. Plain values: the same inputs and settings give the same plan."""

    kernel: str
    splats: int  # P
    views: tuple[str, ...]  # that will be lifted, in the order of the sums
    left_out: tuple[str, ...]  # that the settings' coverage or view_cosine leaves out
    there: int  # views with features and a camera, whatever the settings take of them
    view_cosine: float | None  # expected of the views' features against those of all, where a pilot chose them
    spare: tuple[str, ...]  # of those lifted: what they show, WELL_COVERED of the others show too
    seen_share: float  # of the splats, that some view can see, before occlusion
    splats_a_view: float
    entries_a_splat: float  # of W, of a splat in a view that can see it
    rank: Rank
    dtype: str  # that X is stored as, when it can hold the codebooks
    memory: Mapping[str, int]  # bytes a part, with one view in work
    in_files: int  # bytes of region weights beyond those that stay in memory
    at_once: int  # views that this machine has in work
    device: Device  # that will walk and solve
    on_device: DevicePlan | None  # what it takes of a card, where it is one
    features_room: int | None  # bytes of this machine's memory that X may take today; None for no limit
    warnings: tuple[str, ...]  # of this machine, today
    told: tuple[str, ...]  # warnings of what is lifted, which the certificate of the lift has too

    @property
    def memory_bytes(self) -> int:
        """The estimated peak with one view in work."""
        return sum(self.memory.values())

    @property
    def in_work(self) -> dict[str, int]:
        """Bytes a part with as many views in work as this machine has."""
        return _in_work(self.memory, self.at_once)

    def facts(self) -> dict[str, Any]:
        """Plain numbers for the certificate, without what only this machine has to do with."""
        return {
            "kernel": self.kernel,
            "splats": self.splats,
            "seen_share": self.seen_share,
            "splats_a_view": self.splats_a_view,
            "entries_a_splat": self.entries_a_splat,
            "views": len(self.views),
            "views_left_out": len(self.left_out),
            "view_cosine": self.view_cosine,
            "spare_views": list(self.spare),
            "channels": self.rank.channels,
            "rank": self.rank.rank,
            "rank_rows": self.rank.rows,
            "channels_enough": self.rank.enough,
            "dtype": self.dtype,
            "memory_bytes": self.memory_bytes,
            "memory": dict(self.memory),
            "weights_in_files_bytes": self.in_files,
            "device": self.device.kind,
            "device_memory": self.on_device.facts() if self.on_device else None,
        }

    def summary(self) -> Iterator[str]:
        """The plan in short, for people: what is lifted, what it is made of, and what that takes."""
        rank, seen = self.rank, f"{self.seen_share:.1%} in some view's field"
        spare = f", {len(self.spare)} of which add nothing new" if self.spare else ""
        yield f"{self.splats} splats ({self.kernel}), {seen}; {len(self.views)} of {self.there} views{spare}"
        carried = f"rank {self._bound}{rank.rank}, {rank.enough} directions hold {ENOUGH:.0%}"
        yield f"{rank.channels} channels ({carried}), stored as {self.dtype}"
        card = f" and {self.on_device.peak / MIB:.0f} MiB of {self.device.name}" if self.on_device else ""
        files = f", {self.in_files / MIB:.0f} MiB of region weights in files" if self.in_files else ""
        yield f"about {sum(self.in_work.values()) / MIB:.0f} MiB at the peak{card}{files}"

    def lines(self) -> Iterator[str]:
        """The whole plan for people."""
        yield f"plan: {self.splats} splats ({self.kernel}), {self.seen_share:.1%} in some view's field"
        parts = f"{self.entries_a_splat:.1f} regions or cells"
        yield f"  a view shows {self.splats_a_view:.0f} of them, before occlusion, each in {parts}"
        left = f", {len(self.left_out)} left out" if self.left_out else ""
        if self.view_cosine is not None:
            left += f" (a pilot expects features with a cosine of {self.view_cosine:.3f} to those of all)"
        yield f"  {len(self.views)} views{left}{self._spare_line()}"
        yield (
            f"  {self.rank.channels} channels; {self.rank.rows} sampled codebook rows have rank {self._bound}"
            f"{self.rank.rank}, and {self.rank.enough} directions hold {ENOUGH:.0%} of their squares"
        )
        sizes = self.in_work
        parts = ", ".join(f"{name} {size / MIB:.0f}" for name, size in sizes.items())
        yield f"  features as {self.dtype}; about {sum(sizes.values()) / MIB:.0f} MiB at the peak ({parts})"
        if self.in_files:
            yield f"  {self.in_files / MIB:.0f} MiB of region weights go to files in the temporary folder"
        yield f"  on {self.device.name}" + (f": {self.on_device.line()}" if self.on_device else "")
        yield from (f"warning: {warning}" for warning in (*self.warnings, *self.told))

    @property
    def kept_on_card(self) -> int:
        """Bytes of region weights that stay on the card between the walks and the solution."""
        return self.on_device.kept if self.on_device else 0

    @property
    def _bound(self) -> str:
        """A sample of fewer rows than channels can have no larger rank than it has rows."""
        return "at least " if self.rank.rank == self.rank.rows < self.rank.channels else ""

    def _spare_line(self) -> str:
        if not self.spare:
            return ""
        some = ", ".join(self.spare[:SHOWN_VIEWS]) + (", ..." if len(self.spare) > SHOWN_VIEWS else "")
        return f"; {len(self.spare)} add nothing that {WELL_COVERED} others do not show: {some}"


def plan_lift(
    splats: Splats,
    cameras: Cameras,
    packs: FeaturePacks,
    names: Sequence[str],
    settings: LiftSettings,
    device: Device,
    threads: int | None = None,
) -> Plan:
    """Plan the lift of the views ``names``; the settings' coverage and view_cosine may choose among them.

    Args:
        device: where it should run. A card with too little room leaves an ``auto`` lift to the processor.
        threads: that walk on the processor; None takes the cores that this process may use.

    Raises:
        Unavailable: this machine has no room for the codebooks, or for the features in no place; or the card that
            the lift was sent to has none.
    """
    by_name = {name: cameras[name] for name in names}
    seen = visibility(splats, list(by_name.values()), settings.lift_params)
    chosen, expected = _choose_views(
        seen, settings, lambda: fly_pilot(splats, cameras, packs, names, settings, seen, threads)
    )
    views = [names[k] for k in chosen]
    seen = seen.of(chosen)
    lifted = {name: by_name[name] for name in views}
    entries = planned_entries(seen, packs, lifted, settings)
    parts = memory_parts(splats, packs, lifted, entries, settings)
    on_device = device_plan(device, splats, packs, lifted, entries, settings)
    short = check_device_room(on_device, settings.device) if on_device else []
    on_card = on_device is not None and not short
    at_once = 1 if on_card else min(len(views), views_at_a_time(threads or len(os.sched_getaffinity(0))))
    if on_card:
        parts["gathered"] = 0  # there W goes to the card block by block
    home = settings.robust_steps or settings.aggregation_resolve  # W comes to the host, wherever it was made
    kept = on_device.kept if on_device and on_card and not home else 0
    weights = all_weight_bytes(entries, len(views), settings)
    in_files = max(0, weights_in_files(weights) - kept)
    today, free = _in_work(parts, at_once), free_memory()
    return Plan(
        kernel=str(splats.kernel),
        splats=splats.count,
        views=tuple(views),
        left_out=tuple(name for name in names if name not in set(views)),
        there=len(packs.views),
        view_cosine=expected,
        spare=tuple(views[k] for k in spare_views(seen)),
        seen_share=seen.seen_share,
        splats_a_view=seen.splats_a_view,
        entries_a_splat=entries.entries,
        rank=codebook_rank(packs, views),
        dtype=settings.dtype,
        memory=parts,
        in_files=in_files,
        at_once=at_once,
        device=CPU if short else device,
        on_device=on_device if on_card else None,
        features_room=features_room(today, free),
        warnings=(*short, *check_memory(today, free), *check_weights(in_files)),
        told=(
            *frame_warning(cameras),
            *distortion_warning(list(lifted.values())),
            *shape_warnings(packs, list(lifted.values())),
            *dense_warning(entries, weights),
        ),
    )


def _choose_views(
    seen: Visibility, settings: LiftSettings, fly: Callable[[], Pilot]
) -> tuple[list[int], float | None]:
    """The views to lift, ascending, and the cosine that a pilot expects of them, where one was flown.

    They show each splat ``coverage`` times and come to ``view_cosine``, whatever takes more of the same order. Where
    a pilot could spare no more views than it looks at, none is flown and all are taken.
    """
    every = list(range(seen.areas.shape[0]))
    if not settings.coverage and not (settings.view_cosine and len(every) > FEW_VIEWS):
        return every, None
    order = list(view_order(seen))
    least = views_to_show(seen, order, settings.coverage)
    if not settings.view_cosine:
        return sorted(order[:least]), None
    if len(every) <= max(FEW_VIEWS, least + PILOT_VIEWS):
        return every, None
    count, expected = fly().views_for(settings.view_cosine, order, least)
    return sorted(order[:count]), expected


def _in_work(parts: Mapping[str, int], views: int) -> dict[str, int]:
    """Bytes a part with so many views in work."""
    return {name: size * views if name == "view" else size for name, size in parts.items()}
