"""``splatlift store``: back up, verify and clean a data directory.

A backup is laid out as a data directory, without work and drafts: the database and every file that it names. Files
never change once they are stored, so they are linked where the file system can, and copied where it cannot.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

from liftcore.cli import Parser
from liftcore.errors import NotFound
from service.commands.serve import data_directory_errors
from service.errors import Misconfigured
from service.settings import read_settings
from service.store import DATABASE, Store, connect, sync

TRIES = 10  # for a database with all of its files; each deletion meanwhile may cost one


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    backup = actions.add_parser("backup", parents=[shared], help="copy a data directory, beside a server that runs")
    backup.add_argument("directory", type=Path, metavar="DIR", help="the backup, which is not there yet")
    verify = actions.add_parser("verify", parents=[shared], help="compare every file with its digest")
    clean = actions.add_parser(
        "clean", parents=[shared], help="remove files that no record names; not beside a server"
    )
    for action in (backup, verify, clean):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Run the command; return 1 if `verify` finds damage."""
    data = read_settings(data=options.data).data
    if not (data / DATABASE).is_file():
        raise NotFound("data", expected=f"a directory with a {DATABASE}", got=str(data), hint="name it with --data")
    with data_directory_errors():
        if options.action == "backup":
            count = back_up(data, options.directory)
            document, text = {"files": count}, f"{DATABASE} and {count} files are in {options.directory}"
        elif options.action == "clean":
            paths = clean(data)
            document, text = {"removed": paths}, "\n".join(paths) or "every file has its record"
        else:
            damage = verify(data)
            document, text = {"damage": damage}, "\n".join(damage) or "every file is as it was stored"
    print(json.dumps(document) if options.json else text)
    return 1 if document.get("damage") else 0


def files_of(data: Path) -> list[tuple[str, int, str]]:
    """Return path below the directory, bytes and sha256 of every file in the database."""
    select = "SELECT file, bytes, substr(id, 8) FROM assets UNION SELECT file, bytes, sha256 FROM lifts"
    with closing(connect(data / DATABASE, "ro")) as connection:
        return [tuple(row) for row in connection.execute(select)]


def back_up(data: Path, target: Path) -> int:
    """Copy a data directory, also while a server holds it; return the number of files beside the database."""
    if target.exists():
        hint = "move it away first"
        raise Misconfigured("directory", expected="one that is not there yet", got=str(target), hint=hint)
    folder = target.absolute().with_name(f".{target.name}.part")
    shutil.rmtree(folder, ignore_errors=True)
    os.umask(0o077)
    missing: list[str] = []
    try:
        for _ in range(TRIES):  # the database first: files deleted after it are missing, and it is copied again
            for name in ("blobs", "lifts"):
                (folder / name).mkdir(parents=True, exist_ok=True)
            with (
                closing(connect(data / DATABASE, "ro")) as source,
                closing(sqlite3.connect(folder / DATABASE)) as copy,
            ):
                source.backup(copy)
                copy.execute("PRAGMA journal_mode = DELETE")  # to have one file
            files = [file for file, _, _ in files_of(folder)]
            missing = [file for file in files if not _link(data / file, folder / file)]
            if not missing:
                for path in (folder / DATABASE, folder / "blobs", folder / "lifts", folder):
                    sync(path)
                folder.replace(target)
                sync(target.absolute().parent)
                return len(files)
            shutil.rmtree(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    got, hint = f"{len(missing)} lost, such as {missing[0]}", "delete what they belong to, then back up again"
    raise Misconfigured("data", expected="all files that the database names", got=got, hint=hint)


def _link(source: Path, target: Path) -> bool:
    """Link a file, or copy it; return False if it is not there."""
    try:
        os.link(source, target)
    except FileNotFoundError:
        return False
    except OSError:  # another file system, or one without hard links
        try:
            shutil.copyfile(source, target)
        except FileNotFoundError:
            return False
        sync(target)
    return True


def verify(data: Path) -> list[str]:
    """Return the damage of a data directory or a backup, a line each: files that are lost or changed."""
    with closing(connect(data / DATABASE, "ro")) as connection:
        checks = connection.execute("PRAGMA integrity_check(10)").fetchall()
    damage = [f"{DATABASE}: {row[0]}" for row in checks if row[0] != "ok"]
    for file, size, digest in files_of(data):
        try:
            with (data / file).open("rb") as handle:
                actual, count = hashlib.file_digest(handle, "sha256").hexdigest(), handle.tell()
        except OSError as error:
            reason = error.strerror
        else:
            reason = f"{count} bytes of {size}, sha256 {actual}"
            if (count, actual) == (size, digest):
                continue
        if (file, size, digest) in files_of(data):  # else it was deleted meanwhile
            damage.append(f"{file}: {reason}")
    return damage


def clean(data: Path) -> list[str]:
    """Remove the files that no row names; return their paths below the directory."""
    with closing(Store(data)) as store:
        paths = store.unnamed_files()
        for path in paths:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return [str(path.relative_to(store.root)) for path in paths]
