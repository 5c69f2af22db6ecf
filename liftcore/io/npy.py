"""Arrays in untrusted files: NumPy's, mapped and never unpickled, and tensors of torch, loaded as weights only."""

import math
from pathlib import Path
from tokenize import TokenError
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np

from liftcore.errors import InvalidFeatures, reading
from liftcore.io.files import BROKEN_ZIP, open_regular, open_zip

if TYPE_CHECKING:
    from torch import Tensor

# Version 3 is for structured arrays only.
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# Errors of NumPy for a header that is no Python literal, besides those of zips.
PARSE_ERRORS = (TypeError, SyntaxError, MemoryError, TokenError)
NUMBERS = "fiu"  # kinds of NumPy: floats, integers, unsigned integers
BFLOAT16 = np.dtype("V2")  # NumPy has no bfloat16, and reads it as this
MOST_UNZIPPED_BYTES = 1 << 32  # of the array of a .npz
ARRAYS, TENSORS = (".npy", ".npz"), (".pt", ".pth")
HINT = "save plain arrays with numpy.save"
TENSOR_HINT = "save it alone, torch.save(tensor, name), or as .npy: numpy.save(name, tensor.cpu().numpy())"
Values = TypeVar("Values", np.ndarray, "Tensor")


def open_array(path: Path, kinds: str = NUMBERS) -> np.ndarray:
    """Open the only array of a ``.npy`` (mapped), ``.npz``, ``.pt`` or ``.pth``; ``kinds`` are NumPy's letters."""
    suffix = path.suffix.lower()
    read = _tensor if suffix in TENSORS else _zipped if suffix == ".npz" else _mapped
    with reading(path, InvalidFeatures, "an array of numbers", TENSOR_HINT if suffix in TENSORS else HINT):
        try:
            return read(path, kinds)
        except (*BROKEN_ZIP, *PARSE_ERRORS) as error:
            if isinstance(error, OSError) or ", got " in str(error):
                raise
            raise ValueError(f"a {suffix} file, got one that does not parse ({str(error)[:120]})") from None


def _mapped(path: Path, kinds: str) -> np.ndarray:
    with open_regular(path) as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        _check_header(handle, size, kinds)
        is_empty = handle.tell() == size  # which cannot be mapped
    array = np.load(path, mmap_mode=None if is_empty else "r", allow_pickle=False)
    return as_floats(array)


def _check_header(handle: IO[bytes], size: int, kinds: str) -> None:
    """Check the header of a file of ``size`` bytes, and leave the handle at the data."""
    version = np.lib.format.read_magic(handle)
    if version not in READERS:
        raise ValueError(f"format version {version}")
    shape, _, dtype = READERS[version](handle)
    if dtype.hasobject or (dtype.kind not in kinds and not (dtype == BFLOAT16 and "f" in kinds)):
        got = "Python objects, which may run code" if dtype.hasobject else str(dtype)
        raise ValueError(f"an array of numbers, got {got}")
    if any(side < 0 for side in shape) or handle.tell() + math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"{dtype} {list(shape)} as its header says, got a file of {size} bytes")


def as_floats(array: np.ndarray) -> np.ndarray:
    """Convert bfloat16, the upper half of a float32, to f32; an array of another type is returned as it is."""
    if array.dtype != BFLOAT16:
        return array
    return (array.view(np.uint16).astype(np.uint32) << 16).view(np.float32)


def _zipped(path: Path, kinds: str) -> np.ndarray:
    with open_zip(path) as archive:
        members = archive.infolist()
        if len(members) != 1:
            file_names = ", ".join(repr(member.filename[:40]) for member in members[:3])
            raise ValueError(f"a .npz file of one array, got {len(members)}: {file_names}")
        if members[0].file_size > MOST_UNZIPPED_BYTES:
            raise ValueError(f"at most {MOST_UNZIPPED_BYTES} bytes, got {members[0].file_size} bytes")
        with archive.open(members[0]) as handle:
            _check_header(handle, members[0].file_size, kinds)
        with archive.open(members[0]) as handle:
            array = np.lib.format.read_array(handle, allow_pickle=False)
        return as_floats(array)


def _tensor(path: Path, kinds: str) -> np.ndarray:
    import torch

    tensor = load_tensors(path)
    if not isinstance(tensor, torch.Tensor):
        raise ValueError(f"a file of one tensor, got {type(tensor).__name__}")
    if not is_stored(tensor) or not tensor.numel():
        raise ValueError(f"a tensor with all of its numbers, got {list(tensor.shape)} without them")
    array = (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).detach().numpy()
    if array.dtype.kind not in kinds:
        raise ValueError(f"an array of numbers, got {tensor.dtype}")
    return array


def load_tensors(path: Path, hint: str = "save its tensors by torch.save") -> Any:
    """Load a file of torch for weights alone, which runs no code of the file; an error ends by the hint."""
    import torch

    open_regular(path).close()
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # unpickling raises errors of many types
        got = f"one that holds more than tensors, or is damaged ({str(error).splitlines()[0][:100]})"
        raise ValueError(f"a file of tensors alone, got {got.replace(';', ',')}; {hint}") from None


def is_stored(tensor: "Tensor") -> bool:
    """Return True if the file stores every number of a tensor: no strides of zero, no sparse or meta tensor."""
    import torch

    if tensor.layout is not torch.strided or tensor.device.type != "cpu" or tensor.is_quantized:
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def without_unit_axes(stored: Values, dimensions: int) -> Values:
    """Remove leading axes of length 1 beyond ``dimensions``, such as that of a batch of one."""
    extra = max(stored.ndim - dimensions, 0)
    before = next((k for k, side in enumerate(stored.shape[:extra]) if side != 1), extra)
    return stored.reshape(tuple(stored.shape[before:])) if before else stored


def read_floats(path: Path, axes: str) -> np.ndarray:
    """Read an array of floats with axes such as "M, F": f16, or f32 if it is stored wider; perhaps not finite.

    Leading axes of length 1 are removed. Rows "M, F" may be none, [0, 0] whatever the file's shape.
    """
    stored = open_array(path)
    if not stored.size and axes == "M, F":
        return np.zeros((0, 0), np.float32)
    array = without_unit_axes(stored, len(axes.split()))
    if array.ndim == 3 and array.shape[1] == 1 and axes == "M, F":  # a vector each of M batches of one
        array = array[:, 0]
    if array.ndim != len(axes.split()) or array.dtype.kind != "f" or array.dtype.itemsize > 8:
        got, hint = f"{stored.dtype} {list(stored.shape)}", ""
        if array.ndim > len(axes.split()):
            hint = f"a file is of one view: save each of the {len(array)} under its own name"
            hint = f"{hint}, or take the last axis off: array[..., 0]" if array.shape[-1] == 1 else hint
        elif array.ndim < len(axes.split()):
            hint = f"give it its axes before it is saved: array.reshape({axes})"
        elif array.dtype.kind in "iu":
            hint = "save what the integers stand for, times their scale: array.astype(numpy.float32)"
        raise InvalidFeatures(str(path), expected=f"floats [{axes}]", got=got, hint=hint)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such later
        return array.astype(np.float16 if array.dtype.itemsize == 2 else np.float32)
