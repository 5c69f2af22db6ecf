"""Text encoders: look-ups, meanings, shapes, and errors of missing words and weights."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from liftcore.errors import InvalidQuery, Unavailable
from liftcore.text import open_encoder, without_templates
from liftcore.text.open_clip import OpenClipEncoder, library, tokenizer_of

pytestmark = pytest.mark.slow

WORDS = ["alarm_clock", "Teapot", "the end", "a", "scar", "car_(automobile)"]


@pytest.fixture(params=[torch.float16, torch.bfloat16])
def table(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    path = tmp_path / "words.safetensors"
    rows = torch.eye(6).mul(3).to(request.param)
    save_file({"embeddings": rows}, str(path), metadata={"words": json.dumps(WORDS)})
    return path


def test_spelling_variants_find_the_same_word_and_others_name_the_nearest(table: Path) -> None:
    encoder = open_encoder(f"table:{table}")
    rows = encoder.encode(["alarm clock", "Alarm_Clock", "an alarm  clock", "THE ALARM CLOCK"])
    assert rows.tolist() == [[1.0, 0, 0, 0, 0, 0]] * 4 and encoder.channels == 6
    assert open_encoder(table).encode(["the end", "a", "teapot"]).argmax(axis=1).tolist() == [2, 3, 1]
    for text, nearest in (("teapott", "Teapot"), ("a car", r"car \(automobile\)")):
        with pytest.raises(InvalidQuery, match=f"nearest: {nearest}") as info:
            encoder.encode([text])
        assert info.value.nearest == (nearest.replace("\\", ""),)


@pytest.fixture(scope="module")
def clip() -> OpenClipEncoder:
    return OpenClipEncoder("small", library().create_model("ViT-S-32-alt"), tokenizer_of("ViT-S-32-alt"))


def test_open_clip_gives_unit_rows_of_its_width_and_none_for_no_text(clip: OpenClipEncoder) -> None:
    rows = clip.encode(["a cat", "a dog on a mat"])
    assert rows.shape == (2, 256) and clip.channels == 256
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, rtol=1e-6)
    with pytest.raises(InvalidQuery, match="empty"):
        clip.encode(["mug", "  "])


def test_templates_give_the_mean_over_their_sentences(clip: OpenClipEncoder, monkeypatch: pytest.MonkeyPatch) -> None:
    assert without_templates("open_clip:ViT-B-32@a#1.pt") == ("open_clip:ViT-B-32@a#1.pt", 1)
    monkeypatch.setattr(OpenClipEncoder, "open", lambda spec, count: (spec, count))
    assert open_encoder("open_clip:ViT-B-32/openai#80") == ("ViT-B-32/openai", 80)
    seven = OpenClipEncoder("small", clip._model, tokenizer_of("ViT-S-32-alt"), 7)
    sentences = ["itap of a mug.", "a bad photo of the mug.", "a origami mug.", "a photo of the large mug."]
    sentences += ["a mug in a video game.", "art of the mug.", "a photo of the small mug."]
    mean = clip.encode(sentences).mean(axis=0)
    assert seven.name == "small#7"
    np.testing.assert_allclose(seven.encode(["mug"])[0], mean / np.linalg.norm(mean), atol=1e-6)


@pytest.mark.parametrize(
    ("model", "error", "message"),
    [
        ("ViT-B-32", Unavailable, "tag or a file"),  # and never random weights
        ("ViT-B-32/none", InvalidQuery, "openai"),
    ],
)
def test_unknown_model_of_open_clip_is_an_error(model: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        open_encoder(f"open_clip:{model}")
