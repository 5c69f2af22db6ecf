"""The document of a trade-off by its new names and its old ones. Loads no torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from liftcore.runtime.aliases import AliasedDict, current_names, with_old_names
from liftcore.values.settings import LiftSettings

OLD_KEYS = {"skipped": "over_budget", "refused": "invalid_runs"}  # of documents of 0.4: new names by old ones
OLD_FIGURES = {"seen_share": "feature_share"}  # of a run, likewise


class TradeoffDocument(AliasedDict):
    """Figures of a trade-off by their names, as plain numbers and ready for JSON."""

    aliases = OLD_KEYS


def tradeoff_of_reply(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a trade-off, of 0.4 too, with each old name behind its new one.

    Raises:
        InvalidInput: an old and a new name have different values.
    """
    fields = with_old_names(current_names(document, OLD_KEYS), OLD_KEYS)
    return fields | {"runs": [_run_of_reply(run) for run in fields["runs"]]}


def _run_of_reply(run: Mapping[str, Any]) -> dict[str, Any]:
    figures = with_old_names(current_names(run, OLD_FIGURES), OLD_FIGURES)
    settings = {name: LiftSettings.with_old_names(run[name]) for name in ("options", "settings") if name in run}
    return figures | settings
