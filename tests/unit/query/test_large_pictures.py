"""A view larger than pictures may be is refused in words, by whatever draws it."""

from __future__ import annotations

from pathlib import Path

import pytest

from liftcore.errors import InvalidQuery
from liftcore.io.lift_file import save_lift
from liftcore.io.lift_files import lift_files
from liftcore.query import scene as scenes
from liftcore.query.ask import ask
from liftcore.query.example import OneSplat
from liftcore.query.pictures import render_png
from liftcore.query.query import Query
from liftcore.query.scene import QueryScene
from liftcore.query.scores import rows_at_a_time
from liftcore.query.view_mask import view_mask
from liftcore.settings import LiftSettings
from tests.api.tiny_scene import HEIGHT, WIDTH, make_scene


@pytest.fixture
def scene(tmp_path: Path) -> QueryScene:
    tiny = make_scene()
    for name, content in (("s.ply", tiny.splats), ("c.json", tiny.cameras), ("f.safetensors", tiny.features)):
        (tmp_path / name).write_bytes(content)
    settings = LiftSettings.of(preset="row-sum")
    made = lift_files(tmp_path / "s.ply", tmp_path / "c.json", [tmp_path / "f.safetensors"], settings)
    save_lift(made, tmp_path / "scene.lift")
    return QueryScene.open(tmp_path / "scene.lift")


def test_pictures_have_a_limit(scene: QueryScene, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = ask(scene, Query((OneSplat(0),)))

    def draw(what: str) -> object:
        return view_mask(scene, answer, "middle") if what == "mask" else render_png(scene, "middle", what)

    for what in ("mask", "rgb", "pca", "depth"):
        monkeypatch.setattr(scenes, "MOST_PIXELS", WIDTH * HEIGHT)
        assert draw(what)
        monkeypatch.setattr(scenes, "MOST_PIXELS", WIDTH * HEIGHT - 1)
        with pytest.raises(InvalidQuery, match=f"{WIDTH}x{HEIGHT}"):
            draw(what)


@pytest.mark.parametrize("channels", [1, 512, 65_536, 1 << 26])
def test_rows_are_widened_in_bounded_pieces(channels: int) -> None:
    assert 1 <= rows_at_a_time(channels) <= max(1, (1 << 25) // channels)
