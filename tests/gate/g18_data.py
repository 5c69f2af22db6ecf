"""Backups beside a running server and a client that uploads, orders and deletes: each is whole, and serves.

python -m tests.gate.g18_data [--backups N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import small_scene


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Order a lift, and back up beside a client that uploads, orders and deletes; serve each copy."""
    with Service(folder / "data") as service:
        body = service.upload(small_scene())
        service.wait_for(service.order(body))
        stop = threading.Event()

        def keep_busy() -> None:
            number = 0
            while not stop.is_set():
                number += 1
                content = small_scene()["cameras"] + b" " * number
                cameras = service.client.put("/assets/cameras", content=content).json()["id"]
                job = service.order(body | {"cameras": cameras})
                if number % 4:
                    service.client.post(f"/jobs/{job}/cancel")
                    service.wait_for(job)
                    service.client.delete(f"/jobs/{job}", params={"with_lift": "true"})
                    service.client.delete(f"/assets/{cameras}")

        client = threading.Thread(target=keep_busy)
        client.start()
        statuses = []
        for number in range(options.backups):
            time.sleep(2)
            copy = folder / f"backup-{number}"
            for words in (("backup", copy, "--data", service.data), ("verify", "--data", copy)):
                command = [sys.executable, "-m", "liftcore.cli", "store", *map(str, words)]
                statuses.append(subprocess.call(command, stdout=subprocess.DEVNULL))
        stop.set()
        client.join()
        verdicts.check("a backup beside work succeeds, and verify finds it whole", not any(statuses), statuses)
        broken, count = [], 0
        for number in range(options.backups):
            with Service(folder / f"backup-{number}") as copy:
                for row in copy.client.get("/lifts", params={"limit": 1000}).json()["lifts"]:
                    count += 1
                    if copy.digest(row["id"]) != service.digest(row["id"]):
                        broken.append(row["id"])
                for row in copy.client.get("/assets", params={"limit": 1000}).json()["assets"]:
                    if copy.client.get(f"/assets/{row['id']}/content").status_code != 200:
                        broken.append(row["id"])
                jobs = copy.client.get("/jobs", params={"limit": 1000}).json()["jobs"]
                broken += [
                    row["id"] for row in jobs if copy.wait_for(row["id"])["state"] not in ("succeeded", "canceled")
                ]
        verdicts.check(
            "each copy serves its lifts with the same bits, and ends its jobs", not broken, broken or f"{count} lifts"
        )


if __name__ == "__main__":
    run_gate(gate, __doc__, backups=2)
