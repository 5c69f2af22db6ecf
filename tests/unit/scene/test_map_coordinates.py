"""Scenes in map coordinates: as accurate as at the origin, with every position in the frame of their files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

import liftcore as lc
from liftcore.evaluate.inspect import describe_cameras
from liftcore.io.splats import read_places, read_splats
from liftcore.io.spz import spz_blocks
from liftcore.lifting.planning.views import visibility
from liftcore.query.ask import ask
from liftcore.query.labels import labels
from liftcore.query.objects import objects
from liftcore.query.question import Query
from liftcore.query.render import expected_depth, render
from liftcore.query.scene import Scene
from liftcore.query.segment import segment
from liftcore.query.terms import Vector
from liftcore.query.tree import table_csv, tree
from liftcore.scene.cameras import Camera, Cameras, viewmat_of
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.kernel import Kernel
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.scene.splats import Splats
from liftcore.values.settings import LiftSettings
from tests.promises.bad_files import sog_with
from tests.scenes import random_camera, random_regions, random_splats, splats_at

UTM = np.array([500_000.25, 5_400_000.5, 300.125])


def moved_splats(splats: Splats) -> Splats:
    return replace(splats, means=splats.means.double() + torch.from_numpy(UTM))


def moved_camera(camera: Camera) -> Camera:
    pose = camera.viewmat.copy()
    pose[:3, 3] -= pose[:3, :3] @ UTM
    return camera.replace(viewmat=pose)


def scene_of(kernel: Kernel) -> tuple[Splats, list[Camera], dict[str, Any]]:
    cameras = [random_camera(k, 32 + 5 * k, 24 + 3 * k, name=f"v{k}") for k in range(4)]
    return (
        random_splats(3, 300, kernel=kernel),
        cameras,
        {camera.name: random_regions(k) for k, camera in enumerate(cameras)},
    )


@pytest.mark.parametrize("kernel", list(Kernel))
def test_a_moved_scene_has_the_same_features_pictures_and_plan(kernel: Kernel, tmp_path: Path) -> None:
    splats, cameras, views = scene_of(kernel)
    far_splats, far_cameras = moved_splats(splats), [moved_camera(camera) for camera in cameras]
    settings = LiftSettings.of(dtype="float32", robust=True)
    original = lc.lift(splats, Cameras(cameras), views, settings)
    far = lc.lift(far_splats, Cameras(far_cameras), views, settings)
    far.save(tmp_path / "far.safetensors")
    origin = lc.load_lift(tmp_path / "far.safetensors").metadata.origin
    assert origin == far.metadata.origin == far_splats.origin != FILE_ORIGIN
    assert np.abs(np.array(far_splats.origin) - UTM).max() < 4
    assert torch.equal(far.has_feature, original.has_feature)
    relative_error = (far.features - original.features).norm(dim=1) / original.features.norm(dim=1).clamp_min(1e-9)
    # rays at the edge of a splat may fall on its other side
    assert float(relative_error[original.has_feature].quantile(0.95)) < 1e-3
    assert torch.allclose(far.total_weight, original.total_weight, rtol=1e-2, atol=1e-2)
    first, second = Scene(original, splats, Cameras(cameras)), Scene(far, far_splats, Cameras(far_cameras))
    for name in ("v0", "v3"):
        for a, b in zip(expected_depth(first, name), expected_depth(second, name), strict=True):
            assert np.mean(~np.isclose(a, b, atol=1e-3)) < 0.01
        pictures = (render(scene, name, "rgb").astype(int) for scene in (first, second))
        assert np.abs(next(pictures) - next(pictures)).mean() < 0.1
    params = CompositingParams()
    near, away = (visibility(of, these, params) for of, these in ((splats, cameras), (far_splats, far_cameras)))
    assert np.allclose(near.areas, away.areas, rtol=1e-2, atol=1e-2)
    assert np.allclose(near.centres - near.means[:4], away.centres - away.means[:4], atol=1e-4)


def test_scenes_about_their_own_origin_keep_it_and_their_bits() -> None:
    base = random_splats(1)
    near = np.array([40.0, -300.0, 7.0])
    for splats in (
        base,
        splats_at([[1.0, 2.0, 3.0]]),
        splats_at([[0.001, 2000.0, 3.0]], log_scales=0.0),
        replace(base, means=torch.cat([base.means[:-1], torch.full((1, 3), 1e7)])),  # a floater
        replace(base, means=base.means + torch.tensor(near, dtype=torch.float32)),
        replace(base, means=base.means * 1e5, log_scales=base.log_scales + 11.5),  # millimetres of a house
    ):
        copy = Splats(splats.means.double().numpy(), splats.quats, splats.log_scales, splats.opacity_logits)
        assert copy.origin == FILE_ORIGIN and copy.warnings == ()
        assert torch.equal(copy.means, splats.means)
        assert np.array_equal(copy.positions(), splats.means.numpy())


QUANTISED = Path(__file__).parents[2] / "data" / "splats"  # as splat-transform wrote them
PLACE = np.array([65_536.0, 40_960.0, 512.0])  # scene units; an .spz reaches no further with a hundredth of one


def compressed_ply(path: Path) -> np.ndarray:
    """Write a compressed PLY with translated chunks; return the positions in it, [P, 3] f64."""
    source = QUANTISED / "degree1.compressed.ply"
    ply, positions = PlyData.read(source), read_splats(source).positions().astype(np.float64)
    chunks = ply["chunk"].data
    for axis, name in enumerate("xyz"):
        low, high = (chunks[f"{end}_{name}"] for end in ("min", "max"))
        of_row = np.arange(len(positions)) // 256
        unit = (positions[:, axis] - low[of_row]) / (high - low).astype(np.float64)[of_row]
        low += np.float32(PLACE[axis])
        high += np.float32(PLACE[axis])
        positions[:, axis] = low[of_row] * (1 - unit) + high[of_row].astype(np.float64) * unit
    ply.write(path)
    return positions


def sog(path: Path) -> np.ndarray:
    """Write a SOG with translated bounds; return the positions in it, [P, 3] f64."""
    positions, places = read_splats(QUANTISED / "degree1.sog").positions().astype(np.float64), list[np.ndarray]()

    def translate(meta: dict[str, Any]) -> None:
        low, high = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
        unit = (np.sign(positions) * np.log1p(np.abs(positions)) - low) / (high - low)
        low, high = np.log1p(PLACE - 2), np.log1p(PLACE + 2)
        meta["means"] |= {"mins": low.tolist(), "maxs": high.tolist()}
        places.append(np.expm1(low + unit * (high - low)))

    path.write_bytes(sog_with("degree1.sog", translate))
    return places[0]


def spz(path: Path) -> np.ndarray:
    """Write an ``.spz`` about the origin of its file; return the exact positions of its splats, [P, 3] f64."""
    splats = random_splats(4, 200)
    far_splats = replace(splats, means=(splats.means.double() + torch.from_numpy(PLACE)).float(), origin=FILE_ORIGIN)
    path.write_bytes(b"".join(spz_blocks(far_splats)))
    return far_splats.positions().astype(np.float64)


@pytest.mark.parametrize(("write", "step"), [(compressed_ply, 2e-5), (sog, 2e-5), (spz, 1 / 128)])
def test_quantised_files_far_from_their_origin_keep_their_digits(write: Any, step: float, tmp_path: Path) -> None:
    expected = write(tmp_path / "far")
    actual = read_splats(tmp_path / "far")
    assert actual.origin != FILE_ORIGIN and np.abs(np.array(actual.origin) - PLACE).max() < 16
    assert np.abs(actual.positions() - expected).max() <= step
    assert np.array_equal(read_places(tmp_path / "far"), actual.positions())


def test_cameras_whose_rotation_has_few_digits_stand_where_their_file_says() -> None:
    camera = random_camera(9)
    rotation = camera.viewmat[:3, :3].T.astype(np.float32).astype(np.float64)
    rotation[:, 0] *= 1 + 1e-5  # as of a file with five digits
    far_camera = camera.replace(viewmat=viewmat_of(np.column_stack([rotation, UTM]), "opencv"))
    assert np.abs(far_camera.centre - UTM).max() < 1e-6
    assert np.abs(far_camera.about((500_000.0, 5_400_000.0, 256.0)).centre - (0.25, 0.5, 44.125)).max() < 1e-2
    assert far_camera.about(FILE_ORIGIN) is far_camera
    assert np.allclose(describe_cameras(Cameras([far_camera]))["box"], [UTM, UTM], atol=1e-6, rtol=0)


def positions_of_answers(splats: Splats, cameras: Cameras, views: dict[str, Any]) -> dict[str, Any]:
    """Return every answer that has a position in it, by name: boxes and points [n, 3]."""
    lift = lc.lift(splats, cameras, views, LiftSettings.of(dtype="float32"))
    scene = Scene(lift, splats, cameras)
    vectors = np.eye(6, dtype=np.float32)[:2]
    answer = ask(scene, Query.of((Vector(tuple(vectors[0].tolist())),), threshold=0.2, absent="keep"))
    best, parts = scene.locate(answer, 5), objects(scene, answer)
    words = segment(scene, ["one", "two"], vectors)
    document = labels(scene, words).document
    numbers, views_of = torch.arange(len(lift.features)).int() % 2, torch.zeros(2, 5).int()
    with_objects = replace(
        lift, object=numbers, node=numbers, object_views=views_of, node_views=views_of,
        node_parents=torch.full((2,), -1).int(), node_confidence=torch.ones(2),
        node_features=torch.ones(2, lift.features.shape[1]).half(),
    )  # fmt: skip
    listing = tree(Scene(with_objects, splats, cameras))
    rows = [line.split(",")[5:14] for line in table_csv(listing).decode().splitlines()[1:]]
    return {
        "top": [item.position for item in best.top],
        "box": list(best.box or ()),
        "objects": [point for item in parts.objects for point in (item.centre, *item.box)],
        "words": [point for item in words.named_words for point in item.box],
        "labels": [item["oriented_box"]["centre"] for item in document["instances"]],
        "tree": [point for item in listing.objects for point in (item.centre, *item.box)],
        "table": np.array(rows, float).reshape(-1, 3),
    }


def test_every_answer_with_a_place_is_in_the_frame_of_the_file() -> None:
    splats, cameras, views = scene_of(Kernel.GAUSSIAN_3D)
    near = positions_of_answers(splats, Cameras(cameras), views)
    far = positions_of_answers(moved_splats(splats), Cameras([moved_camera(camera) for camera in cameras]), views)
    for name, places in near.items():
        assert len(places) and np.abs(np.array(far[name]) - np.array(places) - UTM).max() < 1e-3, name
