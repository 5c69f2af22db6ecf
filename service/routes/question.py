"""From a question over HTTP to a request of the query process, and to links to the same question."""

from __future__ import annotations

import hashlib
import json
from typing import Any
from urllib.parse import urlencode

from liftcore import __version__
from service import wire
from service.parts import Parts
from service.settings import encoder_file, encoder_version
from service.store.assets import kernel_of
from service.store.lifts import LiftRecord

Question = wire.Asked | wire.AskedInBody
REGION = "region:"  # what needs the lift's feature packs begins with it


def find_lift(lift: str | None, here: Parts) -> LiftRecord:
    """The lift that is meant; left out, the only one."""
    return here.store.lifts.only() if lift is None else here.store.lifts.get(lift)


def scene_request(operation: str, lift: LiftRecord, here: Parts) -> dict[str, Any]:
    """What the query process must know of a lift's files; ``names`` says what the client calls them."""
    job = here.store.jobs.get(lift.id)
    splats, cameras = here.store.assets.get(job.splats), here.store.assets.get(job.cameras)
    return {
        "operation": operation,
        "lift": str(lift.path),
        "splats": str(splats.path),
        "cameras": str(cameras.path),
        "kernel": kernel_of(splats, lift.metadata["settings"]),
        "names": {
            str(lift.path): f"lift {lift.id}",
            str(splats.path): f"splats {splats.id}",
            str(cameras.path): f"cameras {cameras.id}",
        },
    }


def query_request(operation: str, asked: Question, lift: LiftRecord, here: Parts) -> dict[str, Any]:
    """The same with a query; texts bring their encoder, and examples of regions the lift's feature packs."""
    request = scene_request(operation, lift, here)
    spec = None
    if asked.text or asked.negatives:
        spec = here.settings.encoder_spec(lift.metadata["text_space"], asked.encoder)
        file = encoder_file(spec)
        request["names"] |= {} if file is None else {str(file): "the encoder's file"}
    if any(isinstance(example, str) and example.startswith(REGION) for example in (*asked.like, *asked.unlike)):
        packs = [here.store.assets.get(asset) for asset in here.store.jobs.get(lift.id).features]
        request["features"] = [str(pack.path) for pack in packs]
        request["names"] |= {str(pack.path): f"features {pack.id}" for pack in packs}
    terms = ("text", "negatives", "like", "unlike", "threshold", "instances", "keep")
    return request | {
        "encoder": spec,
        "encoder_version": None if spec is None else encoder_version(spec),
        "query": {name: getattr(asked, name) for name in terms},
    }


def entity_tag(asked: dict[str, Any], lift: LiftRecord) -> str:
    """The tag of an answer, from all that decides it: so 304 costs no query."""
    decides = {name: value for name, value in asked.items() if name != "names"}
    decides["lift"] = lift.sha256
    decides["version"] = __version__
    return f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"'


def answer_links(asked: Question, lift: LiftRecord, view: str | None, *, found: bool) -> dict[str, str]:
    """The URLs of other looks at the same query; vectors do not fit in one, and are sent there again.

    Where nothing was ``found`` there are no objects.
    """
    links = {"lift": f"/lifts/{lift.id}", "scores": _link("/query/scores", asked, lift=lift.id)}
    if found:
        links["objects"] = _link("/query/objects", asked, lift=lift.id)
        links["object"] = _link("/query/splats?what=object", asked, lift=lift.id)
    links["coloured"] = _link("/query/splats?what=scores", asked, lift=lift.id)
    if view is not None:
        links["mask"] = _link("/query/mask", asked, lift=lift.id, view=view)
        links["attention"] = _link("/query/attention", asked, lift=lift.id, view=view)
        links["render"] = f"/render?{urlencode({'lift': lift.id, 'view': view})}"
    return links


def shown(example: str | list[float]) -> str:
    """An example as an answer names it."""
    return example if isinstance(example, str) else f"a vector of {len(example)} channels"


def _link(path: str, asked: Question, **more: str) -> str:
    pairs: list[tuple[str, str]] = []
    for name in ("text", "like", "negatives", "unlike"):
        values = getattr(asked, name)
        if not all(isinstance(value, str) for value in values):
            return path
        pairs += [(name, value) for value in values]
    pairs.append(("threshold", str(asked.threshold)))
    pairs += [("instances", str(asked.instances))] if asked.instances is not None else []
    pairs += [("keep", asked.keep)] if asked.keep != "all" else []
    pairs += [("encoder", asked.encoder)] if asked.encoder is not None else []
    return f"{path}{'&' if '?' in path else '?'}{urlencode(pairs + list(more.items()))}"
