"""Examples for and against on the tabletop scene: what is not wanted takes away, and what is wanted stays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from liftcore.io.scene_files import lift_files
from liftcore.query.ask import ask
from liftcore.query.scene import QueryScene
from liftcore.query.scores import relevancy
from liftcore.query.terms import OneSplat, Query
from liftcore.settings import LiftSettings
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from pathlib import Path

THINGS, CLOTH, CURTAIN = range(12), 12, 13


class Asked:
    """The scene, asked by the splat of each class that was seen best."""

    def __init__(self, folder: Path) -> None:
        made = lift_files(
            folder / "point_cloud.ply",
            folder / "cameras.json",
            [folder / "features.safetensors"],
            LiftSettings.of(view_stride=4, stride=2),
        )
        self.scene = QueryScene(made)
        self.truth = Tabletop(folder).objects.numpy()
        evidence = made.evidence.numpy()
        self.best = [int(np.argmax(np.where(self.truth == thing, evidence, -1.0))) for thing in range(CURTAIN + 1)]

    def iou(self, thing: int, *unlike: int) -> float:
        """Of the splats found with those of the thing."""
        like, *against = (OneSplat(self.best[other]) for other in (thing, *unlike))
        found = ask(self.scene, Query((like,), tuple(against))).selected
        wanted = (self.truth == thing) & self.scene.seen
        return float((found & wanted).sum() / (found | wanted).sum())


@pytest.fixture(scope="module")
def asked(shared_data: Path) -> Asked:
    return Asked(shared_data / "tabletop")


@pytest.mark.parametrize("unlike", [(CLOTH,), (CURTAIN,), (CLOTH, CURTAIN), None], ids=str)
def test_a_thing_stays_found_when_something_else_is_not_wanted(asked: Asked, unlike: tuple[int, ...] | None) -> None:
    plain = np.array([asked.iou(thing) for thing in THINGS])
    against = np.array([asked.iou(thing, *(unlike or ((thing + 1) % len(THINGS),))) for thing in THINGS])
    assert plain.mean() > 0.9
    assert (against > plain - 0.01).all()


def test_relevancy_alone_finds_nearly_all_that_is_unlike_the_cloth(asked: Asked, monkeypatch) -> None:
    monkeypatch.setattr("liftcore.query.ask.combine", relevancy)
    assert max(asked.iou(thing, CLOTH) for thing in THINGS) < 0.2
