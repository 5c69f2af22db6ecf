"""The short forms of the load measurements: that all is answered. ``make load`` measures how fast."""

from __future__ import annotations

from .queries import query_loop
from .slow_clients import slow_loop

SMALL = {"views": 6, "splats": 2_000, "width": 160}


def test_health_is_answered_beside_slow_clients_and_a_lift() -> None:
    found = slow_loop(sockets=40, readers=4, seconds=3, beside=SMALL)
    assert found["beside_them_ms"]["probes"] > 3 and found["beside_them_ms"]["wrong"] == 0
    assert found["a_lift_ran"]
    clients = found["clients"]  # of which some may have been cut off by now, and come again
    assert sum(clients["open"].values()) + sum(clients["cut_off"].values()) >= 44
    assert found["drafts_left"] == 0


def test_questions_at_the_same_moment_are_answered_beside_a_lift() -> None:
    found = query_loop(splats=20_000, channels=32, queries=16, rounds=2, beside=SMALL)
    assert found["beside_a_lift"]["a_lift_ran"]
    assert found["alone"]["median_s"] > 0 and found["beside_a_lift"]["median_s"] > 0
