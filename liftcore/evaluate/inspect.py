"""Descriptions of files: counts, ranges, and warnings of what looks wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidInput, InvalidSplats, InvalidTable, reading
from liftcore.evaluate.class_masks import describe_masks
from liftcore.features.smoothness import some_grids, unlike_maps
from liftcore.io.cameras import camera_source, read_cameras
from liftcore.io.formats import SplatFormat
from liftcore.io.kinds import identify
from liftcore.io.npy import as_floats
from liftcore.io.photo_zip import describe_photos
from liftcore.io.ply import EXPORT_PLY, dialect_of
from liftcore.io.safetensors_file import check_arrays, check_header, map_tensors
from liftcore.io.splats import format_of, read_splats, splat_files
from liftcore.runtime.arguments import as_path, check_choice
from liftcore.scene.cameras import Cameras, distortion_warning
from liftcore.scene.compositing import ALPHA_FLOOR
from liftcore.scene.splats import Kernel, Splats
from liftcore.solve.diagnostics import UNSEEN
from liftcore.text.table import EXPECTED as TABLE
from liftcore.text.table import normalize_text
from liftcore.values.lift_file import open_lift
from liftcore.values.pack import read_features
from liftcore.values.views import NO_LABEL, Regions

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.values.lift import Lift
    from liftcore.values.pack import Views
    from liftcore.values.views import ViewFeatures

ANY_KIND = "splats, cameras, features, masks, a text table or a lift"
QUANTILES = {"min": 0.0, "q01": 0.01, "median": 0.5, "q99": 0.99, "max": 1.0}
FAR = 1e5  # scene units; float32 resolves only a hundredth there
TINY = 1e-7  # scene units
LARGEST = 1e300  # replaces infinity, which JSON cannot hold
OFF_CENTRE = 0.1  # of the image's side
MAX_NAMES = 3  # names in a warning
FLAT = 100  # times thinner than wide, as converters store discs
NARROW = 4  # times longer than wide, or wider: photos are not
UNIT_TOLERANCE = 0.01  # a float16 unit vector of 512 channels is within it


def inspect_file(path: Path | str, kind: str = "", *, trusted: bool = True) -> dict[str, Any]:
    """Describe a file of splats, cameras, features, masks, a lift or a table of text embeddings.

    Args:
        path: of the file or folder.
        kind: one of DESCRIPTIONS, or ``photos`` of a zip; empty: it is identified.
        trusted: False rejects splats in formats that may hold code.

    Returns:
        ``kind``, ``bytes``, counts and ranges of the kind, and ``warnings``: what looks wrong.

    Raises:
        InvalidInput: the file is missing, malformed or of no kind, or the kind is unknown.
    """
    path = as_path(path)
    if kind:
        check_choice("kind", kind, DESCRIPTIONS)
    if not path.exists():
        raise InvalidInput(str(path), expected="a file or a folder", got="nothing of that name")
    identified = identify(path)
    kind = kind or ("" if identified.kind == "photos" else identified.kind or "")
    if kind not in DESCRIPTIONS:
        if not identified.recognised and (path.is_dir() or path.suffix.lower() == ".json"):
            describe_camera_file(path)  # raises with what cameras lack
        if identified.kind == "photos":
            hint = "'splatlift encode' and 'splatlift pack masks' make features of photos"
            raise InvalidInput(str(path), expected=ANY_KIND, got="photos", hint=hint)
        raise InvalidInput(str(path), expected=ANY_KIND, got=identified.name, hint=identified.hint)
    if kind == "splats" and not trusted and format_of(path) is SplatFormat.CHECKPOINT:
        got = "a checkpoint of a trainer, which is a Python pickle"
        raise InvalidSplats("splats", expected="a format that holds no code", got=got, hint=EXPORT_PLY)
    description = DESCRIPTIONS[kind](path)  # first, as a reader's error names the missing file
    files = splat_files(path) if kind == "splats" else camera_source(path).files if kind == "cameras" else [path]
    size = sum(file.stat().st_size for file in files)
    return {"kind": kind, "bytes": size, **description}


def describe_splat_file(path: Path) -> dict[str, Any]:
    """Describe a file of splats; the dialect of formats other than PLY is the format's name.

    Raises:
        InvalidSplats: the file is malformed.
    """
    file_format, splats = format_of(path), read_splats(path)
    return describe_splats(splats) | ({} if file_format is SplatFormat.PLY else {"dialect": file_format.label})


def describe_splats(splats: Splats) -> dict[str, Any]:
    """Return counts, ranges (after activation) and warnings of splats."""
    low, high = splats.means.amin(dim=0), splats.means.amax(dim=0)
    opacities = torch.sigmoid(splats.opacity_logits)
    scales = torch.exp(splats.log_scales.double()).clamp(max=LARGEST)
    return {
        "splats": splats.count,
        "kernel": splats.kernel.value,
        "dialect": dialect_of(splats.layout),
        "render_mode": None if splats.render_mode is None else splats.render_mode.model.value,
        "render_mode_source": None if splats.render_mode is None else splats.render_mode.source,
        "sh_degree": splats.sh_degree,
        "extras": sorted(splats.extras),
        "origin": list(splats.origin),
        "box": (torch.stack([low, high]).double() + torch.tensor(splats.origin, dtype=torch.float64)).tolist(),
        "scales": _quantiles(scales),
        "opacities": _quantiles(opacities),
        "warnings": _splat_warnings(splats, scales, opacities),
    }


def describe_camera_file(path: Path) -> dict[str, Any]:
    """Describe a camera file or folder.

    Raises:
        InvalidCameras: the file is malformed.
    """
    return describe_cameras(read_cameras(path))


def describe_cameras(cameras: Cameras) -> dict[str, Any]:
    """Return counts, ranges and warnings of cameras."""
    centres = np.stack([camera.centre for camera in cameras.values()])
    sizes = sorted({"{}x{}".format(*camera.photo_size) for camera in cameras.values()})
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
    flat = values.double().flatten().cpu().numpy()
    values_at = np.quantile(flat, list(QUANTILES.values()), method="nearest")
    return dict(zip(QUANTILES, values_at.tolist(), strict=True))


def _splat_warnings(splats: Splats, scales: Tensor, opacities: Tensor) -> list[str]:
    zero_quats = int((splats.quats == 0).all(dim=1).sum())
    extent = float((splats.means.amax(dim=0).double() - splats.means.amin(dim=0)).max())
    large = int((scales.amax(dim=1) > extent).sum()) if splats.count > 1 and extent > 0 else 0
    tiny = int((scales.amax(dim=1) < TINY).sum())
    far = int((splats.means.abs().amax(dim=1) > FAR).sum())
    faint = int((opacities < ALPHA_FLOOR).sum()) if splats.kernel is not Kernel.BETA else 0
    counts = {
        "have a zero quaternion, which counts as no rotation": zero_quats,
        "are larger than the scene": large,
        f"are smaller than {TINY:g} scene units on every axis": tiny,
        f"lie further than {FAR:g} scene units from the origin, where float32 is coarse": far,
        "have an opacity below 1/255 and are never seen": faint,
    }
    warnings = [*splats.warnings]
    warnings += [f"{count} of {splats.count} splats {finding}" for finding, count in counts.items() if count]
    if splats.sh is None:
        warnings.append("no colour: renders in RGB are not possible")
    if splats.kernel is Kernel.GAUSSIAN_3D and bool((scales[:, 2] * FLAT < scales[:, :2].amin(dim=1)).all()):
        warnings.append("every splat is flat along its third axis: if they are discs of 2DGS, lift with kernel=2dgs")
    return warnings


def _camera_warnings(cameras: Cameras, centres: np.ndarray) -> list[str]:
    photos = {camera.name: camera.lens or camera for camera in cameras.values()}
    off = [
        name
        for name, photo in photos.items()
        if abs(photo.cx / photo.width - 0.5) > OFF_CENTRE or abs(photo.cy / photo.height - 0.5) > OFF_CENTRE
    ]
    warnings = distortion_warning(list(cameras.values())) + list(cameras.warnings)
    if off:
        warnings.append(f"{len(off)} views have their principal point far off the centre, such as {off[0]!r}")
    places = len(np.unique(centres, axis=0))
    if places < len(cameras):
        warnings.append(f"{len(cameras)} views share {places} places")
    return warnings


@dataclass(frozen=True)
class _ViewFacts:
    """Counts and ranges of a view's features."""

    is_regions: bool
    size: str
    sides: tuple[int, int]  # width and height of the map
    rows: int  # of the codebook, or cells
    zero: int  # rows without a length
    unused: int  # rows that no label reads
    unlabelled: float  # share of the labels
    norms: tuple[float, float] | None  # the least and largest of rows with a length
    single_region: bool = False  # True if all labels are of one region


def describe_packs(packs: Views) -> dict[str, Any]:
    """Read every view: counts, ranges and warnings of feature packs."""
    facts = [_view_facts(view) for view in packs.values()]
    regions = [view for view in facts if view.is_regions]
    norms = [view.norms for view in facts if view.norms is not None] or [(0.0, 0.0)]
    low, high = min(least for least, _ in norms), max(largest for _, largest in norms)
    return {
        "views": len(packs),
        "names": list(packs),
        "region_maps": len(regions),
        "grids": len(facts) - len(regions),
        "channels": packs.channels,
        "encoder": packs.encoder,
        "text_space": packs.text_space,
        "normalised": packs.normalised,
        "sizes": sorted({view.size for view in facts}),
        "map_fit": ", ".join(sorted({fit for view in packs if (fit := packs.fit(view))})),
        "codebook_rows": sum(view.rows for view in facts),
        "norms": {"min": low, "max": high},
        "unlabelled": sum(view.unlabelled for view in regions) / len(regions) if regions else 0.0,
        "warnings": [*_pack_warnings(packs, facts, low, high), *unlike_maps(some_grids(packs, packs.views))],
    }


def _view_facts(view: ViewFeatures) -> _ViewFacts:
    norms = torch.linalg.vector_norm(view.codebook, dim=1, dtype=torch.float64)
    nonzero = norms[norms > 0]
    ends = (float(nonzero.min()), float(nonzero.max())) if len(nonzero) else None
    rows, zero = len(norms), len(norms) - len(nonzero)
    if not isinstance(view, Regions):
        height, width, _ = view.grid.shape
        return _ViewFacts(False, f"{width}x{height} cells", (width, height), rows, zero, 0, 0.0, ends)
    levels, height, width = view.labels.shape
    unused = int((torch.bincount(view.labels.flatten() - NO_LABEL, minlength=rows + 1)[1:] == 0).sum())
    unlabelled = float((view.labels == NO_LABEL).float().mean())
    if unlabelled == 1.0 and rows == zero == 1:  # the row that stands for none
        rows = zero = unused = 0
    size = f"{levels} levels of {width}x{height}"
    is_single = bool((view.labels == view.labels[0, 0, 0]).all()) and unlabelled == 0.0
    return _ViewFacts(True, size, (width, height), rows, zero, unused, unlabelled, ends, is_single)


def _pack_warnings(packs: Views, facts: list[_ViewFacts], low: float, high: float) -> list[str]:
    rows = sum(view.rows for view in facts)
    zero = sum(view.zero for view in facts)
    unused = sum(view.unused for view in facts)
    empty = sum(view.unlabelled == 1.0 for view in facts)
    unit = abs(low - 1) < UNIT_TOLERANCE and abs(high - 1) < UNIT_TOLERANCE
    warnings = []
    if packs.normalised and not unit:
        warnings.append(f"the pack says normalised, but its vectors have norms from {low:.4g} to {high:.4g}")
    if packs.normalised is None and not unit:
        warnings.append(f"unnormalised vectors: their norms, from {low:.4g} to {high:.4g}, weigh in a lift")
    if zero:
        warnings.append(f"{zero} of {rows} codebook rows are zero")
    if unused:
        warnings.append(f"{unused} of {rows} codebook rows are read by no label")
    if empty:
        warnings.append(f"{empty} views have no label at all")
    if len(single := [view for view in facts if view.single_region]) > len(facts) / 2:
        warnings.append(
            f"{len(single)} views have one region alone, over all of their pixels: these masks separate nothing"
        )
    if not packs.encoder:
        warnings.append("the pack does not name its encoder")
    narrow = next((view for view in facts if max(view.sides) > NARROW * min(view.sides)), None)
    if narrow is not None:
        shape = f"maps of {narrow.size}, which few images are like"
        warnings.append(f"{shape}: where channels come first, pack them with --layout chw")
    return warnings


def describe_lift(lift: Lift) -> dict[str, Any]:
    """Return counts, ranges, provenance and warnings of a lift."""
    metadata = lift.metadata
    return {
        "splats": len(lift),
        "channels": lift.rows.shape[1],
        "dtype": str(lift.rows.dtype).removeprefix("torch."),
        "feature_share": float(lift.has_feature.float().mean()),
        "total_weight": _ends(lift.total_weight),
        "encoder": metadata.encoder,
        "text_space": metadata.text_space,
        "views": len(metadata.views),
        "settings": metadata.settings.model_dump(mode="json"),
        "diagnostics": lift.diagnostics,
        "timings": metadata.timings,
        "version": metadata.version,
        "inputs": [file.path for file in (metadata.splats, metadata.cameras, *metadata.features)],
        "warnings": _lift_warnings(lift),
    }


def _ends(values: torch.Tensor) -> dict[str, float]:
    if not len(values):
        return {}
    low, high = torch.aminmax(values)
    return {"min": float(low), "mean": float(values.mean()), "max": float(high)}


def _lift_warnings(lift: Lift) -> list[str]:
    count, metadata = len(lift), lift.metadata
    unseen = int((~lift.has_feature).sum())
    is_bad = (~torch.isfinite(lift.rows)).any(dim=1)
    bad = int((is_bad if lift.code is None else is_bad[lift.code.long()]).sum())
    warnings = list(metadata.diagnostics.get("warnings", ()))
    if unseen:
        warnings.append(f"{unseen} of {count} {UNSEEN}")
    if bad:
        warnings.append(f"{bad} of {count} splats have features that are not finite")
    for name, file in (("splats", metadata.splats), ("cameras", metadata.cameras)):
        if not Path(file.path).exists():
            warnings.append(f"the {name} are no longer at {file.path}")
    return list(dict.fromkeys(warnings))


def describe_table(path: Path) -> dict[str, Any]:
    """Return counts, ranges and warnings of a table of text embeddings, whatever its words and rows are.

    Raises:
        InvalidTable: the file has no embeddings [n, F], or other tensors, so that it may be of another kind.
    """
    with reading(path, InvalidTable, TABLE):
        check_header(path)
        tensors, metadata = map_tensors(path)
        if other_tensors := sorted(tensors.keys() - {"embeddings"}):
            raise ValueError(f"embeddings alone, got {other_tensors[0][:80]!r} beside them")
        check_arrays(tensors, {"embeddings": ("f2 f4 V2", "n F")})
        embeddings = as_floats(tensors["embeddings"])
    norms = torch.linalg.vector_norm(torch.from_numpy(embeddings).float(), dim=1)
    words = _words(metadata)
    warnings = [] if len(words) == len(embeddings) else [f"{len(words)} words for {len(embeddings)} rows"]
    if int((norms == 0).sum()):
        warnings.append(f"{int((norms == 0).sum())} rows are zero")
    if repeats := len(words) - len(set(map(normalize_text, words))):
        warnings.append(f"{repeats} of {len(words)} words come again, and only their first row is read")
    return {
        "rows": len(embeddings),
        "channels": embeddings.shape[-1],
        "encoder": metadata.get("encoder", metadata.get("model", "")),
        "words": words,
        "norms": _ends(norms),
        "warnings": warnings,
    }


def _words(metadata: dict[str, str]) -> list[str]:
    try:
        words = json.loads(metadata.get("words", "[]"))
    except (ValueError, RecursionError):
        return []
    return [str(word) for word in words] if isinstance(words, list) else []


DESCRIPTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {  # by kind
    "splats": describe_splat_file,
    "cameras": describe_camera_file,
    "features": lambda path: describe_packs(read_features(path)),
    "masks": describe_masks,
    "table": describe_table,
    "lift": lambda path: describe_lift(open_lift(path)),
    "photos": describe_photos,
}
