"""What a viewer draws of a lift: its splats, colours by row, and its cameras."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from liftcore.io.splat import ROW
from liftcore.query.scene import QueryScene

from .test_problems import assert_problem
from .tiny_scene import FOCAL, HEIGHT, SPLATS_A_CLUSTER, VIEWS, WIDTH, WORDS, TinyScene, splat_rows


def test_splats_come_in_the_rows_of_the_lift(client: TestClient, lift: dict[str, Any]) -> None:
    reply = client.get(f"/lifts/{lift['id']}/splats")
    rows, lifted = np.frombuffer(reply.content, ROW), splat_rows()
    assert reply.status_code == 200 and len(rows) == lift["count"] == len(lifted)
    assert int(reply.headers["content-length"]) == 32 * len(lifted)
    np.testing.assert_array_equal(rows["means"], lifted[:, :3])
    np.testing.assert_allclose(rows["scales"], np.exp(lifted[:, 7:10]), rtol=1e-6)
    np.testing.assert_allclose(
        rows["colours"][:, :3] / 255, np.clip(0.5 + 0.282095 * lifted[:, 3:6], 0, 1), atol=3e-3
    )
    np.testing.assert_allclose(rows["colours"][:, 3] / 255, 1 / (1 + np.exp(-lifted[:, 6])), atol=3e-3)
    assert (rows["quats"] == (255, 128, 128, 128)).all()
    again = client.get(f"/lifts/{lift['id']}/splats", headers={"If-None-Match": reply.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("what", ["pca", "evidence", "agreement"])
def test_each_splat_has_a_colour_in_each_layer(client: TestClient, lift: dict[str, Any], what: str) -> None:
    reply = client.get(f"/lifts/{lift['id']}/colours", params={"what": what})
    colours = np.load(io.BytesIO(reply.content), allow_pickle=False)
    assert (colours.shape, colours.dtype) == ((lift["count"], 3), np.uint8)
    if what == "pca":  # three words, so three colours that lie apart
        means = colours.reshape(3, SPLATS_A_CLUSTER, 3).mean(axis=1)
        assert min(np.abs(means[one] - means[other]).max() for one, other in ((0, 1), (0, 2), (1, 2))) > 60
    assert client.get(f"/lifts/{lift['id']}/colours", params={"what": "pca"}).headers["etag"] is not None


def test_clusters_are_asked_of_a_lift_that_has_them(client: TestClient, lift: dict[str, Any]) -> None:
    problem = assert_problem(client.get(f"/lifts/{lift['id']}/colours", params={"what": "cluster"}))
    assert (problem["status"], problem["argument"]) == (422, "what") and "aggregation" in problem["hint"]


def test_views_have_their_poses_in_pages(client: TestClient, lift: dict[str, Any]) -> None:
    whole = client.get(f"/lifts/{lift['id']}/views").json()
    assert whole["next"] is None and [view["name"] for view in whole["views"]] == list(VIEWS)
    first = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2}).json()
    rest = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2, "cursor": first["next"]}).json()
    assert first["views"] + rest["views"] == whole["views"] and rest["next"] is None
    for view in whole["views"]:
        assert view["lifted"] == (view["name"] in lift["views"])
        assert (view["width"], view["height"], view["fx"]) == (WIDTH, HEIGHT, FOCAL)
        pose = np.array(view["viewmat"])
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], (VIEWS[view["name"]], 0, 0), atol=1e-6)


def test_objects_are_there_without_words_and_a_table_names_them(
    client: TestClient, lift: dict[str, Any], scene: TinyScene
) -> None:
    route = lift["links"]["objects"]
    whole = client.get(route).json()
    assert (whole["count"], whole["next"], whole["encoder"]) == (3, None, None)
    assert [one["id"] for one in whole["objects"]] == [0, 1, 2]
    assert all(one["name"] is None and set(one["views"]) <= set(VIEWS) for one in whole["objects"])
    assert sum(one["splats"] for one in whole["objects"]) == lift["count"]
    pages = [client.get(route, params={"limit": 2, "cursor": first}).json() for first in (0, 2)]
    assert pages[0]["objects"] + pages[1]["objects"] == whole["objects"]
    assert (pages[0]["next"], pages[1]["next"]) == (2, None)
    table = client.put("/assets/table", content=scene.table).json()["id"]
    for how in ({"table": table}, {"encoder": "default"}, {"encoder": lift["text_space"]}):
        named = client.get(route, params={**how, "features": True}).json()["objects"]
        for one in named:
            middle = one["centre"][0]
            assert one["name"] == WORDS[round(middle / 1.2) + 1] and one["score"] > 0.9
            assert one["box"]["low"][0] < middle < one["box"]["high"][0] and len(one["feature"]) == lift["channels"]
    ply = client.get(f"{route}/1/splats")
    rows = np.frombuffer(ply.content[ply.content.index(b"end_header\n") + 11 :], "<f4").reshape(-1, 14)
    assert len(rows) == whole["objects"][1]["splats"]
    assert np.abs(rows[:, 0] - whole["objects"][1]["centre"][0]).max() < 0.5


@pytest.mark.parametrize(
    ("path", "how", "status"),
    [
        ("objects", {"table": "sha256:" + "0" * 64}, 404),
        ("objects", {"table": "sha256:" + "0" * 64, "encoder": "default"}, 422),
        ("objects", {"encoder": "nowhere"}, 422),
        ("objects", {"limit": 0}, 422),
        ("objects/3/splats", {}, 404),
        ("objects/-1/splats", {}, 422),
    ],
)
def test_wrong_questions_for_objects_are_problems(
    client: TestClient, lift: dict[str, Any], path: str, how: dict[str, Any], status: int
) -> None:
    assert assert_problem(client.get(f"/lifts/{lift['id']}/{path}", params=how))["status"] == status


def test_other_kernels_are_shown_as_near_gaussians() -> None:
    from liftcore.query.export import viewer_splats
    from liftcore.scene.splats import Splats

    means, quats, logits = np.zeros((2, 3), "f4"), np.zeros((2, 4), "f4"), np.array([np.inf, -np.inf], "f4")
    discs = Splats(means, quats, np.log(np.full((2, 2), 0.5, "f4")), logits, "2dgs")
    betas = Splats(means, quats, np.zeros((2, 3), "f4"), logits, "dbs", beta=np.zeros(2, "f4"))
    shown = []
    for splats in (discs, betas):
        scene = QueryScene.__new__(QueryScene)
        scene.__dict__["splats"] = splats
        shown.append(np.frombuffer(b"".join(viewer_splats(scene)), ROW))
    np.testing.assert_allclose(shown[0]["scales"], [[0.5, 0.5, 0.005]] * 2, rtol=1e-5)
    np.testing.assert_allclose(shown[1]["scales"], np.sqrt(1 / 12), rtol=1e-5)  # (1 - r^2)^4 in the image
    assert shown[0]["colours"].tolist() == [[153, 153, 153, 255], [153, 153, 153, 0]]  # no colours: grey
    assert (shown[0]["quats"][:, 0] == 255).all()  # of no length: no turn


def test_regions_at_a_pixel_are_examples_to_ask_by(client: TestClient, lift: dict[str, Any]) -> None:
    at, lamp = f"/lifts/{lift['id']}/regions", {"view": "middle", "x": 26, "y": 12}
    (region,) = client.get(at, params=lamp).json()["regions"]
    assert (region["example"], region["level"], region["region"]) == ("region:middle:0:2", 0, WORDS.index("lamp"))
    answer = client.get("/query", params={"lift": lift["id"], "like": region["example"], "threshold": 0.5}).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {WORDS.index("lamp")}
    where = {name: region[name] for name in ("view", "level", "region")}
    mask = client.get(f"{at}/mask", params=where)
    pixels = np.asarray(Image.open(io.BytesIO(mask.content)))
    assert pixels.shape == (HEIGHT, WIDTH) and pixels[12, 26] == 255 and pixels.mean() == 255 * region["share"]
    for path, asked, status in ((at, lamp | {"x": WIDTH}, 422), (at, lamp | {"view": "nowhere"}, 404),
                                (f"{at}/mask", where | {"region": 3}, 404)):  # fmt: skip
        assert assert_problem(client.get(path, params=asked))["status"] == status
