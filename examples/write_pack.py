# pyright: strict
# pyright: reportUnknownVariableType=false
# safetensors leaves a type open
"""Write a feature pack without splatlift, from label maps and vectors of your own.

python examples/write_pack.py labels vectors features.safetensors

``labels/VIEW.npy`` [h, w], or [L, h, w] for several levels, holds rows of ``vectors/VIEW.npy`` [M, F]; -1 is none.
For a dense map [h, w, F] write the one tensor ``VIEW/grid`` in place of the two.
"""

import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file


def main(labels: str, vectors: str, out: str) -> None:
    """Write ``out`` with the labels and the codebook of each view."""
    tensors: dict[str, np.ndarray] = {}
    for path in sorted(Path(labels).glob("*.npy")):
        # safetensors writes memory as it lies, so arrays must be contiguous
        tensors[f"{path.stem}/labels"] = np.ascontiguousarray(np.load(path), np.int32)
        tensors[f"{path.stem}/codebook"] = np.ascontiguousarray(np.load(Path(vectors) / path.name), np.float16)
    save_file(tensors, out, metadata={"encoder": "my encoder", "text_space": "none", "normalised": "true"})


if __name__ == "__main__":
    main(*sys.argv[1:4])
