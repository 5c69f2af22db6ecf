"""The scripts of ``examples/`` run, and do what they say."""

import contextlib
import io
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import liftcore as lc
from liftcore.text.table import TableEncoder
from liftcore.values.pack import write_pack
from tests import tiny_scene
from tests.promises.tiny_files import write_files
from tests.run_lengths import sam_records
from tests.scenes import write_scene

from .readme import ROOT

pytestmark = pytest.mark.slow


def run(script: str, *arguments: object) -> str:
    """Return the output of an example, which runs in this process, where its libraries are loaded."""
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(str(ROOT / "examples" / script), run_name="__main__")
    return output.getvalue()


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A folder with the files of the tiny scene, whose cluster k is class k and word k."""
    write_files(tmp_path)
    (tmp_path / "labels").mkdir()
    for view, labels in tiny_scene.labels().items():
        Image.fromarray(labels[0].astype(np.uint8)).save(tmp_path / "labels" / f"{view}.png")
    return tmp_path


def test_label_voting_gives_each_splat_its_class_and_how_sure_it_is(tiny: Path) -> None:
    run("label_voting.py", tiny / "s.ply", tiny / "c.json", tiny / "labels", tiny / "voted.ply")
    columns = lc.read_splats(tiny / "voted.ply").extras
    expected = np.repeat(np.arange(3), tiny_scene.SPLATS_A_CLUSTER)
    assert np.array_equal(np.asarray(columns["class_id"]), expected)
    assert (np.asarray(columns["share"]) > 0.5).all() and (np.asarray(columns["entropy"]) < np.log(2)).all()


def test_sam_masks_become_things_that_are_exported(tiny: Path) -> None:
    (tiny / "masks").mkdir()
    for view, labels in tiny_scene.labels().items():
        masks = labels[0] == np.arange(3)[:, None, None]
        np.savez(tiny / "masks" / f"{view}.npz", masks=masks, vectors=tiny_scene.codebook())
    output = run("sam_masks.py", tiny / "s.ply", tiny / "c.json", tiny / "masks", tiny / "things.ply")
    assert output.count("20 splats about") == 3
    assert sorted(np.unique(lc.read_splats(tiny / "things.ply").extras["instance_id"])) == [1, 2, 3]  # 0 is none


def test_training_loop_finds_the_red_blob_alone() -> None:
    assert run("training_loop.py") == "200 of 200 red splats, 0 others\n"


def test_lift_and_mask_writes_masks_of_all_views_and_the_scores(tmp_path: Path) -> None:
    splats, cameras, pack = write_scene(tmp_path, 3)
    words = TableEncoder("words", ["red", "green", "blue"], np.eye(3, 6, dtype=np.float32))
    write_pack(tmp_path / "with_words.safetensors", lc.read_features(pack), {"encoder": "random"}, table=words)
    pack = tmp_path / "with_words.safetensors"
    run("lift_and_mask.py", splats, cameras, pack, "red", tmp_path / "out")
    for name, camera in lc.read_cameras(cameras).items():
        mask = np.asarray(Image.open(tmp_path / "out" / "masks" / f"{name}.png"))
        assert mask.shape == (camera.height, camera.width) and set(np.unique(mask)) <= {0, 255}
    columns = lc.read_splats(tmp_path / "out" / "scores.ply").extras
    assert set(columns["selected"].tolist()) <= {0, 1} and columns["score"].shape == (50,)


def test_written_pack_has_the_labels_and_vectors_of_its_folders(tiny: Path) -> None:
    for name in ("ids", "vectors"):
        (tiny / name).mkdir()
    for view, labels in tiny_scene.labels().items():
        np.save(tiny / "ids" / f"{view}.npy", labels[0])
        np.save(tiny / "vectors" / f"{view}.npy", tiny_scene.codebook())
    run("write_pack.py", tiny / "ids", tiny / "vectors", tiny / "own.safetensors")
    expected = lc.read_features(tiny / "f.safetensors")
    for name, view in lc.read_features(tiny / "own.safetensors").items():
        right = expected[name]
        assert isinstance(view, lc.Regions) and isinstance(right, lc.Regions)
        assert np.array_equal(np.asarray(view.labels), np.asarray(right.labels))
        assert np.allclose(np.asarray(view.codebook.float()), tiny_scene.codebook(), atol=1e-3)


def test_segmented_photos_are_masks_that_are_packed(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a segmenter whose masks are what is of one grey, by the names that the example uses of it."""
    (tiny / "photos").mkdir()
    for view, labels in tiny_scene.labels().items():
        Image.fromarray((80 * labels[0] + 40).astype(np.uint8)).save(tiny / "photos" / f"{view}.jpg")

    def generate(image: np.ndarray) -> list[dict[str, Any]]:
        return sam_records(np.stack([np.rint((image[..., 0] - 40.0) / 80) == k for k in range(3)]))

    module, generator = ModuleType("segment_anything"), SimpleNamespace(generate=generate)
    vars(module)["SamAutomaticMaskGenerator"] = lambda sam, output_mode: generator
    vars(module)["build_sam_vit_h"] = lambda checkpoint: SimpleNamespace(to=lambda device: None)
    monkeypatch.setitem(sys.modules, "segment_anything", module)
    runpy.run_path(str(ROOT / "examples" / "segment_photos.py"))["main"](str(tiny / "photos"), str(tiny / "sam"))
    for view in tiny_scene.VIEWS:
        np.save(tiny / "sam" / f"{view}.npy", tiny_scene.codebook())
    lc.pack_folder(tiny / "sam", tiny / "sam.safetensors", "masks", progress=False)
    view = lc.read_features(tiny / "sam.safetensors")["middle"]
    assert isinstance(view, lc.Regions)
    assert np.array_equal(np.asarray(view.labels), tiny_scene.labels()["middle"])
