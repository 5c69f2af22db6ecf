"""The short form of the load measurements: that all is answered. ``make load`` measures how fast."""

from __future__ import annotations

from pathlib import Path

from tests.crash.loops import scene_files, stored

from .busy_service import lifting, put_blob, put_random_lift, serving, write_words
from .queries import ask_in_rounds
from .slow_clients import BLOB_BYTES, beside_slow_clients, drafts_left

QUERIES = 16


def test_health_and_questions_are_answered_beside_slow_clients_and_a_lift(tmp_path: Path) -> None:
    data, table = tmp_path / "data", tmp_path / "words.safetensors"
    words = iter(write_words(table, 4 * QUERIES, 32))
    other = stored(data, scene_files(tmp_path, views=6, splats=2_000, width=160))
    lift = put_random_lift(data, tmp_path, 20_000, 32)
    path = put_blob(data, BLOB_BYTES)
    with serving(data, table) as service:  # one for both: most of the time goes into starting it, and into lifts
        alone = ask_in_rounds(service, lift, words, QUERIES, rounds=1)
        with lifting(service, other, lifts=25):
            service.await_lift()
            found = beside_slow_clients(service, path, sockets=40, readers=4, seconds=3)
            beside = ask_in_rounds(service, lift, words, QUERIES, rounds=2)
    assert found["beside_them_ms"]["probes"] > 3 and found["beside_them_ms"]["wrong"] == 0
    assert found["a_lift_ran"]
    clients = found["clients"]  # of which some may have been cut off by now, and come again
    assert sum(clients["open"].values()) + sum(clients["cut_off"].values()) >= 44
    assert drafts_left(data) == 0
    assert beside["a_lift_ran"] and alone["median_s"] > 0 and beside["median_s"] > 0
