"""A lift that asks for a card which is not there is refused before it becomes a job."""

from __future__ import annotations

import errno
import io
import sys
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.device import choose_device
from liftcore.errors import Unavailable
from liftcore.progress import Progress
from service.child import fault_of
from service.jobs import child, device
from service.jobs.child import Reporter
from service.jobs.device import Devices

from .conftest import Uploaded
from .test_problems import assert_problem

LACK = Unavailable("device", expected="a card", got="none", hint="take device=cpu")


def test_card_that_is_missing_refuses_the_order_at_once(
    client: TestClient, uploaded: Uploaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "ask", lambda asked: {"event": "fault", "fault": fault_of(LACK)})
    jobs = len(client.get("/jobs").json()["jobs"])
    problem = assert_problem(client.post("/lift", json=uploaded.order(device="cuda")))
    assert (problem["status"], problem["type"]) == (422, "/problems/unavailable")
    assert (problem["argument"], problem["hint"]) == ("device", LACK.hint)
    unknown = assert_problem(client.post("/lift", json=uploaded.order(device="gpu")))
    assert unknown["type"] == "/problems/invalid-settings"
    assert len(client.get("/jobs").json()["jobs"]) == jobs


def test_device_is_looked_for_once_and_what_cannot_be_found_out_is_let_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[str] = []
    found = Devices()
    for told, refused in ((None, False), ({"event": "fault", "fault": fault_of(LACK)}, True)):
        monkeypatch.setattr(device, "ask", lambda asked, told=told: looks.append(asked) or told)
        for _ in range(2):
            if refused:
                with pytest.raises(Unavailable):
                    found.require("cuda")
            else:
                found.require("cuda")
    found.require("auto")
    found.require("cpu")
    assert looks == ["cuda"] * 3  # a look without an answer is taken again


def test_process_that_looks_says_what_a_lift_would_say() -> None:
    try:
        choose_device("cuda")
    except Unavailable as error:
        with pytest.raises(Unavailable) as caught:
            Devices().require("cuda")
        assert str(caught.value) == str(error)
    else:
        Devices().require("cuda")


def test_look_that_fails_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    Devices().require("cuda")


def test_job_that_meets_no_card_fails_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(asked: str) -> None:
        raise LACK

    monkeypatch.setattr("liftcore.io.scene_files.choose_device", missing)
    order = {
        "kind": "lift", "splats": "s", "cameras": "c", "features": ["f"], "settings": {"device": "cuda"},
        "threads": 1, "work": str(tmp_path), "checkpoint_seconds": 1, "output": str(tmp_path / "o"), "names": {},
        "engine": None,
    }  # fmt: skip
    told = child.run(order, Reporter(io.BytesIO()))
    assert told == {"event": "fault", "fault": fault_of(LACK)}


def test_job_on_a_full_disk_fails_at_once_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("service.jobs.lifting.lift_as_ordered", full)
    fault = child.run({"kind": "lift", "names": {}}, Reporter(io.BytesIO()))["fault"]
    assert fault["kind"] == "no-space" and "delete" in fault["hint"]
