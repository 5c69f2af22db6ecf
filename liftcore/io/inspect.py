"""What is in any file of ours, and what looks wrong with it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from liftcore.errors import InvalidInput, InvalidTable
from liftcore.features.pack import read_features
from liftcore.features.views import NO_LABEL, Regions
from liftcore.io.class_masks import describe_masks
from liftcore.io.inspect_scene import inspect_file as inspect_scene
from liftcore.io.inspect_scene import is_splats
from liftcore.query.text.table import plain
from liftcore.solve.lift_warnings import UNSEEN

if TYPE_CHECKING:
    from liftcore.features.pack import FeaturePacks
    from liftcore.features.views import ViewFeatures
    from liftcore.result import LiftMetadata, LiftResult

NARROW = 4  # times longer than wide, or wider: photos are not
UNIT_TOLERANCE = 0.01  # a float16 unit vector of 512 channels is within it
LIFT_KEY = "splatlift"  # of the metadata of a lift


def inspect_file(path: Path) -> dict[str, Any]:
    """Describe a file of splats, cameras, features, masks, a lift or a table of text embeddings.

    Returns:
        ``kind``, ``bytes``, counts and ranges of the kind, and ``warnings``: what looks wrong.

    Raises:
        InvalidInput: the file is missing, malformed or none of these.
    """
    if not path.exists():
        raise InvalidInput(str(path), expected="a file or a folder", got="nothing of that name")
    if path.is_dir() or is_splats(path) or not _looks_like_safetensors(path):
        return inspect_scene(path)
    keys, metadata = _keys(path)
    size = path.stat().st_size
    if LIFT_KEY in metadata:
        from liftcore.io.lift_file import load_lift

        return {"kind": "lift", "bytes": size, **describe_lift(load_lift(path))}
    if keys == {"embeddings"}:
        return {"kind": "table", "bytes": size, **describe_table(path)}
    if any(key.endswith("/mask") for key in keys):
        return {"kind": "masks", "bytes": size, **describe_masks(path)}
    return {"kind": "features", "bytes": size, **describe_packs(read_features(path))}


def _looks_like_safetensors(path: Path) -> bool:
    with path.open("rb") as handle:
        start = handle.read(9)
    return path.suffix.lower() == ".safetensors" or start[8:] == b"{"


def _keys(path: Path) -> tuple[set[str], dict[str, str]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as handle:
            return set(handle.keys()), handle.metadata() or {}
    except (SafetensorError, OSError) as error:
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidInput(str(path), expected="a safetensors file", got=got) from None


def describe_packs(packs: FeaturePacks) -> dict[str, Any]:
    """Read every view: counts, ranges and warnings of feature packs."""
    found = [_describe_view(packs[view], packs.is_regions(view)) for view in packs.views]
    regions = [view for view in found if view["regions"]]
    low = min((view["norms"][0] for view in found if view["norms"]), default=0.0)
    high = max((view["norms"][1] for view in found if view["norms"]), default=0.0)
    return {
        "views": len(packs.views),
        "names": list(packs.views),
        "region_maps": len(regions),
        "grids": len(found) - len(regions),
        "channels": packs.channels,
        "encoder": packs.encoder,
        "text_space": packs.text_space,
        "normalised": packs.normalised,
        "sizes": sorted({view["size"] for view in found}),
        "codebook_rows": sum(view["rows"] for view in found),
        "norms": {"min": low, "max": high},
        "unlabelled": sum(view["unlabelled"] for view in regions) / len(regions) if regions else 0.0,
        "warnings": _pack_warnings(packs, found, low, high),
    }


def _describe_view(observation: ViewFeatures, regions: bool) -> dict[str, Any]:
    norms = torch.linalg.vector_norm(observation.codebook, dim=1, dtype=torch.float64)
    zero = norms == 0
    ends = [float(value) for value in torch.aminmax(norms[~zero])] if bool((~zero).any()) else []
    view = {"regions": regions, "rows": len(norms), "zero": int(zero.sum()), "norms": ends, "unlabelled": 0.0}
    if isinstance(observation, Regions):
        empty = observation.labels == NO_LABEL
        uses = torch.bincount(observation.labels.flatten() - NO_LABEL, minlength=len(norms) + 1)
        unused = int((uses[1:] == 0).sum())
        levels, height, width = observation.labels.shape
        size = f"{levels} levels of {width}x{height}"
        return {
            **view,
            "sides": (width, height),
            "size": size,
            "unlabelled": float(empty.float().mean()),
            "unused": unused,
        }
    height, width, _ = observation.grid.shape
    return {**view, "sides": (width, height), "size": f"{width}x{height} cells", "unused": 0}


def _pack_warnings(packs: FeaturePacks, found: list[dict[str, Any]], low: float, high: float) -> list[str]:
    rows = sum(view["rows"] for view in found)
    zero = sum(view["zero"] for view in found)
    unused = sum(view["unused"] for view in found)
    empty = sum(view["unlabelled"] == 1.0 for view in found)
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
    if not packs.encoder:
        warnings.append("the pack does not name its encoder")
    narrow = next((view for view in found if max(view["sides"]) > NARROW * min(view["sides"])), None)
    if narrow is not None:
        shape = f"maps of {narrow['size']}, which few images are like"
        warnings.append(f"{shape}: where channels come first, pack them with --layout chw")
    return warnings


def describe_lift(lift: LiftResult) -> dict[str, Any]:
    """Counts, ranges, how it was made, and warnings of a lift."""
    metadata = lift.metadata
    count, channels = lift.features.shape
    return {
        "splats": count,
        "channels": channels,
        "dtype": str(lift.features.dtype).removeprefix("torch."),
        "seen_share": float(lift.seen.float().mean()),
        "evidence": _ends(lift.evidence),
        "agreement": _ends(lift.agreement[lift.seen]),
        "encoder": metadata.encoder,
        "text_space": metadata.text_space,
        "views": len(metadata.views),
        "settings": metadata.settings.model_dump(mode="json"),
        "certificate": metadata.certificate,
        "timings": metadata.timings,
        "version": metadata.version,
        "inputs": [file.path for file in (metadata.splats, metadata.cameras, *metadata.features)],
        "warnings": _lift_warnings(lift, metadata),
    }


def _ends(values: torch.Tensor) -> dict[str, float]:
    if not len(values):
        return {}
    low, high = torch.aminmax(values)
    return {"min": float(low), "mean": float(values.mean()), "max": float(high)}


def _lift_warnings(lift: LiftResult, metadata: LiftMetadata) -> list[str]:
    count = len(lift.features)
    unseen = int((~lift.seen).sum())
    bad = int((~torch.isfinite(lift.features)).any(dim=1).sum())
    warnings = list(metadata.certificate.get("warnings", ()))
    if unseen:
        warnings.append(f"{unseen} of {count} {UNSEEN}")
    if bad:
        warnings.append(f"{bad} of {count} splats have features that are not finite")
    for name, file in (("splats", metadata.splats), ("cameras", metadata.cameras)):
        if not Path(file.path).exists():
            warnings.append(f"the {name} are no longer at {file.path}")
    return list(dict.fromkeys(warnings))


def describe_table(path: Path) -> dict[str, Any]:
    """Counts, ranges and warnings of a table of text embeddings that opens, be it fit for use or not.

    Raises:
        InvalidTable: there is more in the file, so that it may be of another kind too.
    """
    from safetensors import safe_open

    with safe_open(str(path), framework="pt") as handle:
        more = sorted({*handle.keys()} - {"embeddings"})
        if more:
            raise InvalidTable(str(path), expected="embeddings alone", got=f"{more[0][:80]!r} beside them")
        embeddings, metadata = handle.get_tensor("embeddings"), handle.metadata() or {}
    norms = torch.linalg.vector_norm(embeddings.float().reshape(len(embeddings), -1), dim=1)
    words = _words(metadata)
    warnings = [] if len(words) == len(embeddings) else [f"{len(words)} words for {len(embeddings)} rows"]
    if int((norms == 0).sum()):
        warnings.append(f"{int((norms == 0).sum())} rows are zero")
    if twice := len(words) - len(set(map(plain, words))):
        warnings.append(f"{twice} of {len(words)} words come again, and only their first row is read")
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
    except ValueError:
        return []
    return [str(word) for word in words] if isinstance(words, list) else []
