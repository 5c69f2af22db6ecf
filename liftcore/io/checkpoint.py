"""Checkpoints of trainers: gsplat's ``.pt`` and nerfstudio's ``.ckpt``, of which the splats are plain tensors.

gsplat on several GPUs writes a file of each rank, ``ckpt_29999_rank0.pt`` and so on, each with other splats: one of
them is a part of the scene, and is refused.

They are pickles. Torch's reader for weights alone opens them, which builds tensors and runs no code of the file; what
it refuses is refused. HTTP does not accept them all the same.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.io.npy import is_stored, load_tensors
from liftcore.io.ply import EXPORT_PLY, TRAINED
from liftcore.io.quantised import Fields
from liftcore.scene.render_mode import mode_beside

# Fields of `Splats` -> names of the two trainers.
GSPLAT = {"means": "means", "quats": "quats", "log_scales": "scales", "opacity_logits": "opacities"}
GSPLAT_COLOUR = ("sh0", "shN")
NERFSTUDIO_COLOUR = ("features_dc", "features_rest")
_RANK = re.compile(r"(?P<step>.*)_rank(?P<rank>[0-9]{1,6})\.pt")  # of gsplat's checkpoints
NERFSTUDIO = ("_model.gauss_params.", "_model.")  # before the names, in newer and older versions


def _require_whole(path: Path) -> None:
    """Refuse the checkpoint of one of several ranks, by its name and those beside it."""
    match = _RANK.fullmatch(path.name)
    if match is None:
        return
    other_ranks = (_RANK.fullmatch(file.name) for file in path.parent.iterdir() if file.name != path.name)
    if int(match["rank"]) or any(other and other["step"] == match["step"] for other in other_ranks):
        got = f"{path.name}, the splats of one of several GPUs"
        hint = "join the tensors of all ranks in one checkpoint, or export the scene as .ply"
        raise ValueError(f"a checkpoint of the complete scene, got {got}; {hint}")


def read_checkpoint(path: Path, *, colour: bool) -> Fields:
    """Read the fields of a checkpoint's splats, in the frame of their training."""
    import torch

    _require_whole(path)
    # nerfstudio's schedulers store their rates as NumPy scalars: a type and some bytes.
    scalar: Any = np.float64(0).__reduce__()[0]
    numbers = [np.dtype, *(type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64))]
    numbers += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    with torch.serialization.safe_globals(numbers):
        tensors, names = _splats(load_tensors(path, EXPORT_PLY))
    fields: Fields = {field: _array(tensors, name) for field, name in GSPLAT.items()}
    fields["opacity_logits"] = fields["opacity_logits"].reshape(len(fields["opacity_logits"]), -1)[:, 0]
    if colour and names[0] in tensors:
        from liftcore.scene.splats import joined_harmonics

        first, rest = (torch.from_numpy(_array(tensors, name)) for name in names)
        fields["sh"] = joined_harmonics(first, rest, (f"{path} {names[0]}", names[1])).numpy()
    return fields | {"render_mode": mode_beside(path)}


def _splats(stored: Any) -> tuple[dict[str, Any], tuple[str, str]]:
    """Return the tensors of the splats by gsplat's names, and the names of their colours."""
    inner = stored if isinstance(stored, dict) else {}
    if isinstance(inner.get("splats"), dict):
        return inner["splats"], GSPLAT_COLOUR
    pipeline = inner.get("pipeline")
    pipeline = pipeline if isinstance(pipeline, dict) else {}
    for prefix in NERFSTUDIO:
        if f"{prefix}means" in pipeline:
            parameters = {
                key.removeprefix(prefix): value for key, value in pipeline.items() if str(key).startswith(prefix)
            }
            return parameters, NERFSTUDIO_COLOUR
    keys = ", ".join(map(repr, list(inner)[:4])) if inner else type(stored).__name__
    expected = "the splats of gsplat ('splats') or of nerfstudio ('pipeline')"
    hint = TRAINED if isinstance(stored, tuple) else EXPORT_PLY  # as 3DGS's trainer writes its chkpnt*.pth
    raise ValueError(f"{expected}, got a checkpoint of {keys}; {hint}")


def _array(tensors: dict[str, Any], name: str) -> np.ndarray:
    import torch

    tensor = tensors.get(name)
    got = "none"
    if isinstance(tensor, torch.Tensor):
        if tensor.is_floating_point() and tensor.ndim and len(tensor) and is_stored(tensor):
            # Map coordinates need more digits than float32 has.
            is_double = name == GSPLAT["means"] and tensor.dtype == torch.float64
            return tensor.detach().to(torch.float64 if is_double else torch.float32).numpy()
        got = f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
        got += "" if is_stored(tensor) else ", which is not stored completely"
    raise ValueError(f"floats as {name!r}, a row a splat, got {got}; {EXPORT_PLY}")
