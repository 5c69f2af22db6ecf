"""The scripts of ``examples/`` run, and do what they say."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import liftcore as lc
from liftcore.text.table import TableEncoder
from liftcore.values.pack import write_pack
from tests.scenes import write_scene

from .readme import ROOT


@pytest.mark.slow
def test_lift_and_mask_writes_masks_of_all_views_and_the_scores(tmp_path: Path) -> None:
    splats, cameras, pack = write_scene(tmp_path, 3)
    words = TableEncoder("words", ["red", "green", "blue"], np.eye(3, 6, dtype=np.float32))
    write_pack(tmp_path / "with_words.safetensors", lc.read_features(pack), {"encoder": "random"}, table=words)
    pack = tmp_path / "with_words.safetensors"
    script = [sys.executable, str(ROOT / "examples" / "lift_and_mask.py")]
    subprocess.run([*script, str(splats), str(cameras), str(pack), "red", str(tmp_path / "out")], check=True)
    for name, camera in lc.read_cameras(cameras).items():
        mask = np.asarray(Image.open(tmp_path / "out" / "masks" / f"{name}.png"))
        assert mask.shape == (camera.height, camera.width) and set(np.unique(mask)) <= {0, 255}
    columns = lc.read_splats(tmp_path / "out" / "scores.ply").extras
    assert set(columns["selected"].tolist()) <= {0, 1} and columns["score"].shape == (50,)


@pytest.mark.slow
def test_an_encoder_of_ones_own_passes_the_suite() -> None:
    suite = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "examples/test_my_encoder.py"]
    told = subprocess.run(suite, cwd=ROOT, capture_output=True, text=True, check=False)
    assert told.returncode == 0 and "." * 5 in told.stdout, told.stdout
