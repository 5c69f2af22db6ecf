"""What is in a file of splats or cameras, and what looks wrong with it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.io.cameras import TRANSFORMS, camera_source, has_nerfstudio_beside, other_models, read_cameras
from liftcore.io.files import SUFFIXES
from liftcore.io.ply import read_splats
from liftcore.io.ply_dialect import nearest_dialect
from liftcore.io.transforms import FRAME_FILE, frame_warning
from liftcore.raster.base import ALPHA_FLOOR
from liftcore.scene.cameras import distortion_warning, photo_size
from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Splats

QUANTILES = {"min": 0.0, "q01": 0.01, "median": 0.5, "q99": 0.99, "max": 1.0}
FAR = 1e5  # scene units; float32 resolves only a hundredth there
TINY = 1e-7  # scene units
LARGEST = 1e300  # shown in place of what overflows, which JSON cannot hold
OFF_CENTRE = 0.1  # of the image's side
OTHER_FRAME = (
    f"the COLMAP model was read, and beside it lies nerfstudio's {TRANSFORMS}, which is in another frame: if "
    f"nerfstudio trained the splats, put its run's {FRAME_FILE} beside them"
)
SHOWN = 3  # names in a warning
MANY = 100  # splats: what all of so many have in common is no accident
MOVING = ("motion_", "trbf_", "omega_")  # what spacetime splats add
FLAT = 100  # times thinner than wide: what converters make of discs


def inspect_file(path: Path) -> dict[str, Any]:
    """Describe a splat file or a camera file or folder, recognised by content.

    Returns:
        ``kind`` (splats or cameras), ``bytes``, counts and ranges, and ``warnings``: what looks wrong.

    Raises:
        InvalidSplats, InvalidCameras: the file is malformed.
    """
    if is_splats(path):
        return {"kind": "splats", "bytes": path.stat().st_size, **describe_splats(read_splats(path))}
    found = describe_camera_file(path)  # first: which of its files are there is told better by who reads them
    size = sum(file.stat().st_size for file in camera_source(path).files)
    return {"kind": "cameras", "bytes": size, **found}


def is_splats(path: Path) -> bool:
    """Whether the file begins like splats, or is named like them or like a checkpoint, if only to be refused."""
    if path.suffix.lower() in (".ply", ".pt", ".pth", ".ckpt", *SUFFIXES):
        return True
    if not path.is_file():
        return False
    with path.open("rb") as handle:
        return handle.read(4) in (b"ply\n", b"ply\r", b"NGSP")


def describe_splats(splats: Splats) -> dict[str, Any]:
    """Counts, ranges (after activation) and warnings of splats."""
    low, high = splats.means.amin(dim=0), splats.means.amax(dim=0)
    opacities = torch.sigmoid(splats.opacity_logits)
    scales = torch.exp(splats.log_scales.double()).clamp(max=LARGEST)
    return {
        "splats": splats.count,
        "kernel": splats.kernel.value,
        "dialect": nearest_dialect(splats.layout),
        "sh_degree": splats.sh_degree,
        "extras": sorted(splats.extras),
        "box": [low.tolist(), high.tolist()],
        "scales": _quantiles(scales),
        "opacities": _quantiles(opacities),
        "warnings": _splat_warnings(splats, scales, opacities),
    }


def describe_camera_file(path: Path) -> dict[str, Any]:
    """The same of a camera file or folder, with a warning of what in it was not read.

    Raises:
        InvalidCameras: the file is malformed.
    """
    found, others = describe_cameras(read_cameras(path)), other_models(path)
    if others:
        found["warnings"].append(f"{len(others)} more COLMAP models were not read: {', '.join(others[:SHOWN])}")
    if found["frame"] is None:
        found["warnings"] += [OTHER_FRAME] if has_nerfstudio_beside(path) else []
    return found


def describe_cameras(cameras: Cameras) -> dict[str, Any]:
    """Counts, ranges and warnings of cameras."""
    centres = np.stack([camera.centre for camera in cameras.values()])
    sizes = sorted({"{}x{}".format(*photo_size(camera)) for camera in cameras.values()})
    focals = [focal for camera in cameras.values() for focal in (camera.fx, camera.fy)]
    return {
        "views": len(cameras),
        "names": list(cameras),
        "sizes": sizes,
        "distorted": len(cameras.distorted),
        "frame": cameras.frame,
        "focal_lengths": {"min": min(focals), "max": max(focals)},
        "box": [centres.min(axis=0).tolist(), centres.max(axis=0).tolist()],
        "warnings": _camera_warnings(cameras, centres),
    }


def _quantiles(values: Tensor) -> dict[str, float]:
    # torch.quantile refuses large inputs; numpy's partition does not.
    flat = values.double().flatten().numpy()
    found = np.quantile(flat, list(QUANTILES.values()), method="nearest")
    return dict(zip(QUANTILES, found.tolist(), strict=True))


def _splat_warnings(splats: Splats, scales: Tensor, opacities: Tensor) -> list[str]:
    zero_quats = int((splats.quats == 0).all(dim=1).sum())
    extent = float((splats.means.amax(dim=0).double() - splats.means.amin(dim=0)).max())
    large = int((scales.amax(dim=1) > extent).sum()) if splats.count > 1 and extent > 0 else 0
    tiny = int((scales.amax(dim=1) < TINY).sum())
    far = int((splats.means.abs().amax(dim=1) > FAR).sum())
    faint = int((opacities < ALPHA_FLOOR).sum()) if splats.kernel is not Kernel.BETA else 0
    counted = {
        "have a zero quaternion, which counts as no rotation": zero_quats,
        "are larger than the scene": large,
        f"are smaller than {TINY:g} scene units on every axis": tiny,
        f"lie further than {FAR:g} scene units from the origin, where float32 is coarse": far,
        "have an opacity below 1/255 and are never seen": faint,
    }
    warnings = [f"{count} of {splats.count} splats {what}" for what, count in counted.items() if count]
    warnings += _reading_warnings(splats)
    if splats.sh is None:
        warnings.append("no colour: renders in RGB are not possible")
    if splats.kernel is Kernel.GAUSSIAN_3D and bool((scales[:, 2] * FLAT < scales[:, :2].amin(dim=1)).all()):
        warnings.append("every splat is flat along its third axis: if they are discs of 2DGS, lift with kernel=2dgs")
    return warnings


def _reading_warnings(splats: Splats) -> list[str]:
    """Files that may mean something else than they say."""
    warnings, many = [], splats.count >= MANY
    logits = splats.opacity_logits
    if many and bool(((logits >= 0) & (logits <= 1)).all()):
        warnings.append(
            "all opacities lie between 0 and 1, as if they were no logits: sigmoid makes them 0.5 to 0.73"
        )
    if many and bool((splats.log_scales > 0).all()):
        warnings.append("all scales are above 0, as if they were no logarithms: exp makes them larger than 1")
    moving = sorted(name for name in splats.extras if name.startswith(MOVING))
    if moving:
        warnings.append(f"properties of moving splats ({moving[0]}, ...) are not read: the scene stands still")
    return warnings


def _camera_warnings(cameras: Cameras, centres: np.ndarray) -> list[str]:
    photos = {camera.name: camera.lens or camera for camera in cameras.values()}
    off = [
        name
        for name, photo in photos.items()
        if abs(photo.cx / photo.width - 0.5) > OFF_CENTRE or abs(photo.cy / photo.height - 0.5) > OFF_CENTRE
    ]
    warnings = distortion_warning(list(cameras.values())) + frame_warning(cameras)
    if off:
        warnings.append(f"{len(off)} views have their principal point far off the centre, such as {off[0]!r}")
    places = len(np.unique(centres, axis=0))
    if places < len(cameras):
        warnings.append(f"{len(cameras)} views share {places} places")
    return warnings
