"""Quotas of a key: what it has stored, and its jobs in line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from service.store.owners import Owner
from tests.crash.conftest import order

from .guarded import bearer, finish, guarded, make_key
from .test_problems import assert_problem

if TYPE_CHECKING:
    from pathlib import Path


def test_stored_bytes_have_a_quota(tmp_path: Path) -> None:
    with guarded(tmp_path / "data", key_bytes=10_000) as house:
        used = sum(asset["bytes"] for asset in house.ask("alice", "GET", "/assets").json()["assets"]) + len(b"a lift")
        ident, secret = make_key(house.store, "read write", max_bytes=used)
        with house.store.database.write() as connection:
            connection.execute("UPDATE asset_owners SET owner = ?", (ident,))
            connection.execute("UPDATE jobs SET owner = ?", (ident,))
        replies = [
            house.client.put("/assets/splats", headers=bearer(secret), content=b"x"),
            house.client.post("/lift", headers=bearer(secret), json=house.body()),
        ]
        for reply in replies:
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/over-quota", 403)
            assert str(used) in reply.json()["expected"]
        assert house.client.delete(f"/jobs/{house.done}?with_lift=true", headers=bearer(secret)).status_code == 204
        reply = house.client.post("/lift", headers=bearer(secret), json=house.body())
        assert reply.status_code == 403  # the trade-off counts, too
        gone = house.client.delete(f"/jobs/{house.compared}?with_tradeoff=true", headers=bearer(secret))
        assert gone.status_code == 204
        assert house.client.post("/lift", headers=bearer(secret), json=house.body()).status_code == 202


def test_upload_that_would_be_too_much_is_not_kept(tmp_path: Path) -> None:
    with guarded(tmp_path / "data") as house:
        bob = Owner(house.ids["bob"], sees_all=False, max_bytes=8)
        with pytest.raises(Exception, match="at most 8 bytes"):
            order(house.store, bob)  # 6 bytes of splats, then 7 of cameras
        assert [asset.bytes for asset in house.store.assets.all(bob)] == [6]


def test_jobs_in_line_have_a_quota_a_key(tmp_path: Path) -> None:
    with guarded(tmp_path / "data", key_queued=2) as house:
        assert house.ask("alice", "POST", "/lift", json=house.body()).status_code == 202
        reply = house.ask("alice", "POST", "/lift", json=house.body())
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/too-many", 429)
        assert int(reply.headers["retry-after"]) > 0
        order(house.store, Owner(house.ids["bob"], sees_all=False))
        assert house.ask("bob", "POST", "/lift", json=house.body()).status_code == 202
        for _ in "ba":  # keys take turns, and hers was the last
            finish(house.store, b"")
        assert house.ask("alice", "POST", "/lift", json=house.body()).status_code == 202
