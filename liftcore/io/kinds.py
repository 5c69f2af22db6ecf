"""What a file or folder is, by its beginning: so that one in another's place is told as that. Loads no torch."""

import zipfile
from contextlib import suppress
from pathlib import Path

from liftcore.errors import InvalidInput
from liftcore.io.cameras import camera_source
from liftcore.io.files import BROKEN_ZIP
from liftcore.io.splats import is_splats
from liftcore.scene.views import IMAGE_SUFFIXES

LIFT_KEY = "splatlift"  # of the metadata of a lift
PARTS = {"labels", "codebook", "grid"}  # of a feature pack's views


def kind_of(path: Path) -> str | None:
    """What a file or folder looks like, by its beginning; None where it looks like nothing of ours, or does not open.

    Returns:
        splats, cameras, photos (a zip), features, masks, table or lift.
    """
    with suppress(InvalidInput, *BROKEN_ZIP):
        if is_splats(path):
            return "splats"
        if not path.is_file():
            return "cameras" if path.is_dir() and camera_source(path).files else None
        return _kind_in(path)
    return None


def _kind_in(path: Path) -> str | None:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            suffixes = {Path(name).suffix.lower() for name in archive.namelist()}
        return "photos" if suffixes & IMAGE_SUFFIXES else "cameras"
    if not looks_like_safetensors(path):
        with path.open("rb") as handle:
            return "cameras" if handle.read(1) in (b"[", b"{") else None
    keys, metadata = keys_of(path)
    parts = {key.rpartition("/")[2] for key in keys}
    signs = {
        "lift": LIFT_KEY in metadata, "table": keys == {"embeddings"}, "masks": "mask" in parts,
        "features": bool(parts & PARTS),
    }  # fmt: skip
    return next((kind for kind, fits in signs.items() if fits), None)


def looks_like_safetensors(path: Path) -> bool:
    """Whether a file is named or begins like one."""
    with path.open("rb") as handle:
        start = handle.read(9)
    return path.suffix.lower() == ".safetensors" or start[8:] == b"{"


def keys_of(path: Path) -> tuple[set[str], dict[str, str]]:
    """The names of its tensors, and its metadata.

    Raises:
        InvalidInput: it does not open.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="np") as handle:
            return set(handle.keys()), handle.metadata() or {}
    except (SafetensorError, OSError) as error:
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidInput(str(path), expected="a safetensors file", got=got) from None
