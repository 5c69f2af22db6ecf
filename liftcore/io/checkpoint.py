"""Checkpoints of trainers: gsplat's ``.pt`` and nerfstudio's ``.ckpt``, of which the splats are plain tensors.

gsplat on several GPUs writes one file of each rank, ``ckpt_29999_rank0.pt`` and so on, each with other splats. Their
folder is the complete scene: the files of the last step, in the order of ranks (`liftcore.io.ranks`).

They are pickles. Torch's reader for weights alone opens them, which builds tensors and runs no code of the file; what
it refuses is refused. HTTP does not accept them all the same.
"""

from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.kinds import EXPORT_PLY, TRAINED
from liftcore.io.quantised import Fields
from liftcore.io.ranks import missing_ranks, rank_files
from liftcore.runtime.one_line import join_names
from liftcore.scene.render_mode import mode_beside

# Fields of `Splats` -> names of the two trainers.
GSPLAT = {"means": "means", "quats": "quats", "log_scales": "scales", "opacity_logits": "opacities"}
GSPLAT_COLOUR = ("sh0", "shN")
NERFSTUDIO_COLOUR = ("features_dc", "features_rest")
NERFSTUDIO = ("_model.gauss_params.", "_model.")  # before the names, in newer and older versions


def _rank_warnings(path: Path) -> tuple[str, ...]:
    """Warn of splats of the same step that were not read."""
    files = rank_files(path)
    siblings = [file.name for file in files if file.name != path.name]
    if not path.is_dir() and siblings:
        names = join_names(siblings, 3)
        return (f"{names} beside {path.name} holds further splats of the same step: give their folder to take all",)
    missing = missing_ranks(files) if path.is_dir() else []
    return (f"the checkpoint of rank {missing[0]} is missing, and its splats with it",) if missing else ()


def read_checkpoint(path: Path, *, colour: bool = True) -> Fields:
    """Read the fields of a checkpoint's splats, or of all ranks in a folder, in the frame of their training.

    Raises:
        InvalidSplats: a file holds more than tensors and plain values, or no splats of either trainer.
    """
    files = rank_files(path) if path.is_dir() else [path]
    parts = [_read_one(file, colour=colour) for file in files]
    fields: Fields = parts[0]
    if len(parts) > 1:
        shapes = [{name: values.shape[1:] for name, values in part.items()} for part in parts]
        if any(shape != shapes[0] for shape in shapes):
            got = f"tensors in {files[0].name} that other ranks do not have, or with other shapes"
            raise InvalidSplats(
                str(path), expected="ranks of one training", got=got, hint="keep one run in the folder"
            )
        fields = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return fields | {"render_mode": mode_beside(files[0]), "warnings": _rank_warnings(path)}


def _read_one(path: Path, *, colour: bool) -> dict[str, np.ndarray]:
    """Read the fields of one checkpoint.

    Raises:
        InvalidSplats: the file holds more than tensors and plain values, or no splats of either trainer.
    """
    import torch

    # nerfstudio's schedulers store their rates as NumPy scalars: a type and some bytes.
    scalar: Any = np.float64(0).__reduce__()[0]
    numbers = [np.dtype, *(type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64))]
    numbers += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    try:
        with torch.serialization.safe_globals(numbers):
            stored = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # unpickling raises errors of many types
        got = f"one that holds more than tensors, or is damaged ({str(error).splitlines()[0][:100]})"
        raise InvalidSplats(str(path), expected="a checkpoint of tensors", got=got, hint=EXPORT_PLY) from None
    tensors, names = _splats(stored, path)
    fields = {field: _array(tensors, name, path) for field, name in GSPLAT.items()}
    fields["opacity_logits"] = fields["opacity_logits"].reshape(len(fields["opacity_logits"]), -1)[:, 0]
    if colour and names[0] in tensors:
        from liftcore.scene.splats import joined_harmonics

        first, rest = (torch.from_numpy(_array(tensors, name, path)) for name in names)
        fields["sh"] = joined_harmonics(first, rest, (f"{path} {names[0]}", names[1])).numpy()
    return fields


def _splats(stored: Any, path: Path) -> tuple[dict[str, Any], tuple[str, str]]:
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
    raise InvalidSplats(str(path), expected=expected, got=f"a checkpoint of {keys}"[:160], hint=hint)


def _array(tensors: dict[str, Any], name: str, path: Path) -> np.ndarray:
    import torch

    tensor = tensors.get(name)
    if isinstance(tensor, torch.Tensor) and not _is_stored(tensor):
        got = f"a tensor {list(tensor.shape)} that is not stored completely"
        raise InvalidSplats(f"{path} {name}", expected="floats, a row a splat", got=got[:160], hint=EXPORT_PLY)
    if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point() or not tensor.ndim or not len(tensor):
        got = (
            f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
            if isinstance(tensor, torch.Tensor)
            else "none"
        )
        raise InvalidSplats(f"{path} {name}", expected="floats, a row a splat", got=got, hint=EXPORT_PLY)
    # Map coordinates need more digits than float32 has.
    is_double = name == GSPLAT["means"] and tensor.dtype == torch.float64
    return tensor.detach().to(torch.float64 if is_double else torch.float32).numpy()


def _is_stored(tensor: Any) -> bool:
    """Return True if the file stores every number of a tensor: no strides of zero, no sparse or meta tensor."""
    import torch

    if tensor.layout is not torch.strided or tensor.device.type != "cpu" or tensor.is_quantized:
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()
