"""NumPy files from strangers: mapped, never unpickled, believed as far as their size goes."""

import math
from pathlib import Path
from tokenize import TokenError

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.io.files import open_regular

# Version 3 is for named columns only, which no array of numbers has.
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# What NumPy raises over a header that is no Python literal, besides its own ValueError.
PARSE_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, RecursionError, MemoryError, TokenError)
NUMBERS = "fiu"  # kinds of NumPy: floats, integers, unsigned integers
HINT = "save plain arrays with numpy.save"


def open_npy(path: Path, kinds: str = NUMBERS) -> np.ndarray:
    """Map a ``.npy`` file of numbers, or of what else ``kinds`` allows, in NumPy's letters.

    Raises:
        InvalidFeatures: the file is no ``.npy`` file, holds Python objects, or has another size than it says.
    """
    try:
        with open_regular(path) as handle:
            version = np.lib.format.read_magic(handle)
            if version not in READERS:
                raise ValueError(f"format version {version}")
            shape, _, dtype = READERS[version](handle)
            offset, size = handle.tell(), handle.seek(0, 2)
        if dtype.hasobject or dtype.kind not in kinds:
            got = "Python objects, which may run code" if dtype.hasobject else str(dtype)
            raise InvalidFeatures(str(path), expected="an array of numbers", got=got, hint=HINT)
        if any(side < 1 for side in shape) or offset + math.prod(shape) * dtype.itemsize != size:
            expected = f"{dtype} {list(shape)} as its header says"
            raise InvalidFeatures(str(path), expected=expected, got=f"a file of {size} bytes", hint=HINT)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        got = f"one that does not open ({error.strerror})"
        raise InvalidFeatures(str(path), expected="a .npy file", got=got) from None
    except PARSE_ERRORS as error:
        got = f"one that does not parse ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected="a .npy file", got=got, hint=HINT) from None


def read_floats(path: Path, axes: str) -> np.ndarray:
    """An array of floats of such axes, "M, F": f16, or f32 where it is stored wider; perhaps not finite.

    Raises:
        InvalidFeatures: as `open_npy`, or it has other axes or no floats.
    """
    stored = open_npy(path)
    if stored.ndim != len(axes.split()) or stored.dtype.kind != "f" or stored.dtype.itemsize > 8:
        got = f"{stored.dtype} {list(stored.shape)}"
        raise InvalidFeatures(str(path), expected=f"floats [{axes}]", got=got)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where values are made
        return stored.astype(np.float16 if stored.dtype.itemsize == 2 else np.float32)
