"""Arrays in files from strangers: NumPy's, mapped and never unpickled, and tensors of torch, read as tensors only."""

import math
from pathlib import Path
from tokenize import TokenError
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.io.files import BROKEN_ZIP, open_regular, open_zip

if TYPE_CHECKING:
    from torch import Tensor

# Version 3 is for named columns only, which no array of numbers has.
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# What NumPy raises over a header that is no Python literal, besides its own ValueError.
PARSE_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, RecursionError, MemoryError, TokenError)
NUMBERS = "fiu"  # kinds of NumPy: floats, integers, unsigned integers
BFLOAT16 = np.dtype("V2")  # what NumPy, which has none, makes of them
MOST_UNZIPPED_BYTES = 1 << 32  # of the array of a .npz
ARRAYS, TENSORS = (".npy", ".npz"), (".pt", ".pth")
HINT = "save plain arrays with numpy.save"
Values = TypeVar("Values", np.ndarray, "Tensor")


def open_array(path: Path, kinds: str = NUMBERS) -> np.ndarray:
    """The array of a ``.npy`` file, the only one of a ``.npz`` file, or the tensor of a ``.pt`` or ``.pth`` file.

    Raises:
        InvalidFeatures: as `open_npy`; a ``.npz`` of several arrays, or a ``.pt`` that holds more than a tensor.
    """
    if path.suffix.lower() in TENSORS:
        return _read_tensor(path, kinds)
    return _read_npz(path, kinds) if path.suffix.lower() == ".npz" else open_npy(path, kinds)


def open_npy(path: Path, kinds: str = NUMBERS) -> np.ndarray:
    """Map a ``.npy`` file of numbers, or of what else ``kinds`` allows, in NumPy's letters.

    Raises:
        InvalidFeatures: the file is no ``.npy`` file, holds Python objects, or has another size than it says.
    """
    try:
        with open_regular(path) as handle:
            size = handle.seek(0, 2)
            handle.seek(0)
            dtype = _check_header(handle, size, path, kinds)
        found = np.load(path, mmap_mode="r", allow_pickle=False)
        return _widened(found) if dtype == BFLOAT16 else found
    except OSError as error:
        got = f"one that does not open ({error.strerror})"
        raise InvalidFeatures(str(path), expected="a .npy file", got=got) from None
    except PARSE_ERRORS as error:
        raise _unparsed(path, "a .npy file", error) from None


def _check_header(handle: IO[bytes], size: int, path: Path, kinds: str) -> np.dtype[Any]:
    """The type of an array of so many bytes in all, at whose data the handle then is."""
    version = np.lib.format.read_magic(handle)
    if version not in READERS:
        raise ValueError(f"format version {version}")
    shape, _, dtype = READERS[version](handle)
    if dtype.hasobject or (dtype.kind not in kinds and not (dtype == BFLOAT16 and "f" in kinds)):
        got = "Python objects, which may run code" if dtype.hasobject else str(dtype)
        raise InvalidFeatures(str(path), expected="an array of numbers", got=got, hint=HINT)
    if any(side < 1 for side in shape) or handle.tell() + math.prod(shape) * dtype.itemsize != size:
        expected = f"{dtype} {list(shape)} as its header says"
        raise InvalidFeatures(str(path), expected=expected, got=f"a file of {size} bytes", hint=HINT)
    return dtype


def _widened(stored: np.ndarray) -> np.ndarray:
    """Floats of 16 bits with eight of exponent as f32, whose upper half they are."""
    return (stored.view(np.uint16).astype(np.uint32) << 16).view(np.float32)


def _unparsed(path: Path, expected: str, error: BaseException) -> InvalidFeatures:
    got = f"one that does not parse ({str(error)[:120]})"
    return InvalidFeatures(str(path), expected=expected, got=got, hint=HINT)


def _read_npz(path: Path, kinds: str) -> np.ndarray:
    expected = "a .npz file of one array"
    try:
        with open_zip(path) as archive:
            members = archive.infolist()
            if len(members) != 1:
                some = ", ".join(repr(member.filename[:40]) for member in members[:3])
                raise InvalidFeatures(str(path), expected=expected, got=f"{len(members)}: {some}")
            if members[0].file_size > MOST_UNZIPPED_BYTES:
                got = f"{members[0].file_size} bytes"
                raise InvalidFeatures(str(path), expected=f"at most {MOST_UNZIPPED_BYTES} bytes", got=got)
            with archive.open(members[0]) as handle:
                dtype = _check_header(handle, members[0].file_size, path, kinds)
            with archive.open(members[0]) as handle:
                found = np.lib.format.read_array(handle, allow_pickle=False)
            return _widened(found) if dtype == BFLOAT16 else found
    except (*BROKEN_ZIP, *PARSE_ERRORS) as error:
        raise _unparsed(path, expected, error) from None


def _read_tensor(path: Path, kinds: str) -> np.ndarray:
    import torch

    expected = "a file of one tensor"
    hint = "save it alone, torch.save(tensor, name), or as .npy: numpy.save(name, tensor.cpu().numpy())"
    try:
        with open_regular(path):
            pass
        found = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # unpickling fails in many kinds
        got = f"one that holds more than tensors, or is damaged ({str(error).splitlines()[0][:100]})"
        raise InvalidFeatures(str(path), expected=expected, got=got, hint=hint) from None
    if not isinstance(found, torch.Tensor):
        raise InvalidFeatures(str(path), expected=expected, got=type(found).__name__, hint=hint)
    if found.layout != torch.strided or found.is_quantized or found.device.type != "cpu":
        raise InvalidFeatures(str(path), expected=expected, got=f"a tensor of {found.layout}", hint=hint)
    # A tensor may repeat a few numbers of the file without end.
    if found.untyped_storage().nbytes() < found.numel() * found.element_size() or not found.numel():
        got = f"{list(found.shape)} of {found.untyped_storage().nbytes()} bytes"
        raise InvalidFeatures(str(path), expected="a tensor with all of its numbers", got=got, hint=hint)
    found = found.detach().resolve_conj().resolve_neg()
    array = (found.float() if found.dtype == torch.bfloat16 else found).numpy()
    if array.dtype.kind not in kinds:
        raise InvalidFeatures(str(path), expected="an array of numbers", got=str(found.dtype), hint=hint)
    return array


def without_unit_axes(stored: Values, dimensions: int) -> Values:
    """The array without axes of length 1 that stand before so many dimensions, such as that of a batch of one."""
    extra = max(stored.ndim - dimensions, 0)
    before = next((k for k, side in enumerate(stored.shape[:extra]) if side != 1), extra)
    return stored.reshape(tuple(stored.shape[before:])) if before else stored


def read_floats(path: Path, axes: str) -> np.ndarray:
    """An array of floats of such axes, "M, F": f16, or f32 where it is stored wider; perhaps not finite.

    Axes of length 1 before them are taken off.

    Raises:
        InvalidFeatures: as `open_array`, or it has other axes or no floats.
    """
    stored = open_array(path)
    found = without_unit_axes(stored, len(axes.split()))
    if found.ndim == 3 and found.shape[1] == 1 and axes == "M, F":  # a vector each of M batches of one
        found = found[:, 0]
    if found.ndim != len(axes.split()) or found.dtype.kind != "f" or found.dtype.itemsize > 8:
        got, hint = f"{stored.dtype} {list(stored.shape)}", ""
        if found.ndim > len(axes.split()):
            hint = f"a file is of one view: save each of the {len(found)} under its own name"
            hint = f"{hint}, or take the last axis off: array[..., 0]" if found.shape[-1] == 1 else hint
        elif found.ndim < len(axes.split()):
            hint = f"give it its axes before it is saved: array.reshape({axes})"
        elif found.dtype.kind in "iu":
            hint = "save what the integers stand for, times their scale: array.astype(numpy.float32)"
        raise InvalidFeatures(str(path), expected=f"floats [{axes}]", got=got, hint=hint)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where values are made
        return found.astype(np.float16 if found.dtype.itemsize == 2 else np.float32)
