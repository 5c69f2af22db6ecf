"""The query process: reads requests from stdin, answers on stdout, ends when its server does.

Run as ``python -m service.queries.worker SCENES CACHE_BYTES ENCODER``. A message from the server is one or more
requests that came at the same time; each is answered by a message of its own, in their order. It warms up while it
waits: the compiled kernels and the encoder named are loaded beside the first requests, which wait for no more than
they need.
"""

from __future__ import annotations

import sys
import threading
import traceback
from typing import Any

from liftcore.errors import SplatliftError
from service.child import fault_of, own_stdout
from service.encoders import encoder_version
from service.queries.answers import Answers, use_one_library_thread
from service.queries.client import Frame, read_frame, write_frame


def reply_to(requests: list[dict[str, Any]], answers: Answers) -> Frame:
    """The answer to the first request, or the error as a header; the others are those that come next."""
    try:
        return answers.reply(requests[0], requests[1:])
    except SplatliftError as error:
        return Frame({"fault": fault_of(error, requests[0]["names"])})
    except Exception:
        traceback.print_exc()
        return Frame({"crash": True})


def _warm_up(answers: Answers, encoder: str) -> None:
    try:
        answers.warm_up(encoder, encoder_version(encoder))
    except Exception:  # whoever asks will meet it again, and is told
        traceback.print_exc()


def main() -> None:
    """Answer until stdin ends."""
    out = own_stdout()
    use_one_library_thread()
    answers = Answers(scenes=int(sys.argv[1]), cache_bytes=int(sys.argv[2]))
    threading.Thread(target=_warm_up, args=(answers, sys.argv[3]), daemon=True).start()
    while (asked := read_frame(sys.stdin.buffer)) is not None:
        requests = asked.header["requests"]
        for first in range(len(requests)):
            write_frame(out, reply_to(requests[first:], answers))


if __name__ == "__main__":
    main()
