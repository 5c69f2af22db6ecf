"""/lift, /tradeoff and /jobs: work and how far it is."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from fastapi.sse import EventSourceResponse, format_sse_event

from liftcore.errors import SplatliftError
from service.models import FINAL_STATES, Job, LiftRequest, Plan, TradeoffRequest
from service.routes import Caller, Deps, Parts, add_list
from service.runner import order_of
from service.store import Owner

POLL_SECONDS = 0.25  # between polls for new events
QUIET_POLLS = 60  # then a comment keeps the connection open
STREAMS = anyio.CapacityLimiter(2)  # threads for polls of all streams, so that these do not starve other routes
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x20-\x7e]+$",
        description="chosen by the client; the same order with the same key is the same job",
    ),
]  # fmt: skip
LastEvent = Annotated[int, Header(alias="Last-Event-ID", ge=0, le=2**53, description="the last that the client has")]
REPEATED: dict[int | str, dict[str, Any]] = {
    200: {"model": Job, "description": "The job that the same key made before"}
}
FIELDS = {name: {"type": "string"} for name in ("id", "event", "data")}
EVENTS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events: `state`, `plan` and `progress`, with JSON as their data",
        "content": {"text/event-stream": {"schema": {"type": "object", "properties": FIELDS}}},  # of one event
    },
    204: {"description": "The job has ended, and the client has its last event"},
}

router = APIRouter(tags=["jobs"])
add_list(router, "jobs", Job, Job.model_validate)


@router.post("/lift", status_code=202, responses=REPEATED)
def order_lift(lift: LiftRequest, response: Response, deps: Deps, owner: Caller, key: IdempotencyKey = None) -> Job:
    """Lift features onto splats. The job is on the disk before the reply."""
    return _submit(lift.job(), response, deps, owner, key)


@router.post("/tradeoff", status_code=202, responses=REPEATED, tags=["trade-offs"])
def order_tradeoff(
    tradeoff: TradeoffRequest, response: Response, deps: Deps, owner: Caller, key: IdempotencyKey = None
) -> Job:
    """Compare quality levels and presets on a scene within a budget. The job is on the disk before the reply."""
    return _submit(tradeoff.job(), response, deps, owner, key)


def _submit(fields: dict[str, Any], response: Response, deps: Parts, owner: Owner, key: str | None) -> Job:
    deps.store.require_room()
    job, is_new = deps.store.submit(owner, fields, key, deps.settings.max_queued)
    if is_new:
        deps.runner.wake()
    response.status_code = 202 if is_new else 200
    response.headers["Location"] = f"/jobs/{job.id}"
    return job


@router.post("/lift/plan")
async def plan_lift(lift: LiftRequest, deps: Deps, owner: Caller) -> Plan:
    """Plan a lift without running it: the views that it would use, and the memory."""
    return Plan.model_validate(await anyio.to_thread.run_sync(_plan, lift.job(), deps, owner, limiter=deps.checks))


def _plan(fields: dict[str, Any], deps: Parts, owner: Owner) -> dict[str, Any]:
    order = order_of(fields, deps.store, owner, deps.settings)
    with deps.store.scratch() as scratch:
        order |= {"task": "plan", "kind": "plan", "scratch": str(scratch), "memory": deps.settings.check_memory_bytes}
        return deps.children.result_of(order, deps.settings.check_seconds, "plan")


@router.get("/jobs/{job}")
def get_job(job: str, deps: Deps, owner: Caller) -> Job:
    """Get one job: its state, its progress and its problem."""
    return deps.store.job(owner, job)


@router.get("/jobs/{job}/events", response_class=Response, responses=EVENTS)
async def follow_job(job: str, deps: Deps, owner: Caller, last_event: LastEvent = 0) -> Response:
    """Stream the events of a job: its states, plan and latest progress. Ends after the last state."""

    async def read(after: int) -> list[dict[str, Any]]:
        return await anyio.to_thread.run_sync(deps.store.events, owner, job, after, limiter=STREAMS)

    first = await read(last_event)
    record = await anyio.to_thread.run_sync(deps.store.job, owner, job)
    if not first and record.state in FINAL_STATES:
        return Response(status_code=204)

    async def stream() -> AsyncIterator[bytes]:
        after, quiet, events = last_event, 0, first
        while not deps.children.stopping.is_set():
            for event in events:
                after, quiet = event["number"], 0
                yield format_sse_event(id=str(after), event=event["kind"], data_str=event["data"])
                if event["kind"] == "state" and any(f'"state": "{state}"' in event["data"] for state in FINAL_STATES):
                    return
            quiet += 1
            if quiet % QUIET_POLLS == 0:
                yield format_sse_event(comment="still here")
            await anyio.sleep(POLL_SECONDS)
            try:
                events = await read(after)
            except SplatliftError:  # deleted meanwhile, or the key was revoked
                return

    return EventSourceResponse(stream(), headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})


@router.post(
    "/jobs/{job}/cancel",
    status_code=202,
    responses={200: {"model": Job, "description": "It is canceled, and nothing of it runs any more"}},
)
def cancel_job(job: str, response: Response, deps: Deps, owner: Caller) -> Job:
    """Cancel a job. It is ``canceling`` until its processes have ended, then ``canceled``.

    A second request does no harm. A job that has succeeded or failed is refused (409).
    """
    record = deps.store.cancel(owner, job)
    response.status_code = 200 if record.state == "canceled" else 202
    return record


@router.delete("/jobs/{job}", status_code=204)
def delete_job(
    job: str, deps: Deps, owner: Caller,
    with_lift: Annotated[bool, Query(description="its lift goes too; without this a job with a lift stays")] = False,
    with_tradeoff: Annotated[bool, Query(description="its trade-off goes too, likewise")] = False,
) -> None:  # fmt: skip
    """Delete a job. Refused (409) before it has ended."""
    kind = deps.store.job(owner, job).kind
    deps.store.delete_job(owner, job, with_result=with_lift if kind == "lift" else with_tradeoff)
