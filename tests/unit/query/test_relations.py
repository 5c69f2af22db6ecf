"""Spatial relations of objects, on a table of boxes of splats whose relations follow from their construction."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidInput, InvalidQuery
from liftcore.query.relations import relations, upright
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.scene.world import WorldFrame

STEP = 0.1


def shell(low: tuple[float, ...], high: tuple[float, ...], *, lid: bool = True) -> np.ndarray:
    """The surface of a box, as points STEP apart; without a lid the top is open."""
    axes = [np.arange(a, b + STEP / 2, STEP) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    faces = (np.abs(points - low) < 1e-6) | (np.abs(points - high) < 1e-6)
    if not lid:
        faces[:, 2] = np.abs(points[:, 2] - low[2]) < 1e-6
    return points[faces.any(axis=1)]


POINTS = {
    "table": shell((0, 0, 0), (6, 4, 0.2)),
    "bowl": shell((1, 1, 0.3), (2.5, 2.5, 1.2), lid=False),
    "apple": shell((1.5, 1.5, 0.45), (2.0, 2.0, 0.95)),
    "book": shell((3, 1, 0.3), (4, 2, 0.6)),
    "lamp": shell((1, 1, 3), (4, 3, 3.5)),
    "tree": shell((30, 30, 0), (31, 31, 5)),
}
ROWS = np.split(
    np.arange(sum(map(len, POINTS.values()))), np.cumsum([len(points) for points in POINTS.values()])[:-1]
)


def scene(turn: np.ndarray, clouds: Iterable[np.ndarray] = tuple(POINTS.values())) -> Splats:
    means = np.concatenate(list(clouds)) @ turn.T
    count = len(means)
    return Splats(
        means=torch.tensor(means).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), float(np.log(STEP / 3))),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )


def relations_of(turn: np.ndarray, up: tuple[float, float, float] | None) -> set[tuple[str, str, str]]:
    splats, names = scene(turn), list(POINTS)
    pairs = relations(splats, ROWS, np.ones(splats.count), WorldFrame(up=up))
    return {(names[pair.node], pair.relation, names[pair.other]) for pair in pairs}


ROTATION = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])  # the table's up is the frame's -x


@pytest.mark.parametrize(("turn", "up"), [(np.eye(3), (0, 0, 2.0)), (ROTATION, (-3.0, 0, 0))])
def test_things_lie_as_they_were_put(turn: np.ndarray, up: tuple[float, float, float]) -> None:
    triples = relations_of(turn, up)
    assert {
        ("bowl", "on", "table"), ("book", "on", "table"), ("table", "under", "bowl"), ("apple", "inside", "bowl"),
        ("table", "under", "lamp"), ("book", "under", "lamp"), ("bowl", "beside", "book"),
    } <= triples  # fmt: skip
    assert not any("tree" in triple for triple in triples) and ("lamp", "on", "table") not in triples
    assert ("apple", "beside", "bowl") not in triples and ("table", "on", "bowl") not in triples


def test_without_up_nothing_is_on_another() -> None:
    triples = relations_of(np.eye(3), None)
    assert {relation for _, relation, _ in triples} == {"touching", "inside"}
    assert ("table", "touching", "bowl") in triples and ("table", "touching", "lamp") not in triples


def circling(turn: np.ndarray, *, roll: float = 0.0, over: float = np.pi) -> list[Camera]:
    """Cameras that look down at a table from a part of a circle around it, each rolled by so many times its angle."""
    cameras = []
    for angle in np.linspace(0, over, 9):
        forward = np.array([np.cos(angle), np.sin(angle), -0.8]) / np.hypot(1, 0.8)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        tilt = roll * angle
        sides = np.cos(tilt) * right + np.sin(tilt) * down, np.cos(tilt) * down - np.sin(tilt) * right
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([*sides, forward]) @ turn.T
        cameras.append(Camera.pinhole("", 64, 48, 50.0, 50.0, 32.0, 24.0, viewmat))
    return cameras


def test_what_stands_before_a_slanting_wall_is_not_inside_of_it() -> None:
    side, height = np.meshgrid(np.arange(-5, 5, STEP), np.arange(0, 6, STEP))
    wall = np.stack([0.3 * side, side, height], axis=-1).reshape(-1, 3)  # its box is as deep as a cupboard
    cup = shell((0.8, -0.2, 2), (1.2, 0.2, 2.4))
    diagonal = np.array([[1, -1, 0], [1, 1, 0], [0, 0, 2**0.5]]) / 2**0.5
    hut = shell((-4, -4, 0), (4, 4, 5)) @ diagonal.T
    for around, expected in ((wall, False), (hut, True)):
        splats, rows = scene(np.eye(3), (around, cup)), [np.arange(len(around)), len(around) + np.arange(len(cup))]
        pairs = relations(splats, rows, np.ones(splats.count), WorldFrame())
        assert any(pair.relation == "inside" for pair in pairs) == expected


@pytest.mark.parametrize("over", [2 * np.pi, np.pi / 2, 0.6])
def test_up_is_that_of_cameras_that_look_down(over: float) -> None:
    for turn in (np.eye(3), ROTATION):
        assert np.array(upright(circling(turn, over=over))) @ turn[:, 2] > np.cos(np.deg2rad(5))


def test_cameras_that_are_rolled_have_no_up() -> None:
    with pytest.raises(InvalidQuery, match="up: expected cameras that are upright"):
        upright(circling(np.eye(3), roll=2.0, over=2 * np.pi))


def test_an_up_without_a_direction_is_refused() -> None:
    with pytest.raises(InvalidInput, match="up: expected"):
        relations_of(np.eye(3), (0.0, 0.0, 0.0))


def test_gaps_are_in_metres_where_a_unit_is_known() -> None:
    splats, rows = scene(np.eye(3)), np.ones(sum(map(len, ROWS)))
    up = (0.0, 0.0, 1.0)
    in_units, metres = (relations(splats, ROWS, rows, WorldFrame(up=up, metres_per_unit=m)) for m in (None, 0.5))
    assert [pair.gap for pair in metres] == [pair.gap / 2 for pair in in_units] and any(pair.gap for pair in in_units)
