"""Panoramas: six pinholes cover the photo, its features are resampled to them, and all formats agree."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from camera_files import assert_same, binary_files, text_files, with_json, write_files
from PIL import Image

import liftcore as lc
from liftcore.errors import InvalidCameras, NotFound
from liftcore.evaluate.check import check_scene
from liftcore.io.cameras import read_cameras
from liftcore.query.regions import region_mask, regions_at
from liftcore.query.scene import Scene
from liftcore.query.terms import Region
from liftcore.scene.cameras import Cameras, faces_of
from liftcore.scene.panorama import with_panoramas
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.splats import Splats
from liftcore.solve.diagnostics import shape_warnings
from liftcore.values.lens import as_pinhole_sees
from liftcore.values.lift_file import poses_of
from liftcore.values.pack import as_views, pair

WIDTH, HEIGHT = 128, 64
QUATERNION = (0.6, -0.2, 0.5, 0.1)
SHIFT = (0.3, -0.1, 0.2)
GROUPS = 4


def pose() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrices(np.array(QUATERNION)), SHIFT
    return matrix


def panorama() -> Cameras:
    return Cameras(faces_of("pano", WIDTH, HEIGHT, pose()))


def on_panorama(ray: np.ndarray) -> tuple[float, float]:
    """Project a point as COLMAP's EquirectangularCameraModel does, in independent code."""
    u, v, w = ray
    return (math.atan2(u, w) / (2 * math.pi) + 0.5) * WIDTH, (
        math.atan2(v, math.hypot(u, w)) / math.pi + 0.5
    ) * HEIGHT


def ray_of(x: float, y: float) -> np.ndarray:
    """Return the ray of a pixel in the panorama's camera, the inverse of ``on_panorama``."""
    across, down = (x / WIDTH - 0.5) * 2 * math.pi, (y / HEIGHT - 0.5) * math.pi
    return np.array([math.sin(across) * math.cos(down), math.sin(down), math.cos(across) * math.cos(down)])


def splat_groups() -> Splats:
    """Return four groups of splats around the camera: behind it, above, to the right and in front."""
    generator = np.random.default_rng(0)
    ways = np.array([[0.1, 0, -1], [0, -1, 0.2], [1, 0.1, 0], [0, 0.2, 1]])
    inside = np.repeat(3 * ways, 20, axis=0) + generator.normal(0, 0.25, (20 * GROUPS, 3))
    world = (inside - np.array(SHIFT)) @ pose()[:3, :3]
    count = len(world)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = np.repeat(np.eye(4)[:, :3] - 0.5, 20, axis=0)[:, None]
    arrays = (world, quats, np.full((count, 3), math.log(0.15)), np.full(count, 3.0))
    means, quats, scales, opacities = (torch.tensor(each, dtype=torch.float32) for each in arrays)
    return Splats(means, quats, scales, opacities, sh=torch.tensor(sh, dtype=torch.float32), kernel="3dgs")


def labels() -> np.ndarray:
    """Return the group [1, H, W] i32 that each pixel of the panorama is nearest to, by angle."""
    centres = splat_groups().means.reshape(GROUPS, 20, 3).mean(dim=1).numpy() @ pose()[:3, :3].T + np.array(SHIFT)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    label_map = np.empty((1, HEIGHT, WIDTH), np.int32)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        label_map[0, y, x] = int((centres @ ray_of(x + 0.5, y + 0.5)).argmax())
    return label_map


def test_each_point_is_seen_by_one_face_where_the_photo_shows_it() -> None:
    cameras = panorama()
    for point in np.random.default_rng(1).normal(0, 3, (500, 3)):
        positions = []
        for camera in cameras.values():
            x, y, depth = (camera.viewmat @ [*point, 1])[:3]
            u, v = camera.K[:2] @ [x / depth, y / depth, 1]
            if depth > 0 and 0 <= u < camera.width and 0 <= v < camera.height:
                assert camera.face is not None
                place = camera.face.on_photo(np.array([x / depth]), np.array([y / depth]))
                positions.append([float(axis[0]) for axis in place])
        assert len(positions) == 1
        np.testing.assert_allclose(positions[0], on_panorama(pose()[:3] @ [*point, 1]), atol=1e-9)


def test_colmaps_and_nerfstudios_files_mean_the_same(tmp_path: Path) -> None:
    sensor, image = {1: (17, "EQUIRECTANGULAR", (640.0, 480.0))}, (1, QUATERNION, SHIFT, "pano.jpg")
    to_world = np.linalg.inv(pose()) @ np.diag([1.0, -1.0, -1.0, 1.0])
    frame = {"file_path": "images/pano.jpg", "transform_matrix": to_world.tolist()}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 640, "h": 480, "fl_x": 1.0, "frames": [frame]}
    expected = Cameras(faces_of("pano", 640, 480, pose()))
    for path in (
        write_files(tmp_path / "text", text_files(sensor, [image])),
        write_files(tmp_path / "binary", binary_files(sensor, [image])),
        with_json(tmp_path, document),
    ):
        cameras = read_cameras(path)
        assert_same(cameras, expected)
        assert [view.face for view in cameras.values()] == [view.face for view in expected.values()]
    with pytest.raises(InvalidCameras, match="'pano' size"):
        read_cameras(with_json(tmp_path, document | {"w": 99_999}))
    names = ["pano@front", "pano@up", "rig@a/1", "@left", "x@y"]
    assert with_panoramas(names) == {*names, "pano"}


def test_labels_of_a_face_are_those_of_the_photo() -> None:
    label_map = labels()
    views = pair(as_views({"pano": lc.Regions(label_map, np.eye(GROUPS, dtype=np.float32))}), panorama())[0]
    assert len(views) == 6 and shape_warnings(views, list(panorama().values())) == []
    for name, camera in panorama().items():
        observation = views[name]
        assert isinstance(observation, lc.Regions) and camera.face is not None
        assert (
            tuple(observation.labels.shape)
            == (1, camera.height, camera.width)
            == tuple(views.specs(name)["labels"].shape)
        )
        for y, x in np.ndindex(camera.height, camera.width):
            ray = camera.face.rotation.T @ np.linalg.inv(camera.K) @ [x + 0.5, y + 0.5, 1]
            u, v = (int(place) for place in on_panorama(ray))
            assert int(observation.labels[0, y, x]) == label_map[0, min(v, HEIGHT - 1), min(u, WIDTH - 1)]


def test_grid_goes_on_over_the_photos_seam() -> None:
    rays = np.array([[ray_of(x + 0.5, y + 0.5) for x in range(WIDTH)] for y in range(HEIGHT)], np.float32)
    for camera in panorama().values():
        observation = as_pinhole_sees(lc.FeatureGrid(rays), camera)
        assert isinstance(observation, lc.FeatureGrid) and camera.face is not None
        rows, columns = observation.grid.shape[:2]
        for y, x in np.ndindex(rows, columns):
            place = [(x + 0.5) * camera.width / columns, (y + 0.5) * camera.height / rows, 1]
            ray = camera.face.rotation.T @ np.linalg.inv(camera.K) @ place
            np.testing.assert_allclose(observation.grid[y, x].numpy(), ray / np.linalg.norm(ray), atol=0.03)


def test_objects_all_around_are_lifted_and_queried_by_their_masks() -> None:
    splats, cameras = splat_groups(), panorama()
    regions = lc.Regions(labels(), np.eye(GROUPS, dtype=np.float32))
    result = lc.lift(splats, cameras, {"pano": regions}, preset="row-sum")
    assert set(result.views) == {f"pano@{turn}" for turn in ("front", "right", "back", "left", "up", "down")}
    assert result.features.float().argmax(dim=1).tolist() == [row // 20 for row in range(20 * GROUPS)]
    faces = {name: as_pinhole_sees(regions, camera) for name, camera in cameras.items()}
    of_faces = lc.lift(splats, cameras, faces, preset="row-sum")  # maps of the faces themselves
    assert torch.equal(result.features, of_faces.features)
    foldered = pair(as_views({f"set/{name}": expected for name, expected in faces.items()}), cameras)[0]
    assert shape_warnings(foldered, list(cameras.values())) == []
    for name, expected in faces.items():
        actual = foldered[name]
        assert isinstance(actual, lc.Regions) and isinstance(expected, lc.Regions)
        assert torch.equal(actual.labels, expected.labels)
    assert result.metadata.poses == poses_of([cameras[view] for view in result.views])
    scene = Scene(result, splats, cameras, as_views({"pano": regions}))
    camera = cameras["pano@back"]
    [region] = regions_at(scene, "pano@back", camera.width // 2, camera.height // 2)
    assert region.example == "region:pano@back:0:0"  # the group behind
    assert region_mask(scene, Region("pano@back", 0, 0)).shape == (camera.height, camera.width)
    with pytest.raises(NotFound):
        regions_at(scene, "other@back", 1, 1)


def test_photos_of_panoramas_are_checked_face_by_face(tmp_path: Path) -> None:
    splats, cameras = splat_groups(), panorama()
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [0, 0, 0]], np.uint8)  # of the groups
    Image.fromarray(colours[labels()[0]]).save(tmp_path / "pano.png")
    report = check_scene(splats, cameras, {"pano": tmp_path / "pano.png"})
    assert len(report.views) == 6 and all(view.psnr is not None for view in report.views)
    assert not [note for note in report.notes if "no camera" in note or "have none" in note]
    regions = lc.Regions(np.arange(64 * 80, dtype=np.int32).reshape(1, 64, 80) // 1280, np.eye(4, dtype=np.float32))
    check_scene(splats, cameras, {"pano": tmp_path / "pano.png"}, as_views(dict.fromkeys(cameras, regions)))
