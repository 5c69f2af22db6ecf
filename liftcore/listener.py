"""Whom a lift tells how it goes: of its plan before the work, and of the work as it advances."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.progress import silent

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.plan.plan import Plan
    from liftcore.progress import Progress

log = logging.getLogger(__name__)


def log_warnings(plan: Plan) -> None:
    """Log what the plan has to say of this machine, which no certificate keeps: equal inputs give equal lifts."""
    for warning in plan.warnings:
        log.warning(warning)


@dataclass(frozen=True)
class Listener:
    """What a lift calls. An exception from either stops the work."""

    progress: Progress = silent
    plan: Callable[[Plan], None] = log_warnings  # once a lift, before the first view is walked


NOBODY = Listener()
