"""The scene that ships, made from the shared data: ``python -m tests.benchmarks.demo_scene ../shared/data``.

Every third view that has features in ``features_hard``, all splats as SPZ, the truth of the held-out views, and the
table of words, which is the text encoder ``lvis``. The same files come at every run. gsply, a published writer of
SPZ, is installed into an environment of its own.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import torch
import zstandard
from safetensors.numpy import load_file, save

import liftcore as lc
from liftcore.text import BUILT_IN, LVIS_TABLE, open_encoder
from liftcore.values.pack import write_pack
from service.commands.demo import SHIPPED

STRIDE = 3  # of the views with features
PACK = "features_hard"
QUERIES = ("penguin", "pizza", "teapot", "cat", "sofa")  # the last is not there
PICTURED = "view_030"  # of the held-out views, the one that shows all that is asked
GSPLY = "gsply==0.4.6"
# gsply takes the frame as it is: SPZ is right, up, back, a PLY right, down, front. A half turn about x.
TO_SPZ = """
import gsply, sys
data = gsply.plyread(sys.argv[1])
data.means[:, 1:] *= -1
data.quats[:, 2:] *= -1
gsply.write_spz(sys.argv[2], data)
"""


def make(data: Path, out: Path) -> None:
    """Write all files of the scene to ``out`` and the words to where the encoder reads them."""
    source = data / "tabletop"
    out.mkdir(parents=True, exist_ok=True)
    _splats(source / "point_cloud.ply", out / "point_cloud.spz")
    shutil.copyfile(source / "cameras.json", out / "cameras.json")
    truth = json.loads((source / "truth.json").read_text())
    shutil.copyfile(data / "text_tables" / "lvis_clip_vit_b_32.safetensors", LVIS_TABLE)
    open_encoder("lvis").encode(QUERIES)
    _features(source / f"{PACK}.safetensors", truth["feature_views"][::STRIDE], out)
    arrays = load_file(source / "truth.safetensors")
    views = sorted(truth["held_out_views"], key=lambda view: view != PICTURED)
    _compressed(save({f"{view}/mask": arrays[f"{view}/mask"] for view in views}), out / "truth.safetensors.zst")
    entries = [{key: entry[key] for key in ("class", "source", "splats", "license")} for entry in truth["objects"]]
    absent = {phrase: [] for phrase in QUERIES if phrase not in {entry["class"] for entry in entries}}
    truth_file = {"objects": entries, "held_out_views": views, "ask": QUERIES, "phrases": absent}
    (out / "truth.json").write_text(json.dumps(truth_file, indent=1) + "\n")


def _splats(ply: Path, spz: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = Path(folder) / "bin" / "python"
        subprocess.run([python, "-m", "pip", "install", "--quiet", GSPLY], check=True)
        subprocess.run([python, "-c", TO_SPZ, ply, spz], check=True)
    ply_splats, spz_splats = lc.read_splats(ply), lc.read_splats(spz)
    # Rows must stay: the truth is by row. Positions have 12 bits behind the point.
    if not torch.allclose(ply_splats.means, spz_splats.means, rtol=0, atol=2.0**-12):
        sys.exit(f"{spz}: other rows or another frame than {ply}")


def _features(pack: Path, views: list[str], out: Path) -> None:
    features = lc.read_features(pack)
    header = {"encoder": "words of CLIP ViT-B/32 with noise", "text_space": BUILT_IN["lvis"], "normalised": "true"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.safetensors"
        write_pack(path, {view: features[view] for view in views}, header)
        _compressed(path.read_bytes(), out / f"{path.name}.zst")


def _compressed(content: bytes, path: Path) -> None:
    path.write_bytes(zstandard.ZstdCompressor(level=19).compress(content))


def main() -> None:
    """Make the files and print their sizes."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.demo_scene", description=__doc__)
    parser.add_argument("data", type=Path, help="the shared data")
    make(parser.parse_args().data, SHIPPED)
    for file in sorted([*SHIPPED.iterdir(), LVIS_TABLE]):
        print(f"{file.stat().st_size:>9,} {file.name}")


if __name__ == "__main__":
    main()
