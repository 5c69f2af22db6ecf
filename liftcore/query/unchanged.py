"""Whether the files that a lift was made from are still what they were."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import InvalidLift
from liftcore.io.transforms import FRAME_FILE

if TYPE_CHECKING:
    from liftcore.result import InputFile

COUNTS = {"cameras": f" ({FRAME_FILE} beside them counts too)"}


def unchanged(role: str, remembered: InputFile, lift: Path) -> Path:
    """The path of an input, once its bytes are known to be those that were lifted.

    Args:
        role: what the input is, for the message: ``splats``, ``cameras`` or ``features``.
        remembered: where it was at lift time, and its SHA-256.
        lift: the lift file that remembers it.

    Raises:
        InvalidLift: nothing is there any more, or something else is.
    """
    path = Path(remembered.path)
    if not path.exists():
        raise InvalidLift(
            str(lift),
            expected=f"its {role} at {path}",
            got="nothing there",
            hint=f"move the {role} back to {path}, or lift again from where they are now",
        )
    # The lift's own digest: one definition for files and folders, where it was taken and where it is checked.
    from liftcore.io.input_files import camera_input, input_file

    found = (camera_input if role == "cameras" else input_file)(path)
    if found.sha256 != remembered.sha256:
        raise InvalidLift(
            str(lift),
            expected=f"the {role} that were lifted at {path}",
            got="a file with another SHA-256",
            hint=f"the {role} changed since the lift{COUNTS.get(role, '')}: restore them, or lift again",
        )
    return path
