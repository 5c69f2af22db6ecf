"""Whether assets belong together, from what their checks found: told at once rather than by a failed job."""

from __future__ import annotations

from collections.abc import Sequence

from liftcore.errors import InvalidFeatures
from service.store.assets import AssetRecord
from service.wire import JobKind

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
    known = set(cameras.counts["names"])
    if not known & owner.keys():
        raise InvalidFeatures(
            "features",
            expected="views named like the cameras",
            got=f"views {_examples(owner)} and cameras {_examples(known)}, none in common",
            hint="a view is named after its image, without the extension",
        )


def scratch_bytes(kind: JobKind, splats: AssetRecord, features: Sequence[AssetRecord]) -> int:
    """What a job writes to the disk at least while it runs: a trade-off keeps the features of its exact run."""
    if kind is not JobKind.TRADEOFF:
        return 0
    return splats.counts.get("splats", 0) * (1 + features[0].counts["channels"]) * FLOAT_BYTES


def _examples(names: dict[str, str] | set[str]) -> str:
    return ", ".join(repr(name) for name in sorted(names)[:3])
