"""The main job over HTTP for distorted photos: what comes back lies over the photos as they were taken."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from tests.distorted_scene import HEIGHT, VIEWS, WIDTH, photo_of, write_distorted_scene

from .conftest import serving
from .following import ended

LENS = "barrel"
CLEAR = 0.1  # from the border of a quarter: two standard deviations of a splat
RIM = 20  # pixels, beyond which a barrel's photo may show more than its pinhole was lifted from


@dataclass(frozen=True)
class Wall:
    """The distorted scene in an application of its own, lifted."""

    client: TestClient
    cameras: str
    lift: str

    def of(self, **parameters: Any) -> dict[str, Any]:
        """The parameters of a request on the lift."""
        return {"lift": self.lift, **parameters}


@pytest.fixture(scope="module")
def wall(table: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wall]:
    folder = tmp_path_factory.mktemp("distorted")
    paths = write_distorted_scene(folder / "scene", LENS)
    with serving(folder / "data", table) as client:
        replies = [
            client.put(f"/assets/{kind}", content=path.read_bytes())
            for kind, path in zip(("splats", "cameras", "features"), paths, strict=True)
        ]
        assert [reply.status_code for reply in replies] == [201, 201, 201]
        splats, cameras, features = (reply.json()["id"] for reply in replies)
        order = {"splats": splats, "cameras": cameras, "features": [features], "settings": {"preset": "row-sum"}}
        job = ended(client, client.post("/lift", json=order).headers["location"])
        assert job["state"] == "succeeded", job
        yield Wall(client, cameras, job["id"])


def test_upload_tells_that_photos_are_distorted(wall: Wall) -> None:
    asset = wall.client.get(f"/assets/{wall.cameras}").json()
    assert (asset["counts"]["distorted"], asset["counts"]["sizes"]) == (len(VIEWS), [f"{WIDTH}x{HEIGHT}"])
    assert any("photos as they were taken" in warning for warning in asset["warnings"])


@pytest.mark.parametrize("view", VIEWS)
def test_mask_of_a_picked_pixel_lies_over_the_distorted_photo(wall: Wall, view: str) -> None:
    photo = photo_of(view, LENS, CLEAR)
    photo[:RIM] = photo[-RIM:] = photo[:, :RIM] = photo[:, -RIM:] = -1
    for part in np.unique(photo[photo >= 0]):
        places = np.argwhere(photo == part)
        y, x = places[len(places) // 2]
        answer = wall.client.get("/query/mask", params=wall.of(like=f"{view}:{x},{y}", view=view, threshold=0.5))
        assert answer.status_code == 200, answer.text
        mask = np.asarray(Image.open(io.BytesIO(answer.content))) > 0
        assert mask.shape == (HEIGHT, WIDTH)
        found, truth = mask & (photo >= 0), photo == part
        assert (found & truth).sum() / (found | truth).sum() > 0.99


def test_pictures_and_pixels_are_of_the_photo(wall: Wall) -> None:
    for what in ("rgb", "depth", "pca"):
        picture = wall.client.get("/render", params=wall.of(view="left", what=what))
        assert Image.open(io.BytesIO(picture.content)).size == (WIDTH, HEIGHT)
    beyond = wall.client.get("/query", params=wall.of(like=f"left:{WIDTH},0"))
    assert beyond.status_code == 422
    assert f"x in 0..{WIDTH - 1} and y in 0..{HEIGHT - 1}" in beyond.json()["detail"]
