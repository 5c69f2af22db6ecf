"""Another system, as far as a program under Linux can see one: what macOS and Windows lack is taken away.

Modules, calls and flags that they do not have are gone, and ``sys.platform`` is theirs. As on Windows, no file is
removed or replaced that is open or mapped, and the C library has no address. Other packages are imported before: they
have builds of their own for each system. Paths stay those of Linux.
"""

from __future__ import annotations

import ctypes
import importlib
import mmap
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal
from unittest import mock

System = Literal["darwin", "win32"]

PACKAGES = (
    *(
        "torch",
        "numba",
        "numpy",
        "scipy.ndimage",
        "scipy.optimize",
        "scipy.sparse.csgraph",
        "scipy.spatial",
        "PIL.Image",
    ),
    *("plyfile", "pydantic", "safetensors.numpy", "zstandard", "fsspec.core", "tqdm", "threadpoolctl"),
    *("asyncio", "concurrent.futures", "multiprocessing.pool", "platform", "subprocess", "tempfile", "unittest.mock"),
)
MODULES: dict[System, tuple[str, ...]] = {
    "darwin": ("ossaudiodev", "spwd"),
    "win32": (
        *(
            "crypt",
            "curses",
            "fcntl",
            "grp",
            "nis",
            "ossaudiodev",
            "posix",
            "pty",
            "pwd",
            "readline",
            "resource",
            "spwd",
        ),
        *("syslog", "termios", "tty"),
    ),
}
LINUX_CALLS = (
    *("copy_file_range", "eventfd", "memfd_create", "pipe2", "posix_fadvise", "posix_fallocate", "sched_getaffinity"),
    *("sched_setaffinity", "setns", "splice", "unshare", "O_DIRECT", "O_PATH", "O_TMPFILE"),
)
UNIX_CALLS = (
    *("chown", "chroot", "ctermid", "fchdir", "fchmod", "fchown", "fork", "forkpty", "getegid", "geteuid", "getgid"),
    *("getgroups", "getloadavg", "getpgid", "getpgrp", "getpriority", "getsid", "getuid", "initgroups", "killpg"),
    *("lchown", "lockf", "major", "mkfifo", "mknod", "nice", "openpty", "pathconf", "posix_spawn", "pread", "preadv"),
    *("pwrite", "pwritev", "readv", "register_at_fork", "sched_yield", "sendfile", "setegid", "seteuid", "setgid"),
    *(
        "setpgid",
        "setpriority",
        "setsid",
        "setuid",
        "sync",
        "sysconf",
        "tcgetpgrp",
        "ttyname",
        "uname",
        "wait",
        "wait3",
    ),
    *("wait4", "writev", "O_CLOEXEC", "O_DIRECTORY", "O_NOCTTY", "O_NOFOLLOW", "O_NONBLOCK", "O_SYNC"),
)
MAP_FLAGS = ("MAP_PRIVATE", "MAP_SHARED", "MAP_ANONYMOUS", "MAP_ANON", "MAP_NORESERVE", "PROT_READ", "PROT_WRITE")
SYSTEM_FILES = ("/proc", "/sys")


class WindowsMap(mmap.mmap):
    """A map that knows no flags and no protections."""

    def __new__(cls, fileno: int, length: int, tagname: str | None = None, access: int = 0, offset: int = 0) -> Any:
        return super().__new__(cls, fileno, length, access=access, offset=offset)


class WindowsLibrary(ctypes.CDLL):
    """A library by its name: the process itself is none."""

    def __init__(self, name: str | None, *arguments: Any, **keywords: Any) -> None:
        if name is None:
            raise TypeError("LoadLibrary() argument 1 must be str, not None")
        super().__init__(name, *arguments, **keywords)


def become(system: System) -> None:
    """Take away what ``system`` lacks, for the rest of this process.

    Raises:
        RuntimeError: liftcore was imported before.
    """
    if "liftcore" in sys.modules:
        raise RuntimeError("liftcore must be imported afterwards: it looks at its system as it is imported")
    for name in PACKAGES:
        importlib.import_module(name)
    mock.patch.object(tempfile, "TemporaryFile", tempfile.NamedTemporaryFile).start()  # the other has no name
    _refuse_system_files()
    if system == "win32":
        _keep_used_files()
        mock.patch.object(mmap, "mmap", WindowsMap).start()
        mock.patch.object(ctypes, "CDLL", WindowsLibrary).start()
    sys.modules.update(dict.fromkeys(MODULES[system]))  # pyright: ignore - None: none of that name is there
    for name in LINUX_CALLS + (UNIX_CALLS if system == "win32" else ()):
        vars(os).pop(name, None)  # pyright: ignore - a module's are a dict
    for name in MAP_FLAGS if system == "win32" else ():
        vars(mmap).pop(name, None)  # pyright: ignore - a module's are a dict
    sys.platform = system


def _refuse_system_files() -> None:
    """Have ``/proc`` and ``/sys`` lie nowhere."""
    system_open, is_file = os.open, Path.is_file
    read_text = Path.read_text

    def refuse(path: Any, *arguments: Any, **keywords: Any) -> Any:
        _refuse(path)
        return system_open(path, *arguments, **keywords)

    def refuse_text(path: Path, *arguments: Any, **keywords: Any) -> str:
        _refuse(path)
        return read_text(path, *arguments, **keywords)

    mock.patch("os.open", refuse).start()
    mock.patch.object(Path, "read_text", refuse_text).start()
    mock.patch.object(Path, "is_file", lambda path: not str(path).startswith(SYSTEM_FILES) and is_file(path)).start()


def _refuse(path: Any) -> None:
    if isinstance(path, str | Path) and str(path).startswith(SYSTEM_FILES):
        raise FileNotFoundError(2, "no such file", str(path))


def _keep_used_files() -> None:
    """Refuse to remove or replace files that this process has open or mapped."""
    readlink, listdir, reader = os.readlink, os.listdir, open

    def check(path: Any) -> None:
        target = os.path.realpath(path)
        numbers = listdir("/proc/self/fd")
        used_files = set[str]()
        for number in numbers:
            try:
                used_files.add(readlink(f"/proc/self/fd/{number}"))
            except FileNotFoundError:  # that of the listing itself
                continue
        with reader("/proc/self/maps", encoding="utf-8") as lines:
            used_files |= {line.split(maxsplit=5)[5].rstrip("\n") for line in lines if line.count("/")}
        if target in used_files:
            raise PermissionError(13, "The process cannot access the file because it is being used", str(path))

    def guard(call: Any, targets: int) -> Any:
        def refuse(*paths: Any, **keywords: Any) -> Any:
            for path in paths[:targets]:
                check(path)
            return call(*paths, **keywords)

        return refuse

    for name, targets in (("unlink", 1), ("remove", 1), ("replace", 2), ("rename", 2)):
        mock.patch.object(os, name, guard(getattr(os, name), targets)).start()
    # Removal by paths, as Windows has it; from Python 3.14 on it is chosen when shutil is imported.
    mock.patch.object(shutil, "_use_fd_functions", False).start()
    if hasattr(shutil, "_rmtree_impl"):
        mock.patch.object(shutil, "_rmtree_impl", vars(shutil)["_rmtree_unsafe"]).start()
