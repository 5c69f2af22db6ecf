"""Files at URLs (``s3://``, ``gs://``, ``https://`` and whatever else fsspec opens).

Readers map their files, which must be local for it. So inputs are downloaded completely, once for each version that
the storage distinguishes, and outputs are written locally and then uploaded.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from liftcore.errors import InvalidInput
from liftcore.runtime.arguments import as_list
from liftcore.runtime.folders import cache_folder, scratch_folder

REMOTE = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(::[^:]+)*://")
EXPECTED = "a file or folder that fsspec opens, such as s3://bucket/scene.ply (needs s3fs) or file:///scene.ply"


def is_remote(path: Path | str) -> bool:
    """Return True if a text is a URL. A ``Path`` never is: it turns ``s3://b`` into ``s3:/b``."""
    return isinstance(path, str) and REMOTE.match(path) is not None


def check_path(path: object, argument: str = "path") -> None:
    """Refuse an argument that is no path.

    Raises:
        InvalidInput: it is neither a path nor a text, or an empty text.
    """
    if not isinstance(path, str | os.PathLike) or not str(path):
        got = f"{type(path).__name__} {path!r}"[:80]
        hint = "give several paths one by one" if isinstance(path, list | tuple) else ""
        raise InvalidInput(argument, expected="the path of a file or folder", got=got, hint=hint)


def local_path(path: Path | str, argument: str = "path") -> Path:
    """Return the local path of a file or folder: the same path, or that of a downloaded copy of a URL.

    Copies lie in ``splatlift/remote`` of the user's cache folder (XDG_CACHE_HOME), which may be emptied at any time.

    Args:
        argument: the name in errors.

    Raises:
        InvalidInput: it does not exist, or cannot be opened or copied; the error has the reason.
    """
    check_path(path, argument)
    if not is_remote(path):
        return Path(path)
    url = str(path)
    with name_url_in_errors(url):
        storage, place = _open_storage(url)
        entries: dict[str, Any] = storage.find(place, detail=True)
        if not entries:
            raise FileNotFoundError("nothing is there")
        # Over HTTP ukey is the address alone: the file's details (ETag, size, time) distinguish its versions. `find`
        # returns no details of a single file, and over HTTP no size and no tag of files in a folder.
        details = {
            name: entry if entry.get("size") is not None else storage.info(name) for name, entry in entries.items()
        }
        versions = sorted((name, storage.ukey(name), sorted(map(str, details[name].items()))) for name in entries)
        base = cache_folder("remote")
        name = PurePosixPath(place.rstrip("/")).name
        copy = base / hashlib.sha256(repr((url, versions)).encode()).hexdigest()[:32] / name
        if copy.exists():
            return copy
        base.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=base, prefix=".part-"))
        try:
            for entry_path in entries:
                inside = PurePosixPath(entry_path).relative_to(place.rstrip("/"))
                to = draft / name / inside
                to.parent.mkdir(parents=True, exist_ok=True)
                storage.get_file(entry_path, str(to))
            copy.parent.mkdir(exist_ok=True)
            if not copy.exists():  # else another process was quicker
                (draft / name).rename(copy)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return copy


def local_paths(paths: Path | str | Iterable[Path | str], argument: str = "path") -> list[Path]:
    """Return `local_path` of each; a single path makes a list of one."""
    return [local_path(path, argument) for path in as_list(paths)]


def require_storage(url: str) -> None:
    """Check that the storage of an output opens, so that no work is lost to a missing package or key.

    Raises:
        InvalidInput: its storage does not open.
    """
    with name_url_in_errors(url):
        storage, place = _open_storage(url)
        storage.exists(place)


@contextmanager
def open_output(path: Path | str) -> Iterator[Path]:
    """Yield the path to write a file or folder to: the path, or one in a temporary folder, uploaded at the end.

    Of a folder the file that sorts last is uploaded last, and removed first: of a lift in shards the index.

    Raises:
        InvalidInput: it is no path, or cannot be uploaded.
    """
    check_path(path)
    if not is_remote(path):
        yield Path(path)
        return
    url = str(path)
    with scratch_folder("splatlift-") as folder:
        with name_url_in_errors(url):
            storage, place = _open_storage(url)
        local = folder / PurePosixPath(place.rstrip("/")).name
        yield local
        with name_url_in_errors(url):
            if local.is_file():
                storage.makedirs(str(PurePosixPath(place).parent), exist_ok=True)
                storage.put_file(str(local), place)
                return
            files = sorted(file for file in local.rglob("*") if file.is_file())
            last = f"{place.rstrip('/')}/{files[-1].relative_to(local).as_posix()}"
            if storage.exists(last):
                storage.rm_file(last)
            storage.makedirs(place, exist_ok=True)
            for file in files:
                storage.put_file(str(file), f"{place.rstrip('/')}/{file.relative_to(local).as_posix()}")


def _open_storage(url: str) -> tuple[Any, str]:
    """Return the storage of a URL, and the path within it."""
    from fsspec.core import url_to_fs

    storage, place = url_to_fs(url)
    storage.invalidate_cache()  # listings of before
    return storage, str(place)


@contextmanager
def name_url_in_errors(url: str) -> Iterator[None]:
    """Name the URL in errors of a storage: each has error types of its own."""
    try:
        yield
    except InvalidInput:
        raise
    except Exception as error:
        got = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InvalidInput(url[:200], expected=EXPECTED, got=got) from None
