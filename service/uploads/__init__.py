"""Uploads: a body on its way to a checked file (`intake`), and the process that checks it (`check`)."""

from __future__ import annotations

from liftcore.errors import (
    InvalidCameras,
    InvalidFeatures,
    InvalidInput,
    InvalidLift,
    InvalidMasks,
    InvalidPhotos,
    InvalidSplats,
    InvalidTable,
)
from service.models import AssetKind, UploadKind

LIFT = "lift"

# What a malformed file of a kind is told as.
INVALID: dict[UploadKind, type[InvalidInput]] = {
    AssetKind.SPLATS: InvalidSplats,
    AssetKind.CAMERAS: InvalidCameras,
    AssetKind.FEATURES: InvalidFeatures,
    AssetKind.MASKS: InvalidMasks,
    AssetKind.TABLE: InvalidTable,
    AssetKind.PHOTOS: InvalidPhotos,
    LIFT: InvalidLift,
}
