"""LangSplat's language features: masks at several levels and one embedding a mask.

``IMG_s.npy`` [L, H, W] holds mask ids, -1 for none, counted on over the levels, so that an id is a row of
``IMG_f.npy`` [M, F]. Occam's LGS, OpenGaussian, LaGa and VALA write the same files.
"""

from pathlib import Path

from liftcore.errors import InvalidFeatures
from liftcore.features.masks import mask_ids
from liftcore.features.views import Regions
from liftcore.io.npy import ViewFolder, npy_files, open_npy, read_floats

LABELS, CODEBOOK = "_s.npy", "_f.npy"


def langsplat_views(folder: Path) -> ViewFolder[Regions]:
    """The regions of a folder of ``IMG_s.npy`` and ``IMG_f.npy`` files, and of its sub-folders.

    Raises:
        InvalidFeatures: the folder has no such files, or a map lacks its embeddings. Reading a view: a file is
            malformed, an id has no embedding, or an embedding is not finite.
    """
    files = npy_files(folder, LABELS)
    labels = {path.relative_to(folder).as_posix().removesuffix(LABELS): path for path in files}
    codebooks = {view: path.with_name(path.name.removesuffix(LABELS) + CODEBOOK) for view, path in labels.items()}
    for view, path in codebooks.items():
        if not path.is_file():
            got = f"{labels[view].name} alone"
            raise InvalidFeatures(str(folder), expected=f"embeddings in {path.name}", got=got)

    def read(view: str) -> Regions:
        codebook = read_floats(codebooks[view], "M, F")
        ids = mask_ids(open_npy(labels[view]), len(codebook), labels[view])
        return Regions(ids, codebook, where=f"view {view!r}")

    return ViewFolder(labels, read, codebooks.values())
