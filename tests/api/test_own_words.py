"""A lift of a pack with words is asked in these over HTTP, without an encoder that the operator set up."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.features.pack import write_pack
from liftcore.features.views import Regions
from liftcore.query.text.table import TableEncoder
from service.models import AssetKind

from .following import ended
from .test_labels import put
from .test_problems import assert_problem
from .tiny_scene import codebook, labels

if TYPE_CHECKING:
    from pathlib import Path

    from fastapi.testclient import TestClient

    from .conftest import Uploaded


def test_words_of_a_pack_are_asked_over_http(client: TestClient, uploaded: Uploaded, tmp_path: Path) -> None:
    words = TableEncoder("phrases", ["left thing", "right thing"], codebook()[[0, 2]])
    views = {name: Regions(found, codebook()) for name, found in labels().items()}
    write_pack(tmp_path / "pack", views, {"text_space": "prompts"}, table=words)
    pack = put(client, AssetKind.FEATURES, (tmp_path / "pack").read_bytes())
    job = ended(client, client.post("/lift", json=uploaded.order() | {"features": [pack]}).headers["location"])
    lift = client.get(job["links"]["lift"]).json()
    assert (lift["text_space"], lift["words"]) == ("prompts", ["left thing", "right thing"])
    for text in ("Left_thing", "right thing"):
        answer = client.get("/query", params={"lift": lift["id"], "text": text, "top": 1}).json()
        assert (answer["count"], answer["clear"], answer["encoder"]) == (20, True, "prompts")
        assert (answer["top"][0]["splat"] < 20) == (text == "Left_thing")
    problem = assert_problem(client.get("/query", params={"lift": lift["id"], "text": "apple"}))
    assert problem["status"] == 422 and "the lift's own words" in problem["detail"]
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(f"/assets/{pack}").status_code == 204
