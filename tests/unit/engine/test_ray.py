"""A lift on Ray's workers is bitwise identical to one process, also where a worker or a node dies."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import secrets
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import liftcore as lc
from liftcore.lifting.engines import LocalEngine, open_engine
from liftcore.lifting.engines.ray import RayEngine, check_reach
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings

from .test_blocks import assert_same, in_blocks, scene

__all__ = ["scene"]  # the fixture
NEW_NETWORK, SET_FLAGS, IS_UP = 0x40000000, 0x8914, 0x41  # of Linux: CLONE_NEWNET, SIOCSIFFLAGS, up and running
with_ray = pytest.mark.filterwarnings("ignore")  # Ray's own


@contextmanager
def loopback_alone() -> Iterator[None]:
    """Enter a network namespace with loopback only, for this thread and its children, where that is allowed.

    Without it (it requires root) only the cluster's token keeps other processes out.
    """
    system = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open() as before:
        has_namespace = system.unshare(NEW_NETWORK) == 0
        if has_namespace:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
                fcntl.ioctl(any_socket, SET_FLAGS, struct.pack("16sh14x", b"lo", IS_UP))
        try:
            yield
        finally:
            assert not has_namespace or system.setns(before.fileno(), NEW_NETWORK) == 0


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Start two nodes of one core each, which require a token; tests that remove a node add a third."""
    with loopback_alone():
        yield from running_cluster()


def running_cluster() -> Iterator[Any]:
    os.environ["RAY_AUTH_MODE"], os.environ["RAY_AUTH_TOKEN"] = "token", secrets.token_hex(16)  # read at the import
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'splatlift[ray]'")
    Cluster = import_module("ray.cluster_utils").Cluster
    node = {"num_cpus": 1, "object_store_memory": 80_000_000}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    cluster.add_node(**node)
    ray.init(address=cluster.address, log_to_driver=False, configure_logging=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        del os.environ[name]


@pytest.fixture(scope="module")
def stored(scene: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("scene") / "pack.safetensors"
    write_pack(path, scene["views"], {})
    return {**scene, "views": lc.read_features(path)}


class Deadly(RayEngine):
    """An engine whose worker dies in one piece, once: another, which takes seconds to start, repeats it."""

    def run(self, work: Any, pieces: Any, count: int) -> Iterator[int]:
        def deadly(pieces: Any, piece: int, threads: int | None) -> None:
            mark = pieces.folder / f"{work.__name__}.died"
            if (piece, work.__name__) == (1, "solve") and not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            work(pieces, piece, threads)

        yield from super().run(deadly, pieces, count)


@with_ray
@pytest.mark.slow
def test_workers_and_nodes_may_die(
    cluster: Any, stored: dict[str, Any], scene: dict[str, Any], tmp_path: Path
) -> None:
    settings = LiftSettings.of(preset="default", diagnostic_rays=0)
    expected = in_blocks(LocalEngine(1), stored, settings)
    folder = tmp_path / "killed"
    assert_same(in_blocks(Deadly("auto"), stored, settings, folder=folder), expected)
    assert any(folder.rglob("solve.died"))
    third = cluster.add_node(num_cpus=1, object_store_memory=80_000_000)

    def remove(stage: str, completed: int, total: int, unit: str) -> None:
        if stage == "geometry" and third in cluster.list_all_nodes():
            cluster.remove_node(third, allow_graceful=False)

    assert_same(in_blocks(RayEngine("auto"), scene, settings, progress=remove), expected)  # values, not files
    with pytest.raises(lc.InvalidFeatures, match="channels"):  # as the piece says it
        in_blocks(RayEngine("auto"), {**stored, "views": _broken(stored["views"])}, settings)
    with pytest.raises(OSError, match="No space") as raised:  # with its number, by which a full disk is known
        list(RayEngine("auto").run(_full, cast("Any", SimpleNamespace(settings=settings)), 1))
    assert raised.value.errno == errno.ENOSPC


def _full(pieces: Any, piece: int, threads: int | None) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def _broken(views: Any) -> Any:
    """Return views that declare one channel more than their packs have, which only a reader notices."""
    return replace(views, channels=views.channels + 1, paths=())


def test_cluster_that_others_reach_must_ask_for_a_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    for address in ("127.0.0.1:6379", "localhost:1", "ray://[::1]:2"):
        check_reach(address)
    with pytest.raises(lc.Unavailable, match=r"got 192\.0\.2\.1:6379 without RAY_AUTH_MODE=token"):
        check_reach("192.0.2.1:6379")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    check_reach("192.0.2.1:6379")
    with pytest.raises(lc.Unavailable, match="host:port of a Ray cluster"):
        check_reach("no host.invalid:1")


def test_engines_are_named() -> None:
    assert open_engine(None) is None
    assert isinstance(open_engine("local", threads=1), LocalEngine)
    with pytest.raises(lc.InvalidSettings, match="an address beside the engine ray alone"):
        open_engine("local", "auto")
