"""Files that lie elsewhere (``s3://``, ``gs://``, ``https://`` and whatever else fsspec opens).

Readers map their files, which only files of this machine can be. So what is read is copied here whole, once for each
version that its storage tells apart, and what is written is written here first and then sent.
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
OPENED = "a file or folder that fsspec opens, such as s3://bucket/scene.ply (needs s3fs) or file:///scene.ply"


def is_remote(path: Path | str) -> bool:
    """Whether a text names a protocol. A ``Path`` never does: it takes ``s3://b`` for ``s3:/b``."""
    return isinstance(path, str) and REMOTE.match(path) is not None


def check_path(path: object, argument: str = "path") -> None:
    """Refuse what names no file.

    Raises:
        InvalidInput: it is neither a path nor a text, or an empty text.
    """
    if not isinstance(path, str | os.PathLike) or not str(path):
        got = f"{type(path).__name__} {path!r}"[:80]
        hint = "give several paths one by one" if isinstance(path, list | tuple) else ""
        raise InvalidInput(argument, expected="the path of a file or folder", got=got, hint=hint)


def local_path(path: Path | str, argument: str = "path") -> Path:
    """The path of a file or folder of this machine: the given one, or that of a copy of what lies elsewhere.

    Copies lie in ``splatlift/remote`` of the user's cache folder (XDG_CACHE_HOME), which may be emptied at any time.

    Args:
        argument: that errors name.

    Raises:
        InvalidInput: nothing is there, or it cannot be opened or copied; the error says why.
    """
    check_path(path, argument)
    if not is_remote(path):
        return Path(path)
    url = str(path)
    with name_url_in_errors(url):
        storage, place = _opened(url)
        found: dict[str, Any] = storage.find(place, detail=True)
        if not found:
            raise FileNotFoundError("nothing is there")
        # Of HTTP ukey is the address alone: what is told of a file (ETag, size, time) tells its versions apart. Of a
        # file that is asked for itself `find` tells nothing, and of one in a folder over HTTP no size and no tag.
        told = {name: known if known.get("size") is not None else storage.info(name) for name, known in found.items()}
        versions = sorted((name, storage.ukey(name), sorted(map(str, told[name].items()))) for name in found)
        base = cache_folder("remote")
        name = PurePosixPath(place.rstrip("/")).name
        copy = base / hashlib.sha256(repr((url, versions)).encode()).hexdigest()[:32] / name
        if copy.exists():
            return copy
        base.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=base, prefix=".part-"))
        try:
            for one in found:
                inside = PurePosixPath(one).relative_to(place.rstrip("/"))
                to = draft / name / inside
                to.parent.mkdir(parents=True, exist_ok=True)
                storage.get_file(one, str(to))
            copy.parent.mkdir(exist_ok=True)
            if not copy.exists():  # else another process was quicker
                (draft / name).rename(copy)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return copy


def local_paths(paths: Path | str | Iterable[Path | str], argument: str = "path") -> list[Path]:
    """`local_path` of each; one path alone is a list of it."""
    return [local_path(path, argument) for path in as_list(paths)]


def require_storage(url: str) -> None:
    """Look at where something is to be written: an hour of work is not lost over a missing package or key.

    Raises:
        InvalidInput: its storage does not open.
    """
    with name_url_in_errors(url):
        storage, place = _opened(url)
        storage.exists(place)


@contextmanager
def landing(path: Path | str) -> Iterator[Path]:
    """Where to write a file or folder: at the path itself, or in a temporary folder from where it is sent.

    Of a folder the file that sorts last is sent last, and taken away first: of a lift in shards the index.

    Raises:
        InvalidInput: it is no path, or cannot be sent.
    """
    check_path(path)
    if not is_remote(path):
        yield Path(path)
        return
    url = str(path)
    with scratch_folder("splatlift-") as folder:
        with name_url_in_errors(url):
            storage, place = _opened(url)
        made = folder / PurePosixPath(place.rstrip("/")).name
        yield made
        with name_url_in_errors(url):
            if made.is_file():
                storage.makedirs(str(PurePosixPath(place).parent), exist_ok=True)
                storage.put_file(str(made), place)
                return
            files = sorted(one for one in made.rglob("*") if one.is_file())
            last = f"{place.rstrip('/')}/{files[-1].relative_to(made).as_posix()}"
            if storage.exists(last):
                storage.rm_file(last)
            storage.makedirs(place, exist_ok=True)
            for one in files:
                storage.put_file(str(one), f"{place.rstrip('/')}/{one.relative_to(made).as_posix()}")


def _opened(url: str) -> tuple[Any, str]:
    """The storage of a URL, and the path within it."""
    from fsspec.core import url_to_fs

    storage, place = url_to_fs(url)
    storage.invalidate_cache()  # listings of before
    return storage, str(place)


@contextmanager
def name_url_in_errors(url: str) -> Iterator[None]:
    """Name the URL in whatever a storage raises: each has errors of its own."""
    try:
        yield
    except InvalidInput:
        raise
    except Exception as error:
        got = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InvalidInput(url[:200], expected=OPENED, got=got) from None
