"""``make soak``: the long proofs of docs/service.md, and their figures as one JSON object on stdout.

    python -m tests.benchmarks.soak [--kills N] [--seconds S] [--jobs N]

Each proof is a loop that gives figures; ``tests/crash/test_loops.py`` runs them for a short time.
"""

import argparse
import hashlib
import json
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import liftcore as lc
from liftcore.io.inria import write_inria_cameras
from liftcore.io.splats import write_splats
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.values.pack import write_pack
from service.models import AssetKind
from service.store.assets import CheckedUpload
from service.store.owners import SERVICE
from service.store.store import Store
from tests.benchmarks.base import machine
from tests.crash.server import POINTS
from tests.crash.service_process import ServiceProcess, kill_processes_of
from tests.scenes import centred, random_camera, random_regions, random_splats
from tests.server import usage

KILLS_A_JOB = 2  # the third attempt is the last
POOLED = 6  # descriptors of read connections that a server may come to hold later; a leak has one a job
WARM_UP_JOBS = 5  # before the first look at what a server holds
SUFFIXES = {"splats": ".ply", "cameras": ".json", "features": ".safetensors"}
EMPTY_FILES = {kind: kind.encode() for kind in SUFFIXES}  # a scene for stand-ins, which look at none
ANSWERS = ("--behaviour", "answer")


def scene_files(folder: Path, *, views: int, splats: int, width: int) -> dict[str, bytes]:
    """A random scene: kind -> bytes."""
    cameras = tuple(centred(random_camera(k, width, width * 3 // 4, name=f"v{k:03d}")) for k in range(views))
    observations = {camera.name: random_regions(k, F=32) for k, camera in enumerate(cameras)}
    paths = {kind: folder / f"{kind}{suffix}" for kind, suffix in SUFFIXES.items()}
    write_splats(paths["splats"], random_splats(0, splats))
    write_inria_cameras(lc.Cameras(cameras), paths["cameras"])
    write_pack(paths["features"], dict(observations), {"encoder": "random"})
    return {kind: path.read_bytes() for kind, path in paths.items()}


def stored(data: Path, files: dict[str, bytes]) -> dict[str, Any]:
    """Put a scene into a data directory that no server holds; the body of an order of its lift."""
    names = {"names": ["v000"], "channels": 1}  # all that an order asks of a check
    ids = {}
    store = Store.open(data)
    for kind, content in files.items():
        with store.files.draft(".part") as draft:
            draft.write_bytes(content)
            digest = hashlib.sha256(content).hexdigest()
            upload = CheckedUpload(draft, AssetKind(kind), digest, SUFFIXES[kind], names, [])
            ids[kind] = store.assets.add(SERVICE, upload)[0].id
    store.close()
    return {**ids, "features": [ids["features"]]}


def insist(service: ServiceProcess, body: dict[str, Any], key: str) -> str:
    """Order a lift as a client does that was cut off: again with the same key, when the server is back."""
    job = service.order(body, key)
    while job is None:
        if not service.is_alive():
            service.wait()
            service.start()
        job = service.order(body, key)
    return job


def kill_loop(files: dict[str, bytes], *, kills: int, seconds: float, seed: int = 0) -> dict[str, Any]:
    """Kill the server or the child of a job at random moments, twice a job.

    Args:
        files: the scene to lift.
        kills: how many, unless ``seconds`` end first: no job begins after these.
        seed: of the moments and the victims.
    """
    with tempfile.TemporaryDirectory() as folder:
        body = stored(Path(folder), files)
        with ServiceProcess(Path(folder)) as service:
            return _kill_jobs(service, body, kills, seconds, random.Random(seed))


def _kill_jobs(
    service: ServiceProcess, body: dict[str, Any], kills: int, seconds: float, chance: random.Random
) -> dict[str, Any]:
    victims, stages = Counter[str](), Counter[str]()
    figures = Counter[str](jobs=0, lost=0, doubled=0, digests_equal=0, resumed=0)
    start = time.monotonic()
    reference = insist(service, body, "undisturbed")
    service.wait_until_ended(reference)
    duration = time.monotonic() - start
    expected = service.digest(reference)
    start = time.monotonic()  # of the kills: the first lift may have compiled kernels
    while victims.total() < kills and time.monotonic() - start < seconds:
        key = f"job {figures['jobs']}"
        job = insist(service, body, key)
        for _ in range(min(KILLS_A_JOB, kills - victims.total())):
            time.sleep(chance.uniform(0, duration))
            stages[_stage(service.job(job))] += 1
            if chance.random() < 0.5 and kill_processes_of(job):
                victims["child"] += 1
            else:
                victims["server"] += 1
                service.kill()
                service.start()
        succeeded = service.wait_until_ended(job)["state"] == "succeeded"
        figures["jobs"] += 1
        figures["lost"] += not succeeded or insist(service, body, key) != job
        figures["doubled"] += service.times_succeeded(job) > 1
        figures["resumed"] += "files of earlier work are kept" in service.client.get(f"/jobs/{job}/events").text
        figures["digests_equal"] += succeeded and service.digest(job) == expected
    figures["doubled"] += len(service.client.get("/jobs").json()["jobs"]) - figures["jobs"] - 1
    head = {"kills": victims.total(), "victims": victims, "killed_while": stages, **figures}
    return head | {"undisturbed_seconds": round(duration, 2), "seconds": round(time.monotonic() - start)}


def _stage(job: dict[str, Any]) -> str:
    if job["state"] != "running":
        return job["state"]
    return "starting" if job["progress"] is None else job["progress"]["stage"]


def fault_points(points: Iterable[str]) -> dict[str, str]:
    """Kill the server at each named point of a job's life, start it again, and say what came of the job."""
    return {point: _at_point(point) for point in points}


def _at_point(point: str) -> str:
    is_tradeoff = "trade-off" in point
    route, result_route = ("/tradeoff", "/tradeoffs/{}/chart") if is_tradeoff else ("/lift", "/lifts/{}/features")
    with tempfile.TemporaryDirectory() as folder:
        body = stored(Path(folder), EMPTY_FILES)
        with ServiceProcess(Path(folder), *ANSWERS, "--point", point) as service:
            first = service.order(body, "key", route)
            assert service.wait() == -9, point
            service.start(*ANSWERS)
            job = service.order(body, "key", route)
            assert job is not None and first in (None, job)
            state = service.wait_until_ended(job)["state"]
            jobs, times = len(service.client.get("/jobs").json()["jobs"]), service.times_succeeded(job)
            result = service.client.get(result_route.format(job)).status_code
    once = (state, jobs, times, result) == ("succeeded", 1, 1, 200)
    return "finished once" if once else f"{state}: {jobs} jobs, {times} times, the result gives {result}"


def leak_loop(jobs: int) -> dict[str, Any]:
    """Run jobs through one server, each followed by a stream, and see what it holds."""
    with tempfile.TemporaryDirectory() as folder:
        body = stored(Path(folder), EMPTY_FILES)
        samples = []
        with ServiceProcess(Path(folder), *ANSWERS) as service:
            for number in range(WARM_UP_JOBS + jobs):
                job = service.order(body, str(number))
                assert job is not None
                assert service.times_succeeded(job) == 1  # the stream ends with the job
                if number >= WARM_UP_JOBS - 1:
                    time.sleep(0.5)
                    samples.append(usage(service.pid))
        remaining = [path.name for folder_name in ("work", "tmp") for path in (Path(folder) / folder_name).iterdir()]
    growth = {
        name: int(np.median([sample[name] for sample in samples[-3:]])) - samples[0][name] for name in samples[0]
    }
    return {"jobs": jobs, "first": samples[0], "last": samples[-1], "growth": growth, "left_over": remaining}


def main() -> int:
    """Run the loops; 1 when a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.soak", description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=7_200, help="no job of the kill loop begins after these")
    parser.add_argument("--jobs", type=int, default=50, help="of the leak test")
    options = parser.parse_args()
    warm_up()  # the undisturbed lift is timed, and kernels that it compiled first would stretch its time
    with tempfile.TemporaryDirectory() as folder:
        files = scene_files(Path(folder), views=30, splats=20_000, width=320)
    figures = {
        **machine(),
        "leaks": leak_loop(options.jobs),
        "points": fault_points(POINTS),
        "kills": kill_loop(files, kills=options.kills, seconds=options.seconds),
    }
    print(json.dumps(figures, indent=2))
    kills, growth = figures["kills"], figures["leaks"]["growth"]
    passed = kills["lost"] == kills["doubled"] == 0 and kills["digests_equal"] == kills["jobs"]
    level = growth["descriptors"] <= POOLED and growth["threads"] <= 1
    return 0 if passed and level and set(figures["points"].values()) == {"finished once"} else 1


if __name__ == "__main__":
    sys.exit(main())
