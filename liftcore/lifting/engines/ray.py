"""Pieces of a lift by the workers of a Ray cluster (the extra ``splatlift[ray]``).

A worker needs this package, and the folders of the lift under the same paths. Ray sends it `PiecesInFiles`, of a few
kilobytes, and receives nothing: results are files, so that no object store ever holds W or X.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput, SplatliftError, Unavailable
from liftcore.runtime.one_line import one_line

if TYPE_CHECKING:
    from liftcore.lifting.engines import Work
    from liftcore.lifting.pieces import Pieces

MAX_QUEUED = 1_000  # pieces that are submitted to Ray at a time
RETRIES = 5  # of a piece whose worker or node died; a piece that fails more often is itself the cause


class RayEngine:
    """An engine that runs pieces on the workers of a Ray cluster, and repeats a piece whose worker dies.

    Args:
        address: ``host:port`` of a cluster, or ``auto`` for the one of RAY_ADDRESS or of this machine; None starts
            one on this machine's cores, which ends with the process. Ray runs any code that it receives, so a cluster
            that other machines can reach must require a token (RAY_AUTH_MODE=token).
        scratch: a folder that all workers share, for lifts without a checkpoint; None: the system's temporary folder.
        cpus: cores of a worker. gpus: GPUs, or a share of one, of a worker, if the lift's device is cuda.

    Raises:
        Unavailable: Ray is not installed, the cluster does not exist, or others can reach it without a token.
    """

    def __init__(
        self, address: str | None = None, *, scratch: Path | str | None = None, cpus: int = 1, gpus: float = 1.0
    ) -> None:
        if cpus < 1:
            raise InvalidInput("cpus", expected="at least 1 core of a worker", got=str(cpus))
        if not 0 < gpus <= 64:
            raise InvalidInput("gpus", expected="a share of a GPU above 0, or whole GPUs", got=str(gpus))
        self.scratch = None if scratch is None else Path(scratch)
        self._address, self._cpus, self._gpus = address, cpus, gpus
        self._ray: Any = _connected(address)

    def __repr__(self) -> str:
        return one_line(self, repr(self._address), f"cpus={self._cpus}", f"gpus={self._gpus}")

    def run(self, work: Work, pieces: Pieces, count: int) -> Iterator[int]:
        """See `lifting.engines.Engine`."""
        ray = self._ray
        needs: dict[str, float] = {"num_cpus": self._cpus, "max_retries": RETRIES}
        if pieces.settings.device == "cuda":
            needs["num_gpus"] = self._gpus
        task, pieces_ref = ray.remote(**needs)(work), ray.put(pieces)
        numbers, waiting = iter(range(count)), dict[Any, int]()

        def send(limit: int) -> None:
            for number, _ in zip(numbers, range(limit), strict=False):
                waiting[task.remote(pieces_ref, number, self._cpus)] = number

        try:
            send(min(count, MAX_QUEUED))
            while waiting:
                (task_ref,), _ = ray.wait(list(waiting), num_returns=1)
                number = waiting.pop(task_ref)
                self._check(task_ref)
                send(1)
                yield number
        finally:
            for piece in waiting:
                ray.cancel(piece, force=True)

    def _check(self, task_ref: Any) -> None:
        """Raise the error of a piece, if it has one."""
        errors = self._ray.exceptions
        try:
            self._ray.get(task_ref)
        except errors.RayTaskError as error:
            if isinstance(error.cause, SplatliftError | OSError | MemoryError):
                raise error.cause from None
            raise
        except errors.RayError as error:
            got = str(error).strip().splitlines()[0][:200]
            raise Unavailable(
                "engine",
                expected=f"a worker that finishes a piece in {RETRIES + 1} attempts",
                got=got,
                hint="see the cluster's log; most often a worker had too little memory",
            ) from None


def _connected(address: str | None) -> Any:
    """Connect to a Ray cluster, and return the module."""
    try:
        ray: Any = import_module("ray")
    except ImportError:
        hint = "pip install 'splatlift[ray]'"
        raise Unavailable("engine", expected="Ray, which is an extra", got="none", hint=hint) from None
    if ray.is_initialized():
        check_reach(ray.get_runtime_context().gcs_address)
        return ray
    if address not in (None, "auto"):
        check_reach(address)
    quiet = {"log_to_driver": False, "configure_logging": False}
    local = {"_node_ip_address": "127.0.0.1", "include_dashboard": False} if address is None else {}
    try:
        ray.init(address=address or "local", **quiet, **local)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        got = str(error).strip().splitlines()[0][:200]
        hint = "start one with 'ray start --head', or leave the address out"
        raise Unavailable("engine", expected=f"a Ray cluster at {address}", got=got, hint=hint) from None
    try:
        check_reach(ray.get_runtime_context().gcs_address)
    except Unavailable:
        ray.shutdown()
        raise
    return ray


def check_reach(address: str) -> None:
    """Check that a cluster is on loopback, or requires a token.

    Args:
        address: ``host:port``, with ``ray://`` before it or not.

    Raises:
        Unavailable: others can reach it without a token, or the host is unknown.
    """
    host = address.removeprefix("ray://").rpartition(":")[0].strip("[]")
    try:
        addresses = {entry[4][0] for entry in socket.getaddrinfo(host, None)}
    except OSError as error:
        raise Unavailable("engine", expected="host:port of a Ray cluster", got=f"{address} ({error})") from None
    is_loopback = all(ipaddress.ip_address(address_text).is_loopback for address_text in addresses)
    if not is_loopback and os.environ.get("RAY_AUTH_MODE") != "token":
        raise Unavailable(
            "engine",
            expected="a cluster on loopback, or one with tokens, as Ray runs any code that it receives",
            got=f"{address} without RAY_AUTH_MODE=token",
            hint="start all its nodes, and this process, with RAY_AUTH_MODE=token and one RAY_AUTH_TOKEN",
        )
