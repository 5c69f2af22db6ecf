"""The up direction and the unit of length of a scene: read from files, set by hand, transformed and stored."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import liftcore as lc
from liftcore.errors import InvalidInput
from liftcore.io.splats import read_splats, write_splats
from liftcore.io.transforms import FRAME_FILE
from liftcore.scene.world import UNKNOWN, UPRIGHT, WorldFrame
from tests.unit.scene.test_gltf import FILES, assert_same, join, parts_of, some_splats, write

SIDEWAYS = WorldFrame(up=(3, 4, 0), metres_per_unit=0.25)
WORLDS = [UNKNOWN, UPRIGHT, SIDEWAYS, WorldFrame(up=(0, 1, 0)), WorldFrame(metres_per_unit=40)]


def frames(turn: np.ndarray) -> list[dict[str, Any]]:
    """Return three cameras that stand upright on the ground z = 0, rotated by ``turn``."""
    poses = []
    for angle in (0.0, 1.0, 2.0):
        back = np.array([math.cos(angle), math.sin(angle), 0])
        up = np.array([0, 0, 1.0])
        pose = np.eye(4)
        pose[:3, :3] = turn @ np.stack([np.cross(up, back), up, back], axis=1)
        poses.append({"file_path": f"{angle}.png", "transform_matrix": pose.tolist()})
    return poses


def nerfstudio(folder: Path, turn: np.ndarray, **fields: Any) -> Path:
    folder.mkdir(exist_ok=True)
    document = {"w": 64, "h": 48, "fl_x": 50, "frames": frames(turn), **fields}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder / "transforms.json"


TIPPED = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z to y


def test_nerfstudio_says_that_z_is_up_where_its_cameras_stand_so(tmp_path: Path) -> None:
    applied = {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2.0}
    cameras = lc.read_cameras(nerfstudio(tmp_path, np.eye(3), **applied))
    assert cameras.world == WorldFrame(up=(0, 0, 1)), "an applied scale is a ratio, and no length"
    assert lc.read_cameras(nerfstudio(tmp_path, TIPPED, **applied)).world == UNKNOWN
    assert lc.read_cameras(nerfstudio(tmp_path, np.eye(3))).world == UNKNOWN, "another program's has no convention"
    frame = {"transform": np.column_stack([TIPPED.T, np.zeros(3)]).tolist(), "scale": 0.5}
    (tmp_path / FRAME_FILE).write_text(json.dumps(frame))
    assert lc.read_cameras(nerfstudio(tmp_path, TIPPED)).world == WorldFrame(up=(0, 0, 1))


def test_a_frame_moves_with_its_scene() -> None:
    matrix = np.column_stack([4.0 * TIPPED, np.zeros(3)])
    splats = replace(some_splats(), world=WorldFrame(up=(0, 0, 1), metres_per_unit=2))
    cameras = lc.Cameras([lc.Camera.pinhole("a", 8, 8, 8, 8, 4, 4, np.eye(4))], world=splats.world)
    for world in (splats.transformed(matrix).world, cameras.transformed(matrix).world):
        assert world.up == (0, -1, 0) and world.metres_per_unit == pytest.approx(0.5)
    assert splats[:3].world == splats.world


@pytest.mark.parametrize("world", WORLDS, ids=repr)
def test_a_file_has_its_frame_and_its_splats_as_they_were(world: WorldFrame, tmp_path: Path) -> None:
    for origin in ((0.0, 0.0, 0.0), (5e5, -2e4, 300.0)):
        splats = replace(some_splats(), world=world, origin=origin)
        write_splats(tmp_path / "s.glb", splats)
        copy = read_splats(tmp_path / "s.glb")
        assert copy.world == world
        np.testing.assert_allclose(copy.positions(), splats.positions(), rtol=1e-12, atol=1e-6)
        assert_same(replace(copy, origin=splats.origin, means=splats.means), splats)


@pytest.mark.parametrize("world", WORLDS, ids=repr)
def test_other_readers_of_gltf_see_metres_with_y_up(world: WorldFrame, tmp_path: Path) -> None:
    """Read by the format alone, without the metadata that splatlift adds to the file."""
    document, binary = parts_of(write(tmp_path / "s.glb", replace(some_splats(), world=world)))
    del document["asset"]["extras"]
    actual = read_splats(join(tmp_path / "t.glb", document, binary))
    assert actual.world == WorldFrame(up=(0, -1, 0), metres_per_unit=1)
    turn = np.eye(3) if world.up is None else shortest_turn(np.array(world.up), np.array([0, -1.0, 0]))
    matrix = np.column_stack([(world.metres_per_unit or 1.0) * turn, np.zeros(3)])
    assert_same(actual, some_splats().transformed(matrix))


def shortest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the rotation from a to b by Rodrigues' formula; half a turn about z for opposite directions."""
    if np.allclose(a, -b):
        return np.diag([-1.0, -1, 1])
    v, c = np.cross(a, b), float(a @ b)
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + k + k @ k / (1 + c)


def test_gltf_of_others_is_in_metres_with_y_up() -> None:
    assert read_splats(FILES / "degree3.glb").world == WorldFrame(up=(0, -1, 0), metres_per_unit=1)
    assert read_splats(FILES / "degree3.sog.decoded.ply").world == UNKNOWN


WRONG: list[dict[str, Any]] = [
    {"up": (0, 0, 0)}, {"metres_per_unit": 0},
    {"metres_per_unit": True}, {"down": (0, 1, 0)},
]  # fmt: skip


@pytest.mark.parametrize("fields", WRONG, ids=str)
def test_what_is_no_direction_or_length_is_refused_by_its_name(fields: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match=f"^{list(fields)[-1]}.*: expected"):
        WorldFrame(**fields)
