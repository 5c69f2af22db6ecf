"""What the service logs: one record a line on stderr, as JSON for programs or as text for people."""

from __future__ import annotations

import json
import logging
import re
import sys
import threading
from datetime import UTC, datetime
from typing import Any

from service import request_id

SECRET = re.compile(r"(?i)\b(bearer|basic)\s+[^\s\"',;]+")


def start_logging(log_format: str) -> None:
    """Send the records of this process to stderr, warnings and threads that died among them; call once, in `main`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else TextLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.captureWarnings(True)
    threading.excepthook = _thread_died


class JsonLines(logging.Formatter):
    """A JSON object a record: ``time``, ``level``, ``logger``, ``message``, then what the record brings.

    A record brings ``request_id`` when it is made for a request, ``error`` with an exception's trace, and whatever it
    was given as ``extra={"fields": {...}}``.
    """

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        return json.dumps(_told(self, record), ensure_ascii=True, default=str)


class TextLines(logging.Formatter):
    """The same for people: time, level, logger and message, the rest as ``name=value``, then the trace."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, and those of the trace."""
        told = _told(self, record)
        trace = told.pop("error", None)
        time, level, logger, message = (told.pop(name) for name in ("time", "level", "logger", "message"))
        rest = "".join(f" {name}={json.dumps(value, default=str)}" for name, value in told.items())
        line = f"{time} {level.upper()} {logger}: {_one_line(message)}{rest}"
        return line if trace is None else f"{line}\n{trace}"


def _told(formatter: logging.Formatter, record: logging.LogRecord) -> dict[str, Any]:
    moment = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
    told: dict[str, Any] = {
        "time": moment.replace("+00:00", "Z"),
        "level": record.levelname.lower(),
        "logger": record.name,
        "message": _without_secrets(record.getMessage()),
    }
    request = request_id.current()
    if request is not None:
        told["request_id"] = request
    told |= getattr(record, "fields", {})
    if record.exc_info:
        told["error"] = _without_secrets(formatter.formatException(record.exc_info))
    return told


def _without_secrets(text: str) -> str:
    """No record is made of headers; this is for traces that quote them."""
    return SECRET.sub(r"\1 [hidden]", text)


def _one_line(text: str) -> str:
    return text.encode("unicode_escape").decode() if not text.isprintable() else text


def _thread_died(died: threading.ExceptHookArgs) -> None:
    name = died.thread.name if died.thread is not None else "a thread"
    trace = (died.exc_type, died.exc_value or died.exc_type(), died.exc_traceback)
    logging.getLogger(__name__).error("%s died", name, exc_info=trace)
