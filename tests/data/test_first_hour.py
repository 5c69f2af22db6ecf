"""What a stranger's first hour met, on real scenes: inputs that contradict each other, and many words at once."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from liftcore.evaluate.check import check_scene
from liftcore.features.encoders.encode import find_images
from liftcore.features.pack import read_features
from liftcore.io.cameras import read_cameras
from liftcore.io.scene_files import lift_files
from liftcore.io.splats import read_splats
from liftcore.query.scene import QueryScene
from liftcore.query.segment import segment
from liftcore.query.text.table import TableEncoder
from liftcore.scene.cameras import Cameras
from liftcore.settings import LiftSettings


@pytest.mark.parametrize("broken", [None, "cameras", "features"])
def test_check_of_plush_tells_broken_inputs_alone(shared_data: Path, tmp_path: Path, broken: str | None) -> None:
    folder = shared_data / "plush"
    cameras, pack = read_cameras(folder / "cameras.json"), folder / "grids.safetensors"
    if broken == "cameras":  # positions times 0.3
        factors = np.ones((4, 4))
        factors[:3, 3] = 0.3
        shrunk = [camera.replace(viewmat=camera.viewmat * factors) for camera in cameras.values()]
        cameras = Cameras(tuple(shrunk))
    if broken == "features":  # bytes [F, h, w] under a shape of [h, w, F]
        grids = {name: grid.transpose(2, 0, 1).copy().reshape(grid.shape) for name, grid in load_file(pack).items()}
        pack = tmp_path / "grids.safetensors"
        save_file(grids, pack)
    photos = find_images([folder / "images"])
    found = check_scene(read_splats(folder / "point_cloud.ply"), cameras, photos, read_features(pack))
    expected = {None: [], "cameras": ["photos"], "features": ["features"]}[broken]
    assert [told.partition(":")[0] for told in found.wrong] == expected


def test_fourteen_words_of_tabletop_are_found_among_many(shared_data: Path) -> None:
    folder = shared_data / "tabletop"
    truth = load_file(folder / "truth.safetensors")["splat_object"]
    files = folder / "point_cloud.ply", folder / "cameras.json", [folder / "features.safetensors"]
    scene = QueryScene(lift_files(*files, LiftSettings.of(view_stride=2, stride=2, certificate_rays=0)))
    encoder = TableEncoder.open(folder / "text_table.safetensors")
    names = [thing["class"] for thing in json.loads((folder / "truth.json").read_text())["objects"]]
    others = [word for word in encoder.words if word not in names]
    absent = np.random.default_rng(0).choice(others, 100, replace=False).tolist()
    found = segment(scene, names + absent, encoder.encode(names + absent))
    assert {named.word for named in found.found} == set(names)
    counted = scene.seen & (scene.evidence > 0.5)
    assert (found.labels == truth)[counted].mean() > 0.9
    alone = segment(scene, names[:7], encoder.encode(names[:7])).labels
    assert (alone[counted & (truth >= 7)] < 0).mean() > 0.5
