"""Many questions at the same moment to a large lift, beside a running lift of another scene."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from tests.crash.loops import scene_files, stored

from .busy_service import BusyService, in_threads, lifting, put_random_lift, serving, write_words

TIMEOUT_SECONDS = 120.0


def query_loop(*, splats: int, channels: int, queries: int, rounds: int, beside: dict[str, int]) -> dict[str, Any]:
    """Ask rounds of different questions at the same moment, first alone, then beside lifts.

    Args:
        splats: rows of the lift that is asked.
        channels: its columns, float16.
        queries: questions of a round.
        rounds: how many, in each of the two conditions.
        beside: of the scene that is lifted meanwhile: ``views``, ``splats``, ``width``.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = iter(write_words(folder / "words.safetensors", 2 * rounds * queries + 1, channels))
        other = stored(folder / "data", scene_files(folder, **beside))
        lift = put_random_lift(folder / "data", folder, splats, channels)
        with serving(folder / "data", folder / "words.safetensors") as service:
            begun = time.monotonic()
            with _clients(service, 1) as (client,):
                _ask(client, lift, next(words))
            figures: dict[str, Any] = {"first_seconds": round(time.monotonic() - begun, 2)}
            figures["alone"] = ask_in_rounds(service, lift, words, queries, rounds)
            with lifting(service, other):
                service.await_lift()
                figures["beside_a_lift"] = ask_in_rounds(service, lift, words, queries, rounds)
    return {"splats": splats, "channels": channels, "queries": queries, **figures}


def ask_in_rounds(service: BusyService, lift: str, words: Iterator[str], queries: int, rounds: int) -> dict[str, Any]:
    """Ask rounds of different questions, those of a round at the same moment; how long they took."""
    slowest, every, running, load = [], [], [], []
    before = service.cpu_seconds()
    for _ in range(rounds):
        chosen = list(islice(words, queries))
        running.append(service.lifting())
        load.append(os.getloadavg()[0])
        with _clients(service, queries) as clients:
            pairs = list(zip(clients, chosen, strict=True))
            times = in_threads(lambda number, pairs=pairs: _ask(pairs[number][0], lift, pairs[number][1]), queries)
        running.append(service.lifting())
        slowest.append(max(times))
        every += times
    return {
        "rounds": rounds,
        "slowest_of_each_round_s": [round(seconds, 2) for seconds in slowest],
        "slowest_s": round(max(slowest), 2),
        "median_s": round(float(np.median(every)), 2),
        "processor_s_a_round": round((service.cpu_seconds() - before) / rounds, 2),
        "a_lift_ran": all(running),
        "load": [round(value, 1) for value in load],
    }


@contextmanager
def _clients(service: BusyService, count: int) -> Iterator[list[httpx.Client]]:
    # Made before anything is timed: a client takes longer to make than a question to answer.
    with ExitStack() as stack:
        made = [httpx.Client(base_url=service.address, timeout=TIMEOUT_SECONDS, verify=False) for _ in range(count)]
        yield [stack.enter_context(client) for client in made]


def _ask(client: httpx.Client, lift: str, word: str) -> float:
    begun = time.monotonic()
    reply = client.get("/query", params={"lift": lift, "text": word})
    seconds = time.monotonic() - begun
    assert reply.status_code == 200 and reply.json()["top"], reply.text
    return seconds
