"""``python -m service.keys``: make, list and revoke keys, beside a server that runs or without one."""

from __future__ import annotations

import argparse
import fcntl
import json
import sqlite3
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound, SplatliftError
from service.__main__ import parse
from service.errors import InvalidRequest
from service.scopes import parse_scopes
from service.store.database import DATABASE, Database
from service.store.keys import KeyRecord, KeyStore, Quota

MAX_NAME = 100


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line says; the exit status."""
    given = _parser().parse_args(arguments)
    try:
        data = parse([] if given.data is None else ["--data", str(given.data)]).data
        with opened(data, make=given.action == "create") as keys:
            {"create": _create, "list": _list, "revoke": _revoke}[given.action](keys, given)
    except SplatliftError as error:
        print(f"splatlift: {error}", file=sys.stderr)
        return 2
    except (OSError, sqlite3.Error) as error:
        print(f"splatlift: data: expected a directory to write to, got {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    """What ``splatlift keys`` hands over."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    shared.add_argument("--data", help="the service's directory")
    parser = argparse.ArgumentParser(prog="splatlift keys")
    actions = parser.add_subparsers(dest="action", required=True)
    create = actions.add_parser("create", parents=[shared])
    create.add_argument("--name", required=True)
    create.add_argument("--scopes", required=True, help="read,write,metrics,admin")
    for limit in ("--max-bytes", "--max-queued", "--max-uploads"):
        create.add_argument(limit, type=int)
    actions.add_parser("list", parents=[shared])
    actions.add_parser("revoke", parents=[shared]).add_argument("id")
    return parser


@contextmanager
def opened(data: Path, *, make: bool) -> Iterator[KeyStore]:
    """The keys of a data directory, whether a server holds it or not.

    Raises:
        NotFound: there is no database, and none is to be made.
        StaleDatabase: it is gone, or older than the files.
        Misconfigured: a server of an older release holds it, or a later one wrote it.
    """
    path = data / DATABASE
    if make:
        data.mkdir(parents=True, exist_ok=True)
    elif not path.exists():
        raise NotFound("data", expected="the data directory of a service", got=str(data), hint="name it with --data")
    database = Database(path, migrate=not _held(data))
    try:
        yield KeyStore(database, data)
    finally:
        database.close()


def _held(data: Path) -> bool:
    """Whether a server runs over a data directory."""
    with (data / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        return False


def _create(keys: KeyStore, given: argparse.Namespace) -> None:
    name = given.name.strip()
    if not name or len(name) > MAX_NAME or not name.isprintable():
        raise InvalidRequest("name", expected=f"1 to {MAX_NAME} printable characters", got=repr(given.name)[:120])
    quota = Quota(given.max_bytes, given.max_queued, given.max_uploads)
    key, secret = keys.create(name, parse_scopes(given.scopes.split(",")), quota)
    if given.json:
        print(json.dumps({**_document(key), "key": secret}))
        return
    print(secret)
    print(f"key {key.id} of {name}: {', '.join(sorted(key.scopes))}. It is shown this once.", file=sys.stderr)


def _list(keys: KeyStore, given: argparse.Namespace) -> None:
    found = keys.all()
    if given.json:
        print(json.dumps({"keys": [_document(key) for key in found]}))
        return
    for key in found:
        print(
            "  ".join([key.id, _when(key.created), _state(key), ",".join(sorted(key.scopes)), _limits(key), key.name])
        )
    if not found:
        lost = "no keys, but there were some: nobody is let in until one is made"
        none = "no keys: the service is open to this machine, and to no other"
        print(lost if keys.required() else none, file=sys.stderr)


def _revoke(keys: KeyStore, given: argparse.Namespace) -> None:
    key = keys.revoke(given.id)
    if given.json:
        print(json.dumps(_document(key)))
    else:
        print(f"key {key.id} of {key.name} is revoked")


def _document(key: KeyRecord) -> dict[str, Any]:
    return {
        "id": key.id,
        "name": key.name,
        "scopes": sorted(key.scopes),
        "max_bytes": key.quota.max_bytes,
        "max_queued": key.quota.max_queued,
        "max_uploads": key.quota.max_uploads,
        "created": key.created,
        "revoked": key.revoked,
    }


def _state(key: KeyRecord) -> str:
    return "valid" if key.revoked is None else f"revoked {_when(key.revoked)}"


def _limits(key: KeyRecord) -> str:
    limits = {"bytes": key.quota.max_bytes, "queued": key.quota.max_queued, "uploads": key.quota.max_uploads}
    return ",".join(f"{name}={value}" for name, value in limits.items() if value is not None) or "-"


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.gmtime(seconds)) + "Z"


if __name__ == "__main__":
    sys.exit(main())
