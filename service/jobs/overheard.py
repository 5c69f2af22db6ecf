"""What a job's process prints beside its reports, as records of the server's log."""

from __future__ import annotations

import logging
import threading
from typing import IO

from service.observe import current_id, working_for

LONGEST = 8192  # bytes of a record; what is longer without an end of line comes in pieces

log = logging.getLogger(__name__)


def log_lines(pipe: IO[bytes], job: str) -> threading.Thread:
    """Log each line that comes through a pipe as a warning, until its other ends are closed; the thread that does.

    The records have the job's id, and that of the request that this thread works for.
    """
    request = current_id()

    def listen() -> None:
        with pipe, working_for(request):
            while line := pipe.readline(LONGEST):
                text = line.decode("utf-8", "replace").strip()
                if text:
                    log.warning("%s", text, extra={"fields": {"job": job}})

    thread = threading.Thread(target=listen, name=f"overheard-{job}", daemon=True)
    thread.start()
    return thread
