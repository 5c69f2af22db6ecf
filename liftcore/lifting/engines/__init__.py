"""Engines run a lift in blocks of views and of splats: in this process, or by the workers of a Ray cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidSettings

if TYPE_CHECKING:
    from liftcore.lifting.engines.base import Engine

ENGINES = ("local", "ray")


def open_engine(name: str | None, address: str | None = None, threads: int | None = None) -> Engine | None:
    """Open the engine of a name, as `liftcore.lift` takes it; return None for None.

    Args:
        name: local or ray. address: of the Ray cluster, ``HOST:PORT`` or ``auto``; None starts one here. threads: of
            the local engine.

    Raises:
        InvalidSettings: the name is unknown, or an address is given without Ray. Unavailable: as in `RayEngine`.
    """
    if name is not None and name not in ENGINES:
        raise InvalidSettings("engine", expected=" or ".join(ENGINES), got=repr(name)[:80])
    if address is not None and name != "ray":
        raise InvalidSettings("address", expected="an address beside the engine ray alone", got=f"engine {name}")
    if name == "ray":
        from liftcore.lifting.engines.ray import RayEngine

        return RayEngine(address)
    from liftcore.lifting.engines.base import LocalEngine

    return LocalEngine(threads) if name == "local" else None
