"""Whether assets belong together, from what their checks found: told at once rather than by a failed job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from liftcore.errors import InvalidFeatures, InvalidSettings, InvalidSplats
from liftcore.io.splats import require_kernel
from liftcore.scene.compositing import check_antialiased
from liftcore.scene.kernel import Kernel
from liftcore.scene.panorama import with_panoramas
from liftcore.scene.views import cameras_of_views, require_pairs, some_of
from liftcore.text.table import nearest_words, plain
from liftcore.values.settings import LiftSettings
from service.errors import InvalidRequest
from service.models import JobKind
from service.store.assets import AssetRecord, kernel_of
from service.store.jobs import JobOrder

FLOAT_BYTES = 2  # at least: of float16, which features are unless told otherwise


def check_fit(cameras: AssetRecord, features: Sequence[AssetRecord]) -> None:
    """Refuse features that cannot make a lift with these cameras.

    Raises:
        InvalidFeatures: a view is in two packs, packs differ in channels, or no view has a camera.
    """
    owner: dict[str, str] = {}
    for pack in features:
        for view in pack.counts["names"]:
            if view in owner:
                got = f"{view!r} in {owner[view]} and {pack.id}"
                raise InvalidFeatures("features", expected="each view in one pack", got=got)
            owner[view] = pack.id
    channels = {pack.counts["channels"]: pack.id for pack in features}
    if len(channels) > 1:
        got = " and ".join(f"{count} in {pack}" for count, pack in channels.items())
        raise InvalidFeatures("features", expected="packs with the same channels", got=got)
    require_pairs(owner, with_panoramas(cameras.counts["names"]))


def check_settings(settings: LiftSettings, features: Sequence[AssetRecord], *, in_blocks: bool) -> None:
    """Refuse settings that need masks where no pack has any, and what an engine cannot work on in blocks.

    Raises:
        InvalidSettings: as `LiftSettings` has it.
    """
    masks = any(pack.counts.get("region_maps", 1) for pack in features)  # where nothing was counted the job tells
    settings.finds_objects(masks)
    settings.asks_consensus(masks)
    if in_blocks:
        settings.check_blocks(masks)


def check_kernel(splats: AssetRecord, settings: Mapping[str, Any]) -> None:
    """Refuse a kernel that the splats lack a property of, and what the kernel has no meaning for.

    Raises:
        InvalidSettings: ``kernel`` or ``antialiased`` does not fit the file, of which the header is read.
    """
    own, kernel = kernel_of(splats, {}), kernel_of(splats, settings)
    check_antialiased(Kernel(kernel), LiftSettings.of(**settings).antialiased is True)
    if kernel == own:
        return
    try:
        require_kernel(splats.path, Kernel(kernel), splats.id)
    except InvalidSplats as error:
        got, hint = f"{kernel} for {splats.id}, which has {error.got}", f"leave it out: the file speaks of {own}"
        raise InvalidSettings("kernel", expected=f"a kernel with {error.expected}", got=got, hint=hint) from None


def check_labels(
    order: JobOrder, cameras: AssetRecord, features: Sequence[AssetRecord], masks: AssetRecord, table: AssetRecord
) -> None:
    """Refuse labels that cannot judge lifts of these features.

    Raises:
        InvalidRequest: a class that the table lacks or that is named twice, too few classes, a table of other
            channels, masks of no camera, or no view with features besides those with masks.
    """
    classes = order.parameters["labels"]["classes"]
    words = dict.fromkeys(map(plain, table.counts["words"]))
    for place, word in enumerate(classes):
        if plain(word) not in words:
            raise InvalidRequest(
                f"labels.classes.{place}", expected=f"one of the {len(words)} words of {table.id}",
                got=repr(word[:80]), hint=nearest_words(word, words),
            )  # fmt: skip
    if len(set(map(plain, classes))) < len(classes):
        got = f"{len(classes)} words, some of them the same"
        raise InvalidRequest("labels.classes", expected="each class once", got=got)
    if masks.counts["classes"] > len(classes):
        expected = f"{masks.counts['classes']} words, as the masks name classes 0..{masks.counts['classes'] - 1}"
        raise InvalidRequest("labels.classes", expected=expected, got=f"{len(classes)}")
    channels = features[0].counts["channels"]
    if table.counts["channels"] != channels:
        expected, got = f"a table with {channels} channels, as the features", f"{table.counts['channels']}"
        raise InvalidRequest("labels.table", expected=expected, got=got)
    known = cameras.counts["names"]
    masked = set(cameras_of_views(masks.counts["names"], known).values())
    if not masked:
        raise InvalidRequest(
            "labels.masks",
            expected="masks of views named like the cameras",
            got=f"masks of {some_of(masks.counts['names'])} and cameras {some_of(known)}, none in common",
        )
    named = [view for pack in features for view in pack.counts["names"]]
    views = sorted(cameras_of_views(named, known).values())
    if masked.issuperset(views[:: LiftSettings.of(**order.settings).view_stride]):
        expected = "features of views besides those with masks, which are not lifted"
        raise InvalidRequest("labels.masks", expected=expected, got="masks of all of them")


def scratch_bytes(kind: JobKind, splats: AssetRecord, features: Sequence[AssetRecord]) -> int:
    """What a job writes to the disk at least while it runs: a trade-off keeps the features of its exact run."""
    if kind is not JobKind.TRADEOFF:
        return 0
    return splats.counts.get("splats", 0) * (1 + features[0].counts["channels"]) * FLOAT_BYTES
