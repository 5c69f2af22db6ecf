"""How text encoders are named. Importing this loads no torch."""

from __future__ import annotations

ENCODER_SPECS = (
    "table:FILE.safetensors",
    "minilm",
    "open_clip:MODEL/PRETRAINED_TAG",
    "open_clip:MODEL@WEIGHTS_FILE",
)
NO_WORDS = "none"  # the text space of features that no text encoder shares
