"""The scene that ships with the project: 12 published splat objects on a table, and regions with CLIP's words.

No photo went through CLIP: a region's vector is the text vector of its word with noise, moved so far from all words
as vectors of photos are (cosine .29 to its own word, .22 to others). Of the masks 30 % are merged with a neighbour,
15 % split, 10 % of another word. Sources and licences are in ``tabletop/LICENCES.md``; what made the files is
``tests/benchmarks/demo_scene.py``.
"""

from __future__ import annotations

from pathlib import Path

SHIPPED = Path(__file__).with_name("tabletop")


def unpack_tabletop(folder: Path) -> Path:
    """Write the scene as a folder of plain files: splats, cameras, a pack of 18 views, truth; the folder."""
    import zstandard

    folder.mkdir(parents=True, exist_ok=True)
    for file in SHIPPED.iterdir():
        content = file.read_bytes()
        if file.suffix == ".zst":
            (folder / file.stem).write_bytes(zstandard.ZstdDecompressor().decompress(content))
        else:
            (folder / file.name).write_bytes(content)
    return folder
