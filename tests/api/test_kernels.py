"""The main job over HTTP for scenes of the other kernels: discs (2DGS) and betas (DBS)."""

from __future__ import annotations

import numpy as np
import pytest
from fastapi.testclient import TestClient

from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.splats import Kernel

from .conftest import Uploaded
from .following import ended
from .tiny_scene import PROPERTIES, SPLATS_A_CLUSTER, WORDS, ply, splat_rows

FLAT = -2.0  # the logarithm of the betas' shape: near to a Gaussian's middle, and narrower at its border


def discs() -> bytes:
    """The tiny scene with two scales a splat; unturned discs face its cameras."""
    kept = [name for name in PROPERTIES if name != "scale_2"]
    return ply(splat_rows()[:, [PROPERTIES.index(name) for name in kept]], kept)


def betas() -> bytes:
    """The tiny scene with colours of DBS, a shape a splat and one lobe."""
    names = [name.replace("f_dc", "sh0") for name in PROPERTIES]
    more = ["beta", *(f"sb_params_{i}" for i in range(6))]
    columns = np.zeros((len(splat_rows()), len(more)), np.float32)
    columns[:, 0] = FLAT
    return ply(np.concatenate([splat_rows(), columns], axis=1), [*names, *more])


@pytest.mark.parametrize(("kernel", "content"), [("2dgs", discs()), ("dbs", betas())], ids=["2dgs", "dbs"])
def test_scene_of_the_kernel_is_uploaded_lifted_and_asked(
    client: TestClient, uploaded: Uploaded, kernel: str, content: bytes
) -> None:
    warm_up(Kernel(kernel))  # compiles, where nobody has yet: that may take longer than `ended` waits
    asset = client.put("/assets/splats", content=content)
    assert asset.status_code == 201, asset.text
    assert asset.json()["counts"]["kernel"] == kernel
    order = uploaded.order(preset="row-sum", certificate_rays=0) | {"splats": asset.json()["id"]}
    job = ended(client, client.post("/lift", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    for cluster, word in enumerate(WORDS):
        asked = {"lift": job["id"], "text": word, "view": "middle", "threshold": 0.5, "top": SPLATS_A_CLUSTER}
        answer = client.get("/query", params=asked).json()
        rows = range(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER)
        assert {splat["splat"] for splat in answer["top"] if splat["score"] >= 0.5} <= set(rows)
        assert 0.8 * SPLATS_A_CLUSTER <= answer["count"] <= 1.2 * SPLATS_A_CLUSTER
        assert client.get(answer["links"]["mask"]).status_code == 200
    picture = client.get("/render", params={"lift": job["id"], "view": "middle"})
    assert picture.headers["content-type"] == "image/png"
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(asset.json()["links"]["self"]).status_code == 204


@pytest.mark.parametrize(
    ("content", "settings", "argument", "said"),
    [
        (discs(), {"kernel": "3dgs"}, "kernel", "'scale_2'"),
        (discs(), {"kernel": "dbs"}, "kernel", "leave it out: the file speaks of 2dgs"),
        (betas(), {"antialiased": True}, "antialiased", "dbs"),
    ],
)
def test_a_kernel_that_does_not_fit_the_splats_is_refused_with_the_order(
    client: TestClient, uploaded: Uploaded, content: bytes, settings: dict, argument: str, said: str
) -> None:
    before = client.get("/jobs").json()
    asset = client.put("/assets/splats", content=content).json()["id"]
    answer = client.post("/lift", json=uploaded.order(**settings) | {"splats": asset})
    assert answer.status_code == 422, answer.text
    assert argument in answer.json()["detail"] and said in answer.text
    assert client.get("/jobs").json() == before
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_splats_of_three_scales_may_be_lifted_as_discs(client: TestClient, uploaded: Uploaded) -> None:
    warm_up(Kernel.GAUSSIAN_2D)
    job = ended(client, client.post("/lift", json=uploaded.order(kernel="2dgs")).headers["location"])
    assert job["state"] == "succeeded", job
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
