"""/lift, /tradeoff and /jobs: work and how far it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import JSONResponse

from liftcore import Kernel, LiftSettings
from liftcore.errors import InvalidFeatures, InvalidSettings, InvalidSplats
from liftcore.files import cameras_of_views, require_pairs, with_panoramas
from liftcore.text.table import Vocabulary
from service import models
from service.child import error_of
from service.content import Cursor, Limit, page_response
from service.errors import InvalidRequest, OverLimit
from service.observe import current_id
from service.problems import problem_of
from service.requests import JsonRoute, OrderRoute
from service.sandbox import run_sandboxed
from service.state import AppState, Deps
from service.store.assets import ALL, AssetRecord, kernel_of
from service.store.jobs import Event, EventKind, JobOrder, JobRecord, fingerprint, labels_of

FLOAT_BYTES = 2  # at least: of float16, the default of features
router = APIRouter(route_class=JsonRoute)

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x20-\x7e]+$",
        description="chosen by the client; the same order with the same key is the same job",
    ),
]  # fmt: skip
LastEvent = Annotated[
    int, Header(alias="Last-Event-ID", ge=0, le=2**53, description="the last event that the client has")
]
RESULT_LINKS: dict[models.JobKind, Callable[[str], dict[str, str]]] = {
    models.JobKind.LIFT: lambda job: {"lift": f"/lifts/{job}", "features": f"/lifts/{job}/features"},
    models.JobKind.TRADEOFF: lambda job: {"tradeoff": f"/tradeoffs/{job}", "chart": f"/tradeoffs/{job}/chart"},
}
EVENT = {
    "type": "object",
    "description": "one event",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"enum": [kind.value for kind in EventKind]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
EVENT_DATA = {EventKind.PROGRESS: models.Progress, EventKind.PLAN: models.Plan, EventKind.LOG: models.LogLine}
EVENTS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events; the data are a JobStep, a Plan, a Progress or a LogLine as JSON",
        "content": {"text/event-stream": {"schema": EVENT}},
    },
    204: {"description": "The job has ended, and the client has its last event"},
}
REPEATED_ORDER: dict[int | str, dict[str, Any]] = {
    200: {"model": models.Job, "description": "The job that the same key made before"}
}


@router.post(
    "/lift", response_model=models.Job, status_code=202, responses=REPEATED_ORDER, tags=["jobs"],
)  # fmt: skip
async def order_lift(order: models.LiftRequest, deps: Deps, key: Key = None) -> Response:
    """Lift features onto splats. The job is on the disk before the reply."""
    return await anyio.to_thread.run_sync(_lift, order, deps, key, limiter=deps.ordering)


# OpenAPI has one operation for this and the upload of a lift file, in `service.routes.lifts`.
router.add_api_route(
    "/lifts", order_lift, methods=["POST"], route_class_override=OrderRoute, include_in_schema=False, status_code=202
)


@router.post("/lift/plan", response_model=models.Plan, tags=["jobs"])
async def plan_lift(order: models.LiftRequest, deps: Deps) -> models.Plan:
    """Plan a lift without running it: the views that it would use, and the memory."""
    return await anyio.to_thread.run_sync(_planned, order, deps, limiter=deps.planning)


@router.post(
    "/tradeoff", response_model=models.Job, status_code=202, responses=REPEATED_ORDER, tags=["trade-offs"],
)  # fmt: skip
async def order_tradeoff(order: models.TradeoffRequest, deps: Deps, key: Key = None) -> Response:
    """Compare quality levels and presets on a scene within a budget. The job is on the disk before the reply."""
    return await anyio.to_thread.run_sync(_compare, order, deps, key, limiter=deps.ordering)


def _lift(order: models.LiftRequest, deps: AppState, key: str | None) -> Response:
    settings = LiftSettings.of_json(order.settings).model_dump(mode="json")
    # leave out fields that earlier releases did not have, so that equal orders have equal digests
    document = order.model_dump(mode="json", exclude=None if order.table else {"table"})
    parameters = {} if order.table is None else {"table": order.table}
    return _take(order, deps, key, order_json=document, settings=settings, parameters=parameters)


def _planned(order: models.LiftRequest, deps: AppState) -> models.Plan:
    settings = LiftSettings.of_json(order.settings).model_dump(mode="json")
    job_order = JobOrder(order.splats, order.cameras, tuple(order.features), settings)
    _require_fit(job_order, deps)
    deps.query_client.require_device(job_order.settings.get("device", "auto"))
    splats, cameras, *packs = [deps.store.assets.get(deps.owner, *asset) for asset in job_order.assets()]
    document = {
        "splats": str(splats.path), "cameras": str(cameras.path), "features": [str(pack.path) for pack in packs],
        "settings": settings, "engine": deps.settings.engine,
        "names": {str(record.path): f"{record.kind} {record.id}" for record in (splats, cameras, *packs)},
    }  # fmt: skip
    with deps.store.files.scratch() as scratch:
        file = scratch / "order.json"
        file.write_text(json.dumps(document))
        result = run_sandboxed("service.tasks.plan", [str(file)], scratch, deps.check_limits)
    if result is not None and result.last["event"] == "valid":
        return models.Plan.model_validate(result.last["plan"])
    if result is not None and result.last["event"] == "invalid":
        raise error_of(result.last["fault"])
    raise OverLimit(
        "plan", expected="a lift that is planned within the limits of an upload's check", got="one that needs more",
        hint="order it without: its job plans too",
    )  # fmt: skip


def _compare(order: models.TradeoffRequest, deps: AppState, key: str | None) -> Response:
    settings = order.settings
    if models.TRADEOFF_SETTING in settings:
        expected, got = "settings that are the same in all runs", "one that is compared"
        raise InvalidSettings(models.TRADEOFF_SETTING, expected=expected, got=got)
    LiftSettings.of_json(settings)
    if order.budget_s > deps.settings.tradeoff_seconds:
        limit = f"at most {deps.settings.tradeoff_seconds:g} s, as the operator allows"
        raise InvalidRequest("budget_s", expected=limit, got=f"{order.budget_s:g}")
    document = order.model_dump(mode="json", exclude_none=True)  # likewise
    parameters = {name: document[name] for name in ("budget_s", "labels") if name in document}
    return _take(
        order,
        deps,
        key,
        order_json=document,
        settings=settings,
        kind=models.JobKind.TRADEOFF,
        parameters=parameters,
    )


def _take(
    order: models.LiftInputs, deps: AppState, key: str | None, *, order_json: dict[str, Any], **of: Any
) -> Response:
    """Return the answer to an order: its new job, or the job of the same order before, found by ``order_json``."""
    job_order = JobOrder(
        splats=order.splats, cameras=order.cameras, features=tuple(order.features),
        key=key, fingerprint=None if key is None else fingerprint(order_json), request_id=current_id(), **of,
    )  # fmt: skip
    job, new = deps.store.jobs.find_repeated(deps.owner, job_order), False
    if job is None:
        _require_fit(job_order, deps)
        deps.query_client.require_device(job_order.settings.get("device", "auto"))
        job, new = deps.store.jobs.submit(deps.owner, job_order, max_queued=deps.settings.max_queued)
        deps.supervisor.wake()
    return _reply(deps.store.jobs.get(deps.owner, job), 202 if new else 200)


def _require_fit(order: JobOrder, deps: AppState) -> None:
    """Refuse an order that cannot be lifted, or for which there is no space."""
    get = partial(deps.store.assets.get, deps.owner, limit=ALL)  # names must be complete: they are compared
    cameras = get(order.cameras, models.AssetKind.CAMERAS)
    packs = [get(pack, models.AssetKind.FEATURES) for pack in order.features]
    splats = get(order.splats, models.AssetKind.SPLATS)
    check_kernel(splats, order.settings)
    check_fit(cameras, packs)
    in_blocks = order.kind is models.JobKind.LIFT and deps.settings.engine is not None
    check_settings(LiftSettings.of(**order.settings), packs, in_blocks=in_blocks)
    label_assets = [get(*asset) for asset in labels_of(order.parameters)]
    if order.kind is models.JobKind.TRADEOFF and label_assets:
        check_labels(order, cameras, packs, *label_assets)
    elif label_assets:
        check_channels("table", label_assets[0], packs)
    deps.store.files.require_room(scratch_bytes(order.kind, splats, packs))


@router.get("/jobs", response_model=models.Jobs, tags=["jobs"])
def list_jobs(deps: Deps, limit: Limit = models.PAGE, cursor: Cursor = None) -> Response:
    """List the jobs, newest first, in pages."""
    return page_response("jobs", partial(deps.store.jobs.page, deps.owner), shape, limit=limit, cursor=cursor)


@router.get("/jobs/{job}", response_model=models.Job, tags=["jobs"])
def get_job(job: str, deps: Deps) -> models.Job:
    """Get one job: its state, its progress and its result."""
    return shape(deps.store.jobs.get(deps.owner, job))


@router.get("/jobs/{job}/events", response_class=Response, responses=EVENTS, tags=["jobs"])
async def follow_job(job: str, deps: Deps, last_event: LastEvent = 0) -> Response:
    """Stream the events of a job: its states, plan, latest progress and log. Ends after the last state."""
    read_events = partial(deps.store.jobs.events, deps.owner, job)
    state = await anyio.to_thread.run_sync(deps.store.jobs.state, deps.owner, job)
    if not await anyio.to_thread.run_sync(read_events, last_event) and state in models.FINAL_STATES:
        return Response(status_code=204)
    return deps.streams.answer(read_events, event_data, last_event, deps.caller.key)


@router.post(
    "/jobs/{job}/cancel",
    response_model=models.Job,
    status_code=202,
    responses={200: {"model": models.Job, "description": "It is canceled, and nothing of it runs any more"}},
    tags=["jobs"],
)
def cancel_job(job: str, deps: Deps) -> Response:
    """Cancel a job. It is ``canceling`` until its processes have ended (within 5 s), then ``canceled``.

    A second request does no harm. A job that has succeeded or failed is refused (409).
    """
    deps.store.jobs.cancel(deps.owner, job)
    record = deps.store.jobs.get(deps.owner, job)
    return _reply(record, 200 if record.state is models.JobState.CANCELED else 202)


@router.delete("/jobs/{job}", status_code=204, tags=["jobs"])
def delete_job(
    job: str,
    deps: Deps,
    with_lift: Annotated[bool, Query(description="its lift goes too; without this a job with a lift stays")] = False,
    with_tradeoff: Annotated[bool, Query(description="its trade-off goes too, likewise")] = False,
) -> None:
    """Delete a job. Refused (409) before it has ended."""
    choices = {models.JobKind.LIFT: with_lift, models.JobKind.TRADEOFF: with_tradeoff}
    deps.store.jobs.delete(deps.owner, job, given_up=[kind for kind, is_given_up in choices.items() if is_given_up])


def event_data(event: Event) -> str:
    """Return an event's data as clients get it."""
    if event.kind is EventKind.STATE:
        step = event.data | {"problem": _problem(event.data["problem"])}
        return models.JobStep.model_validate(step).model_dump_json()
    return EVENT_DATA[event.kind].model_validate(event.data).model_dump_json()


def shape(job: JobRecord) -> models.Job:
    """Return a job as clients get it."""
    links = {"self": f"/jobs/{job.id}", "events": f"/jobs/{job.id}/events"}
    if job.state not in models.FINAL_STATES:
        links["cancel"] = f"/jobs/{job.id}/cancel"
    if job.state is models.JobState.SUCCEEDED:
        links |= RESULT_LINKS[job.kind](job.id)
    return models.Job.model_validate({**vars(job), "problem": _problem(job.problem), "links": links})


def _problem(fault: Mapping[str, str] | None) -> models.Problem | None:
    return None if fault is None else problem_of(error_of(fault))


def _reply(job: JobRecord, status: int) -> Response:
    return JSONResponse(shape(job).model_dump(mode="json"), status, headers={"Location": f"/jobs/{job.id}"})


# Checks that assets fit together, from the counts of their checks: an early error rather than a failed job


def check_fit(cameras: AssetRecord, features: Sequence[AssetRecord]) -> None:
    """Refuse features that cannot be lifted with these cameras.

    Raises:
        InvalidFeatures: a view is in two packs, packs differ in channels, or no view has a camera.
    """
    owner: dict[str, str] = {}
    for pack in features:
        for view in pack.counts["names"]:
            if view in owner:
                got = f"{view!r} in {owner[view]} and {pack.id}"
                raise InvalidFeatures("features", expected="each view in one pack", got=got)
            owner[view] = pack.id
    channels = {pack.counts["channels"]: pack.id for pack in features}
    if len(channels) > 1:
        got = " and ".join(f"{count} in {pack}" for count, pack in channels.items())
        raise InvalidFeatures("features", expected="packs with the same channels", got=got)
    require_pairs(owner, with_panoramas(cameras.counts["names"]))


def check_settings(settings: LiftSettings, features: Sequence[AssetRecord], *, in_blocks: bool) -> None:
    """Refuse settings that need masks if no pack has any, and settings that an engine cannot do in blocks.

    Raises:
        InvalidSettings: as `LiftSettings` has it.
    """
    masks = any(pack.counts.get("region_maps", 1) for pack in features)  # without a count the job decides
    settings.finds_objects(masks)
    settings.uses_consensus(masks)
    if in_blocks:
        settings.check_blocks(masks)


def check_kernel(splats: AssetRecord, settings: Mapping[str, Any]) -> None:
    """Refuse a kernel for which the splats lack a property, and settings that have no meaning for it.

    Raises:
        InvalidSettings: ``kernel`` or ``antialiased`` does not fit the file, of which the header is read.
    """
    file_kernel, kernel = kernel_of(splats, {}), kernel_of(splats, settings)
    lift_settings = LiftSettings.of(**settings)
    lift_settings.check_kernel(Kernel(kernel))
    if kernel == file_kernel:
        return
    try:
        lift_settings.check_kernel(Kernel(kernel), splats.path, splats.id)
    except InvalidSplats as error:
        got, hint = (
            f"{kernel} for {splats.id}, which has {error.got}",
            f"leave it out: the file speaks of {file_kernel}",
        )
        raise InvalidSettings("kernel", expected=f"a kernel with {error.expected}", got=got, hint=hint) from None


def check_labels(
    order: JobOrder, cameras: AssetRecord, features: Sequence[AssetRecord], masks: AssetRecord, table: AssetRecord
) -> None:
    """Refuse labels that cannot evaluate lifts of these features.

    Raises:
        InvalidRequest: a class that the table lacks or that is named twice, too few classes, a table of other
            channels, masks of no camera, or no view with features besides those with masks.
    """
    classes = order.parameters["labels"]["classes"]
    vocabulary = Vocabulary(table.counts["words"])
    for place, word in enumerate(classes):
        if word not in vocabulary:
            near = vocabulary.nearest(word)
            raise InvalidRequest(
                f"labels.classes.{place}", expected=f"one of the {len(vocabulary.words)} words of {table.id}",
                got=repr(word[:80]), hint=f"nearest: {', '.join(near)}" if near else "",
            )  # fmt: skip
    if len(set(map(vocabulary.word_of, classes))) < len(classes):
        got = f"{len(classes)} words, some of them the same"
        raise InvalidRequest("labels.classes", expected="each class once", got=got)
    if masks.counts["classes"] > len(classes):
        expected = f"{masks.counts['classes']} words, as the masks name classes 0..{masks.counts['classes'] - 1}"
        raise InvalidRequest("labels.classes", expected=expected, got=f"{len(classes)}")
    check_channels("labels.table", table, features)
    camera_names = cameras.counts["names"]
    masked = set(cameras_of_views(masks.counts["names"], camera_names).values())
    if not masked:
        raise InvalidRequest(
            "labels.masks",
            expected="masks of views named like the cameras",
            got=f"masks {_first_names(masks.counts['names'])}, cameras {_first_names(camera_names)}: none in common",
        )
    view_names = [view for pack in features for view in pack.counts["names"]]
    views = sorted(cameras_of_views(view_names, camera_names).values())
    if masked.issuperset(views[:: LiftSettings.of(**order.settings).view_stride]):
        expected = "features of views besides those with masks, which are not lifted"
        raise InvalidRequest("labels.masks", expected=expected, got="masks of all of them")


def check_channels(argument: str, table: AssetRecord, features: Sequence[AssetRecord]) -> None:
    """Refuse a table of words whose vectors are not of the features' space.

    Raises:
        InvalidRequest: it has other channels.
    """
    channels = features[0].counts["channels"]
    if table.counts["channels"] != channels:
        expected, got = f"a table with {channels} channels, as the features", f"{table.counts['channels']}"
        raise InvalidRequest(argument, expected=expected, got=got)


def scratch_bytes(kind: models.JobKind, splats: AssetRecord, features: Sequence[AssetRecord]) -> int:
    """Return the least bytes that a job writes to the disk: a trade-off keeps the features of its exact run."""
    if kind is not models.JobKind.TRADEOFF:
        return 0
    return splats.counts.get("splats", 0) * (1 + features[0].counts["channels"]) * FLOAT_BYTES


def _first_names(names: Sequence[str]) -> str:
    """Return the first few names, for an error."""
    return ", ".join(map(repr, sorted(names)[:3]))
