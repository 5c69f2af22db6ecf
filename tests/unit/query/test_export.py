"""Answers as splat files: the object alone, and the scene in the colours of its scores."""

from pathlib import Path

import numpy as np
import pytest

from liftcore.io.splats import read_splats
from liftcore.query.ask import ask
from liftcore.query.colours import NOT_SEEN_COLOUR, colour_map
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.query.terms import Vector
from liftcore.scene.harmonics import SH_C0
from tests.promises.tiny_files import write_lift
from tests.tiny_scene import AXES, ply, splat_rows


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """The lifted tiny scene with one more splat that no camera sees."""
    behind = splat_rows()[:1].copy()
    behind[0, 2] = 40.0
    return Scene(write_lift(tmp_path, splats=ply(np.concatenate([splat_rows(), behind]))))


def test_scores_have_the_colours_of_the_map_and_what_was_not_seen_is_grey(scene: Scene, tmp_path: Path) -> None:
    answer = ask(scene, Query.of((Vector(tuple(AXES[2])),), threshold=0.5))
    assert not answer.has_feature[-1]
    scene.export(tmp_path / "scores.ply", answer, "coloured")
    sh = read_splats(tmp_path / "scores.ply").sh
    assert sh is not None
    colours = np.round(255 * (0.5 + SH_C0 * sh[:, 0].double().numpy())).astype(int)
    assert tuple(colours[-1]) == NOT_SEEN_COLOUR
    best, worst = int(answer.scores[:-1].argmax()), int(answer.scores[:-1].argmin())
    assert np.array_equal(colours[best], colour_map()[-1]) and np.array_equal(colours[worst], colour_map()[0])
    map_colours = {tuple(colour) for colour in colour_map().tolist()}
    assert {tuple(colour) for colour in colours[:-1].tolist()} <= map_colours
