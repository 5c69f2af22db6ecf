"""Views of packs and cameras find each other by their names, with or without folders, and never by a guess."""

from __future__ import annotations

import pytest

from liftcore.scene.views import cameras_of_views


@pytest.mark.parametrize(
    ("views", "cameras", "pairs"),
    [
        (["a", "b"], ["b", "c"], {"b": "b"}),
        (["camA/0", "camB/1"], ["0", "1"], {"camA/0": "0", "camB/1": "1"}),  # the scene's names were all unique
        (["0", "1"], ["camA/0", "camA/1", "camB/0"], {"1": "camA/1"}),  # nobody knows which 0 is meant
        (["camA/0", "camB/0"], ["0"], {}),
        (["0", "camA/0"], ["0"], {"0": "0"}),  # the same name comes first
        (["camA/0"], ["images/camA/0"], {"camA/0": "images/camA/0"}),
        (["images/camA/0"], ["camA/0"], {"images/camA/0": "camA/0"}),
        (["train/0"], ["test/0"], {}),  # folders that disagree are other photos
        (["A/0"], ["camA/0"], {}),  # whole folders only
    ],
)
def test_names_pair_as_they_are_or_by_their_last_part_where_it_is_one_of_a_kind(
    views: list[str], cameras: list[str], pairs: dict[str, str]
) -> None:
    assert cameras_of_views(views, cameras) == pairs
    back = {camera: view for view, camera in pairs.items()}
    assert cameras_of_views(cameras, views) == back
