"""The tiny scene over HTTP: its uploads, orders, lifts and deletes, and what replies are read by."""

from __future__ import annotations

import io
import json
import random
import re
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
from PIL import Image

from tests.server import wait_for_end
from tests.tiny_scene import HEIGHT, WIDTH, TinyScene

NO_ID = "0" * 32  # of a job or a lift
NO_ASSET = f"sha256:{'0' * 64}"
INPUTS = ("splats", "cameras", "features")


def assert_problem(reply: Any, status: int | None = None) -> dict[str, Any]:
    """Require a problem of RFC 9457 with all that a person needs; return it."""
    assert reply.headers["content-type"] == "application/problem+json", reply.text
    problem = reply.json()
    assert problem["status"] == reply.status_code, reply.text
    assert reply.status_code == status or (status is None and 400 <= reply.status_code < 500), reply.text
    assert re.fullmatch(r"/problems/[a-z0-9]+(-[a-z0-9]+)*", problem["type"]), problem["type"]
    assert problem["title"] and problem["detail"] and "\n" not in problem["detail"]
    return problem


def upload(client: Any, kind: str, content: bytes, **options: Any) -> str:
    """Upload a file; return its id."""
    reply = client.put(f"/assets/{kind}", content=content, **options)
    assert reply.status_code in (200, 201), reply.text
    return reply.json()["id"]


def upload_scene(client: Any, scene: TinyScene, **options: Any) -> dict[str, Any]:
    """Upload splats, cameras and features; return the body of an order of their lift by `row-sum`."""
    splats, cameras, features = (upload(client, kind, getattr(scene, kind), **options) for kind in INPUTS)
    return {"splats": splats, "cameras": cameras, "features": [features], "settings": {"preset": "row-sum"}}


def lift_of(client: Any, order: dict[str, Any]) -> dict[str, Any]:
    """Order a lift and wait for it; return it."""
    reply = client.post("/lift", json=order)
    assert reply.status_code == 202, reply.text
    job = wait_for_end(client, reply.headers["location"])
    assert job["state"] == "succeeded", job
    return client.get(job["links"]["lift"]).json()


def delete_lift(client: Any, lift: str) -> None:
    """Delete the lift of an id."""
    reply = client.delete(f"/jobs/{lift}", params={"with_lift": True})
    assert reply.status_code == 204, reply.text


def events_of(text: str) -> Iterator[tuple[int, str, Any]]:
    """Yield number, name and data of each event of a stream."""
    for block in text.replace("\r\n", "\n").strip().split("\n\n"):
        fields = dict(re.split(": ?", line, maxsplit=1) for line in block.split("\n") if line and line[0] != ":")
        if fields:
            yield int(fields["id"]), fields["event"], json.loads(fields["data"])


def photos_zip(colour: tuple[int, int, int] = (9, 99, 199)) -> bytes:
    """Return a zip with one photo, of the view "left" of the tiny scene."""
    photo, content = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), colour).save(photo, "PNG")
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("images/left.png", photo.getvalue())
    return content.getvalue()


def mutated(content: bytes, seed: int) -> bytes:
    """Return the bytes of a file changed or left out in one place or three."""
    generator, mutant = random.Random(seed), bytearray(content)
    for _ in range(generator.choice((1, 1, 3))):
        place = generator.randrange(len(mutant))
        if generator.random() < 0.8:
            mutant[place] = generator.randrange(256)
        else:
            del mutant[place : place + generator.randrange(1, 9)]
    return bytes(mutant)


def array(content: bytes) -> np.ndarray:
    """Read an array of a .npy file."""
    return np.load(io.BytesIO(content), allow_pickle=False)


def picture(content: bytes) -> np.ndarray:
    """Read the pixels of a picture."""
    return np.asarray(Image.open(io.BytesIO(content)))


def bearer(secret: str) -> dict[str, str]:
    """Return the header that brings a key."""
    return {"Authorization": f"Bearer {secret}"}


# Requests that fit the OpenAPI document

# Values of parameters and fields that make a request to any operation.
VALUES: dict[str, Any] = {
    "text": ["apple"], "view": "left", "example": "splat:1", "words": ["apple"], "name": "a name", "x": 1, "y": 1,
    "level": 0, "region": 0, "operation": "grow", "kind": "cameras",
}  # fmt: skip
PLACES = {
    "object": "0",
    "selection": "0" * 16,
    "share": "0" * 12,
    "kind": "cameras",
    "output": "scores",
    "form": "labels",
    "file": "splats",
}


def operations_of(client: Any) -> list[tuple[str, str, dict[str, Any]]]:
    """Return method, path template and description of each operation of the OpenAPI document."""
    paths = client.get("/openapi.json").json()["paths"]
    operations = [(method.upper(), path, description) for path, methods in paths.items()
                  for method, description in methods.items()]  # fmt: skip
    assert len(operations) >= 30
    return operations


def address_of(path: str, lift: str, asset: str) -> str:
    """Fill the template of a path."""
    path = re.sub(r"\{(job|lift|tradeoff)\}", lift, path).replace("{asset}", asset)
    return re.sub(r"\{(\w+)\}", lambda place: PLACES[place[1]], path)


def request_to(client: Any, path: str, description: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters and the JSON body of a request to an operation that names a lift and assets."""
    values = VALUES | values
    names = [entry["name"] for entry in description.get("parameters", ()) if entry["in"] == "query"]
    options = {"params": {name: values[name] for name in names if name in VALUES or name == "lift"}}
    content = description.get("requestBody", {}).get("content", {})
    if "application/json" in content:
        schema = content["application/json"]["schema"]
        for part in schema.get("anyOf", [schema]):
            name = part.get("$ref", "").rpartition("/")[2]
            schema = client.get("/openapi.json").json()["components"]["schemas"].get(name, schema)
        fields = {name: values[name] for name in schema.get("properties", ()) if name in values}
        options["json"] = fields
    return options
