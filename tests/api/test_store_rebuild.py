"""A lost database is made again of the files, and a lost key opens no door."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore import Scene
from liftcore.cli import INTERRUPTED, main
from service.auth import required_scope
from service.commands.serve import require_keys
from service.errors import Misconfigured, StaleDatabase
from service.models import JobKind
from service.settings import ServiceSettings
from service.store.database import DATABASE
from service.store.owners import SERVICE
from service.store.recovery import back_up
from service.store.store import Store, collect
from tests.server import wait_for_end
from tests.tiny_scene import TinyScene, colmap_zip, labels, masks

from .conftest import SceneAssets, app_of, serving
from .guarded import KeyedServer, address, bearer, every_route, keyed_server, make_key

StoredData = tuple[Path, dict[str, Any]]  # a data directory, and its contents over HTTP


@pytest.fixture(scope="module")
def stored_data(tmp_path_factory: pytest.TempPathFactory, scene: TinyScene, table: Path) -> StoredData:
    """A data directory with an asset of each kind and a lift that was changed, and its contents over HTTP."""
    data = tmp_path_factory.mktemp("stored_data") / "data"
    with serving(data, table) as client:
        contents = {"splats": scene.splats, "cameras": scene.cameras, "features": scene.features}
        ids = [client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in contents.items()]
        for kind, body in {"cameras": colmap_zip(), "masks": masks({"left": labels()["left"][0]}),
                           "table": scene.table}.items():  # fmt: skip
            assert client.put(f"/assets/{kind}", content=body).status_code == 201
        job = wait_for_end(client, client.post("/lift", json=SceneAssets(*ids).order()).headers["location"])
        assert job["state"] == "succeeded", job
        for change in ({"name": "first"}, {"world": {"up": [0, -1, 0], "metres_per_unit": 0.5}}, {"name": "last"}):
            assert client.patch(f"/lifts/{job['id']}", json=change).status_code == 200
        contents = contents_of(client)
        assert (contents["lift"]["name"], contents["lift"]["world"]["metres_per_unit"]) == ("last", 0.5)
    return data, contents


@pytest.fixture
def copied_data(stored_data: StoredData, tmp_path: Path) -> StoredData:
    """A copy of it."""
    shutil.copytree(stored_data[0], tmp_path / "data")
    return tmp_path / "data", stored_data[1]


def contents_of(client: TestClient) -> dict[str, Any]:
    """Assets, lift and an answer, without the times at which they were made."""
    assets = {asset["id"]: asset for asset in client.get("/assets").json()["assets"]}
    (lift,) = client.get("/lifts").json()["lifts"]
    job = client.get(f"/jobs/{lift['id']}").json()
    answer = client.get("/query", params={"text": "lamp", "top": 3}).json()
    for each in (*assets.values(), lift):
        del each["created"], each["created_at"]
    return {"assets": assets, "lift": lift, "settings": job["settings"], "state": job["state"], "answer": answer}


def test_lift_in_a_data_directory_opens_with_the_splats_that_lie_there(
    stored_data: StoredData,
) -> None:
    (lift,) = stored_data[0].glob("lifts/*.safetensors")
    scene = Scene(lift)
    assert scene.splats.count == stored_data[1]["lift"]["count"] and scene.cameras


def test_rebuild_makes_the_database_of_the_files(
    copied_data: StoredData, table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, contents = copied_data
    (data / DATABASE).unlink()
    broken = data / "blobs" / "ab" / f"{'ab' * 32}.ply"
    broken.parent.mkdir(exist_ok=True)
    broken.write_bytes(b"half of a file")
    strange = data / "lifts" / f"{'0' * 32}.safetensors"
    strange.write_bytes(b"no lift")
    assert main(["store", "rebuild", "--data", str(data), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["lifts"], report["assets"]) == (
        1, {"splats": 1, "cameras": 2, "features": 1, "masks": 1, "table": 1}
    )  # fmt: skip
    assert [remaining["file"] for remaining in report["left"]] == [
        str(path.relative_to(data)) for path in (broken, strange)
    ]
    assert "trade-offs" in report["lost"] and "keys" in report["lost"]
    with serving(data, table) as client:
        assert contents_of(client) == contents
    store = Store.open(data)
    assert set(collect(store, 1e12)) == {broken, strange}  # all else has its row
    store.close()


def test_rebuild_brings_an_older_database_up_to_its_files(copied_data: StoredData, table: Path) -> None:
    data, contents = copied_data
    store = Store.open(data)
    lift = contents["lift"]["id"]
    with store.database.write() as connection:  # as it was while the job was in line
        connection.execute("DELETE FROM lifts")
        connection.execute("UPDATE jobs SET state = 'queued', ended = NULL, owner = 'somebody'")
        connection.execute("UPDATE generation SET number = 3")
    store.close()
    with pytest.raises(StaleDatabase, match=r"an older one \(generation 3"):
        Store.open(data)
    assert main(["store", "rebuild", "--data", str(data)]) == 0
    store = Store.open(data)
    assert store.jobs.get(SERVICE, lift).state == "succeeded" and store.jobs.claim() is None
    with store.database.read() as connection:
        assert connection.execute("SELECT owner FROM jobs").fetchone()["owner"] == "somebody"
    store.close()
    with serving(data, table) as client:
        assert contents_of(client) == contents


def test_changes_of_a_lift_that_are_damaged_or_of_photos_that_are_gone_cost_no_lift(
    copied_data: StoredData, capsys: pytest.CaptureFixture[str]
) -> None:
    data, contents = copied_data
    (changes,) = data.glob("lifts/*.json")
    for text, remaining, name in (
        ('{"name": "x", "photos": "sha256:%s"}' % ("0" * 64), 0, "x"),
        ('{"name": 7}', 1, None),
    ):
        (data / DATABASE).unlink()
        changes.write_text(text)
        assert main(["store", "rebuild", "--data", str(data), "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert (report["lifts"], len(report["left"])) == (1, remaining) and changes.exists() == (not remaining)
        store = Store.open(data)
        lift = store.lifts.get(SERVICE, contents["lift"]["id"])
        assert (lift.name, lift.photos) == (name, None)
        store.close()


def test_changes_of_a_lift_go_with_it_and_into_backups(copied_data: StoredData, tmp_path: Path) -> None:
    data, contents = copied_data
    (changes,) = data.glob("lifts/*.json")
    back_up(data, tmp_path / "backup")
    assert (tmp_path / "backup" / "lifts" / changes.name).read_text() == changes.read_text()
    store = Store.open(data)
    assert collect(store, 1e12) == [] and changes.exists()
    store.jobs.delete(SERVICE, contents["lift"]["id"], given_up=(JobKind.LIFT,))
    assert not changes.exists()
    store.close()


def test_rebuild_that_was_cut_off_does_not_let_the_server_start(
    copied_data: StoredData, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data, _ = copied_data
    for name in (DATABASE, "generation"):
        (data / name).unlink()

    def cut_off(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("service.store.recovery._add_lift", cut_off)
    assert main(["store", "rebuild", "--data", str(data)]) == INTERRUPTED
    monkeypatch.undo()
    with pytest.raises(StaleDatabase):
        Store.open(data)
    assert main(["store", "rebuild", "--data", str(data)]) == 0
    assert "0 assets" in capsys.readouterr().out
    Store.open(data).close()


def test_lift_whose_splats_are_gone_is_left_out(copied_data: StoredData, capsys: pytest.CaptureFixture[str]) -> None:
    data, _ = copied_data
    (data / DATABASE).unlink()
    (splats,) = data.glob("blobs/*/*.ply")
    splats.unlink()
    assert main(["store", "rebuild", "--data", str(data)]) == 0
    output = capsys.readouterr().out
    assert "0 lifts" in output and "left out" in output and splats.stem in output


def test_rebuild_beside_a_server_or_nowhere_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store.open(tmp_path)
    assert main(["store", "rebuild", "--data", str(tmp_path)]) == 2
    store.close()
    assert not (tmp_path / "generation").exists()
    assert main(["store", "rebuild", "--data", str(tmp_path / "nowhere")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all(line.startswith("splatlift: data: expected") for line in lines)
    assert not (tmp_path / "nowhere").exists()


def without_keys(server: KeyedServer) -> None:
    """As after the loss of the database that held them."""
    with server.store.database.write() as connection:
        connection.execute("DELETE FROM keys")


def statuses(server: KeyedServer, secret: str | None = None) -> dict[str, int]:
    """Return the status of each route that needs a key; requests lack a body and address nothing that exists."""
    headers = {} if secret is None else bearer(secret)
    report = {}
    for method, path in every_route(app_of(server.client)):
        if required_scope(method, path) is not None:
            route_address = address(path, "0" * 32, "sha256:" + "0" * 64)
            report[f"{method} {path}"] = server.client.request(method, route_address, headers=headers).status_code
    return report


def test_lost_keys_open_no_door(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", allowed_hosts="proxy.example") as server:
        without_keys(server)
        report = statuses(server, server.secrets["boss"])
        assert len(report) > 20 and set(report.values()) == {401}, report
        assert server.client.get("/assets", headers={"Host": "proxy.example"}).status_code == 401
        assert "securitySchemes" in server.client.get("/openapi.json").json()["components"]
        _, secret = make_key(server.store, "read")
        assert server.client.get("/assets", headers=bearer(secret)).status_code == 200


def test_database_of_a_release_that_did_not_remember_keys_is_remembered(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    make_key(store, "read")
    store.close()
    (tmp_path / "keys.required").unlink()
    Store.open(tmp_path).close()
    assert (tmp_path / "keys.required").exists()


def test_keys_required_closes_a_service_that_never_had_one(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", keys="required") as server:
        without_keys(server)
        (tmp_path / "data" / "keys.required").unlink()
        assert set(statuses(server).values()) == {401}
    require_keys(ServiceSettings.model_validate({"data": tmp_path / "x", "host": "0.0.0.0", "keys": "required"}))


def test_keys_none_asks_nobody_for_one_and_stays_on_this_machine(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", keys="none") as server:
        for secret in (None, server.secrets["bob"], "no-key"):
            assert not {401, 403} & set(statuses(server, secret).values())
        assert len(server.client.get("/jobs").json()["jobs"]) == 3
    with pytest.raises(Misconfigured, match="SPLATLIFT_KEYS is none"):
        require_keys(ServiceSettings.model_validate({"data": tmp_path / "data", "host": "0.0.0.0", "keys": "none"}))


def test_key_that_could_not_be_remembered_is_not_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(data: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("service.store.keys.remember_keys", full)
    store = Store.open(tmp_path)
    with pytest.raises(OSError, match="No space"):
        make_key(store, "read")
    assert store.keys.all() == []
    store.close()


def test_directory_copied_without_its_database_stays_closed(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "data")
    make_key(store, "read")
    store.close()
    shutil.copytree(tmp_path / "data", tmp_path / "copy", ignore=shutil.ignore_patterns(f"{DATABASE}*"))
    store = Store.open(tmp_path / "copy", new=True)
    assert store.keys.required()
    store.close()
