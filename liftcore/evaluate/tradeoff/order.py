"""What is compared, the most telling first, and how an order for one run reads."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

HOLD_OUT = 8  # every n-th view is held out of the lifts


@dataclass(frozen=True)
class Candidate:
    """Settings under comparison."""

    name: str
    kind: str  # "dial" or "preset"
    settings: dict[str, Any] = field(default_factory=dict)


EXACT = Candidate("exact", "dial", {"speed": "exact"})
DRAFT = Candidate("draft", "dial", {"speed": "draft"})
CANDIDATES = (
    EXACT,
    Candidate("fast", "dial", {"speed": "fast"}),
    DRAFT,
    Candidate("balanced", "dial", {"speed": "balanced"}),
    Candidate("row-sum", "preset", {"preset": "row-sum"}),
    Candidate("robust", "preset", {"robust_steps": 1}),
    Candidate("fast + robust", "preset", {"speed": "fast", "robust_steps": 1}),
    Candidate("front-mass", "preset", {"preset": "front-mass"}),
    Candidate("argmax", "preset", {"preset": "argmax"}),
    Candidate("centre", "preset", {"preset": "centre"}),
    Candidate("top-k", "preset", {"preset": "top-k"}),
    Candidate("mean", "preset", {"preset": "mean"}),
)


@dataclass(frozen=True)
class Scene:
    """The files, and what to judge by."""

    splats: Path
    cameras: Path
    features: tuple[Path, ...]
    labels: Path | None = None  # masks of views, VIEW/mask [h, w] int: numbers of classes, -1 none
    table: Path | None = None  # text embeddings
    classes: tuple[str, ...] = ()  # the words of the classes, in the order of their numbers


@dataclass(frozen=True)
class Order:
    """One run in a process of its own."""

    scene: Scene
    settings: dict[str, Any]
    lifted: tuple[str, ...]  # views
    held_out: tuple[str, ...]  # views with features
    labelled: tuple[str, ...]  # views with masks, none of them lifted
    threads: int | None
    reference: Path  # a folder: the exact run writes its features there, the others read them
    exact: bool

    def document(self) -> dict[str, Any]:
        """As JSON; paths become text."""
        return _plain(asdict(self))

    @classmethod
    def of(cls, document: dict[str, Any]) -> Self:
        """What ``document`` gave."""
        given = document["scene"]
        labels, table = (Path(given[name]) if given[name] else None for name in ("labels", "table"))
        features, classes = tuple(map(Path, given["features"])), tuple(given["classes"])
        own = Scene(Path(given["splats"]), Path(given["cameras"]), features, labels, table, classes)
        views = {name: tuple(document[name]) for name in ("lifted", "held_out", "labelled")}
        return cls(**{**document, **views, "scene": own, "reference": Path(document["reference"])})


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
