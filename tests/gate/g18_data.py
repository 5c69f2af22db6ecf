"""The data directory: backups beside a running server, damage, a lost or old database, files that no row names.

python -m tests.gate.g18_data [--backups N]
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import small_scene

DATABASE = "service.sqlite"
MONTH_SECONDS = 30 * 86_400


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Back up, damage, lose."""
    with Service(folder / "data") as service:
        body = service.upload(small_scene())
        lift = service.order(body)
        service.wait_for(lift)
        back_up(service, body, folder, options, verdicts)
        digest = service.digest(lift)
        service.end(signal.SIGTERM)
        verify_damage(service, folder, random.Random(options.seed), verdicts)
        for name, change in {"gone": remove, "empty": clear, "garbage": overwrite}.items():
            refuse_database(service, folder / f"database-{name}", name, change, verdicts)
        keep_strays(service, folder / "strays", lift, digest, verdicts)


def back_up(service: Service, body: dict, folder: Path, options: argparse.Namespace, verdicts: Verdicts) -> None:
    """Back up beside a client that uploads, orders and deletes; serve each copy."""
    stop = threading.Event()

    def keep_busy() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            cameras = service.put("/assets/cameras", content=small_scene()["cameras"] + b" " * number).json()["id"]
            job = service.order(body | {"cameras": cameras})
            if number % 4:
                service.post(f"/jobs/{job}/cancel")
                service.wait_for(job)
                service.delete(f"/jobs/{job}", params={"with_lift": "true"})
                service.delete(f"/assets/{cameras}")

    client = threading.Thread(target=keep_busy)
    client.start()
    statuses = []
    for number in range(options.backups):
        time.sleep(2)
        copy = folder / f"backup-{number}"
        statuses.append(service.run("store", "backup", str(copy), "--data", str(service.data)).returncode)
        statuses.append(service.run("store", "verify", "--data", str(copy)).returncode)
    stop.set()
    client.join()
    verdicts.check("a backup beside work succeeds, and verify finds it whole", not any(statuses), statuses)
    broken, count = [], 0
    for number in range(options.backups):
        with Service(folder / f"backup-{number}") as copy:
            for row in copy.get("/lifts", params={"limit": 1000}).json()["lifts"]:
                count += 1
                if copy.digest(row["id"]) != service.digest(row["id"]):
                    broken.append(row["id"])
            for row in copy.get("/assets", params={"limit": 1000}).json()["assets"]:
                if copy.get(f"/assets/{row['id']}/content").status_code != 200:
                    broken.append(row["id"])
            jobs = copy.get("/jobs", params={"limit": 1000}).json()["jobs"]
            broken += [
                row["id"] for row in jobs if copy.wait_for(row["id"])["state"] not in ("succeeded", "canceled")
            ]
    verdicts.check(
        "each copy serves its lifts with the same bits, and ends its jobs", not broken, broken or f"{count} lifts"
    )


def verify_damage(service: Service, folder: Path, chance: random.Random, verdicts: Verdicts) -> None:
    """Damage one file of a copy at a time."""
    for kind in ("blobs", "lifts"):
        for name, change in {"a bit flipped": flip_bit, "cut": cut, "gone": Path.unlink}.items():
            copy = folder / "damaged"
            shutil.copytree(service.data, copy)
            path = chance.choice(sorted(path for path in (copy / kind).rglob("*") if path.is_file()))
            path.chmod(0o600)
            change(path)
            before = list_files(copy)
            result = service.run("store", "verify", "--data", str(copy))
            is_noticed = result.returncode == 1 and path.name[:12] in result.stdout + result.stderr
            verdicts.check(f"verify names a file of {kind}/ that is {name}", is_noticed, result.returncode)
            verdicts.check("verify changes no file", before.items() <= list_files(copy).items())
            shutil.rmtree(copy)


def refuse_database(
    service: Service, copy: Path, name: str, change: Callable[[Path], object], verdicts: Verdicts
) -> None:
    """Start on a copy whose database is not the one of its files."""
    shutil.copytree(service.data, copy)
    for suffix in ("-wal", "-shm"):
        (copy / f"{DATABASE}{suffix}").unlink(missing_ok=True)
    change(copy / DATABASE)
    before = {path: size for path, size in list_files(copy).items() if path.startswith(("blobs", "lifts"))}
    other = Service(copy)
    status = other.launch()
    if status is None:
        other.end(signal.SIGTERM)
    lines = other.log.read_text().strip().splitlines()
    verdicts.check(
        f"database {name}: refused with status 2", status == 2, f"{status}: {lines[-1][:90] if lines else ''}"
    )
    verdicts.check(
        "and every file is where it was", before.items() <= list_files(copy).items(), f"{len(before)} files"
    )


def keep_strays(service: Service, copy: Path, lift: str, digest: str, verdicts: Verdicts) -> None:
    """Start on a copy with old files that no row names: they stay, as nobody asked to delete them."""
    shutil.copytree(service.data, copy)
    for kind in ("blobs", "lifts"):
        model = next(path for path in sorted((copy / kind).rglob("*")) if path.is_file())
        copy_without_row = model.with_name(model.name[::-1] if kind == "blobs" else "f" * 32 + model.suffix)
        copy_without_row.write_bytes(model.read_bytes())
        old = time.time() - MONTH_SECONDS
        os.utime(copy_without_row, (old, old))
    before = {path: size for path, size in list_files(copy).items() if path.startswith(("blobs", "lifts"))}
    with Service(copy) as other:
        time.sleep(3)
        is_same = other.digest(lift) == digest
        missing = sorted(before.keys() - list_files(copy).keys())
    verdicts.check("files that no row names stay where they are", not missing, missing)
    verdicts.check("beside them a lift has its bits", is_same)


def remove(path: Path) -> None:
    """Remove a database."""
    path.unlink()


def clear(path: Path) -> None:
    """Leave a database without a byte."""
    path.write_bytes(b"")


def overwrite(path: Path) -> None:
    """Put something else in place of a database."""
    path.write_bytes(b"no database" * 1000)


def flip_bit(path: Path) -> None:
    """Flip a bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Cut the second half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def list_files(root: Path) -> dict[str, int]:
    """Path below a root -> bytes, of all files."""
    return {str(path.relative_to(root)): path.stat().st_size for path in root.rglob("*") if path.is_file()}


if __name__ == "__main__":
    run_gate(gate, __doc__, backups=2)
