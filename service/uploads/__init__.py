"""Uploads: a body on its way to a checked file (`intake`), and the process that checks it (`check`)."""

from __future__ import annotations

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput, InvalidMasks, InvalidSplats, InvalidTable
from service.models import AssetKind

# What a malformed file of a kind is told as.
INVALID: dict[AssetKind, type[InvalidInput]] = {
    AssetKind.SPLATS: InvalidSplats,
    AssetKind.CAMERAS: InvalidCameras,
    AssetKind.FEATURES: InvalidFeatures,
    AssetKind.MASKS: InvalidMasks,
    AssetKind.TABLE: InvalidTable,
}
