"""Settings of the service, and the text encoder for each text space.

Each field may be set by an environment variable, SPLATLIFT_ and its name in capitals; empty means not set.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from liftcore.errors import InvalidInput
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS, check_encoder, encoder_file
from service.errors import InvalidRequest, Misconfigured

MiB = 1 << 20
GiB = 1 << 30
ORIGIN = re.compile(r"https?://[a-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-f:.]+\](:\d{1,5})?")  # RFC 6454, 6.2


# Settings of earlier releases; a proxy limits slow clients now.
REMOVED_VARIABLES = frozenset(
    {"SPLATLIFT_HEADER_SECONDS", "SPLATLIFT_MIN_BYTES_PER_SECOND", "SPLATLIFT_SLOW_GRACE_SECONDS"}
)


class ServiceSettings(BaseSettings):
    """Settings of the service; none can be changed over HTTP."""

    model_config = SettingsConfigDict(env_prefix="SPLATLIFT_", env_ignore_empty=True, frozen=True, extra="forbid")

    data: Path = Field(Path("splatlift-data"), description="the directory that holds the database and all files")
    host: str = Field("127.0.0.1", description="the address to bind; beyond loopback only with keys")
    port: int = Field(8787, ge=0, le=65_535, description="the port to bind; 0 picks a free one")

    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="names in Host and Origin beside those of loopback and the bound address, with commas between"
    )

    forwarded_allow: str = Field(
        "",
        description="addresses or networks of proxies whose X-Forwarded-For has the client's address, for the log, "
        "with commas between; not set = nobody's",
    )

    keys: Literal["required", "none"] | None = Field(
        None,
        description="required: requests need a key even before one was made, and the service may bind to any "
        "address; none: all on this machine are admins, on loopback only; not set = required once a key was made",
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="origins of other sites whose pages may read here (CORS), such as https://lab.example, with "
        "commas between; * = all of them, where SPLATLIFT_KEYS is required; not set = none",
    )
    key_bytes: int = Field(
        100 * GiB, ge=0, description="bytes of assets and results that a key may store; more get 403"
    )
    key_queued: int = Field(20, ge=0, description="jobs of a key that may wait in line; more are answered 429")
    key_uploads: int = Field(4, ge=0, description="uploads and plans of a key at the same time; more get 429")
    key_queries: int = Field(8, ge=1, description="queries of a key that may wait or run; more are answered 429")
    key_streams: int = Field(8, ge=1, description="streams of events of a key at the same time; more get 429")

    log_format: Literal["json", "text"] = Field("json", description="of the log on stderr: json or text")
    commit: str | None = Field(None, description="the git commit that this was built from, for /version")
    notice_seconds: float = Field(
        0, ge=0, le=600, description="time that a stopping server still listens, so that a load balancer notices"
    )
    stop_seconds: float = Field(10, gt=0, le=600, description="time that open requests have to end in a stop")

    max_splats_bytes: int = Field(4 * GiB, gt=0, description="the largest splat file")
    max_cameras_bytes: int = Field(256 * MiB, gt=0, description="the largest camera file; at most 100,000 views")
    max_features_bytes: int = Field(16 * GiB, gt=0, description="the largest feature pack")
    max_masks_bytes: int = Field(256 * MiB, gt=0, description="the largest file of masks")
    max_table_bytes: int = Field(64 * MiB, gt=0, description="the largest text table")
    max_photos_bytes: int = Field(4 * GiB, gt=0, description="the largest zip of photos")
    max_lift_bytes: int = Field(16 * GiB, gt=0, description="the largest lift file")
    max_body_bytes: int = Field(MiB, gt=0, description="the largest body of any request that is not an upload")

    max_connections: int = Field(400, ge=1, description="connections that may be open; requests over more get 503")

    parallel_checks: int = Field(2, ge=1, le=64, description="uploads that are validated at the same time")
    check_seconds: float = Field(300, gt=0, description="wall time that the validation of one upload may take")
    check_memory_bytes: int = Field(
        8 * GiB, gt=0, description="private memory of the check of an upload or a plan, beside its imports (Linux)"
    )

    disk_floor_bytes: int = Field(
        256 * MiB, ge=0, description="free disk that uploads and jobs must leave; else they are answered 507"
    )
    garbage_seconds: float = Field(3600, gt=0, description="time between collections of garbage; one is at start-up")
    garbage_grace_seconds: float = Field(3600, ge=0, description="age up to which a file without an owner is left")
    quarantine_seconds: float = Field(604_800, ge=0, description="time in quarantine/ before it is removed")

    keep_jobs_seconds: float | None = Field(
        None, ge=0, description="time that a job without a result is kept; not set = until it is deleted"
    )
    keep_jobs: int | None = Field(
        None, ge=0, description="number of these, the latest, kept for each key; not set = all"
    )

    lift_threads: int | None = Field(
        None, ge=1, description="threads of a job; not set = the cores shared out among the parallel jobs"
    )
    engine: Literal["local", "ray"] | None = Field(
        None,
        description="engine of lifts in blocks, of bounded memory: local or ray (a cluster); not set = in memory, as "
        "the runs of trade-offs always are",
    )
    ray_address: str = Field("auto", description="of that cluster, host:port; auto takes RAY_ADDRESS")
    parallel_lifts: int = Field(1, ge=1, le=64, description="jobs that run at the same time")
    max_queued: int = Field(100, ge=1, description="jobs that may wait in line; more are answered 503")
    lift_seconds: float = Field(86_400, gt=0, description="wall time that one attempt at a job may take")
    lift_memory_bytes: int | None = Field(
        None, ge=1, description="private memory of a job's processes together (Linux); not set = no limit"
    )
    tradeoff_seconds: float = Field(
        3600, ge=10, description="the largest budget of a trade-off; larger ones are answered 422"
    )
    lease_seconds: float = Field(
        30,
        ge=3,
        description="silence after which a job's process is given up, unless it computes, and its job waits anew",
    )
    checkpoint_seconds: float = Field(
        2, ge=0, description="work that a killed lift may have to do again, beside at most five views"
    )
    max_streams: int = Field(32, ge=1, description="clients that may follow events at the same time; more get 503")

    encoder: str = Field(
        "lvis",
        description="text encoder for lifts of its own text space and, if you set it, for those whose text space has "
        "no entry in SPLATLIFT_TEXT_SPACES (never for the text space 'none'): lvis, table:FILE, "
        "open_clip:MODEL...",
    )
    text_spaces: dict[str, str] = Field(
        default_factory=dict, description="text space -> text encoder, in the same notation (JSON object)"
    )
    query_waiting: int = Field(16, ge=1, le=32, description="queries that may wait or run; more are answered 503")
    query_seconds: float = Field(120, gt=0, description="wall time after which a query is given up")
    query_scenes: int = Field(2, ge=1, description="lifts that the query process keeps open")
    query_cache_bytes: int = Field(256 * MiB, ge=0, description="answers and views that the query process caches")

    @field_validator("allowed_hosts", "cors_origins", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        return [name.strip() for name in value.split(",") if name.strip()] if isinstance(value, str) else value

    @field_validator("cors_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        """Require origins in the form of RFC 6454, and refuse `*` while routes need no key."""
        for origin in origins:
            if origin == "*" and info.data.get("keys") != "required":
                expected = "origins by their names, or SPLATLIFT_KEYS=required"
                raise Misconfigured("cors_origins", expected=expected, got="*")
            if origin != "*" and not ORIGIN.fullmatch(origin):
                expected = "origins such as https://lab.example or http://localhost:3000, with commas between"
                raise Misconfigured("cors_origins", expected=expected, got=repr(origin)[:120])
        return origins

    def max_upload_bytes(self, kind: str) -> int:
        """Return the size limit of an asset kind, or of a ``lift``."""
        return getattr(self, f"max_{kind}_bytes")


def variables() -> Iterator[tuple[str, str, str]]:
    """Yield the environment variable, default and description of each setting, in order."""
    for name, field in ServiceSettings.model_fields.items():
        default = field.get_default(call_default_factory=True)
        unit, size = ("GiB", GiB) if name.endswith("bytes") and default and default % GiB == 0 else ("MiB", MiB)
        text = "not set" if default in (None, ()) else str(default)
        if name.endswith("bytes") and default and default % size == 0:
            text = f"{default} ({default // size} {unit})"
        yield f"SPLATLIFT_{name.upper()}", text, field.description or ""


def read_settings(**values: Any) -> ServiceSettings:
    """Return the settings: of a command line, else of the environment, else the defaults.

    Args:
        values: field -> value; None is not set.

    Raises:
        Misconfigured: a value that a setting does not take.
    """
    try:
        return ServiceSettings(**{name: value for name, value in values.items() if value is not None})
    except SettingsError as error:  # malformed JSON in a variable
        raise _no_json(error) from None
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise Misconfigured(name, expected=first["msg"].lower(), got=repr(first["input"])) from None


def _no_json(error: SettingsError) -> Misconfigured:
    field = next((name for name in ServiceSettings.model_fields if f'"{name}"' in str(error)), "settings")
    variable = f"SPLATLIFT_{field.upper()}"
    example = json.dumps({"NAME": "table:FILE"})
    return Misconfigured(
        variable, expected="JSON", got=repr(os.environ.get(variable, "something else"))[:120],
        hint=f"a JSON object looks like '{example}'",
    )  # fmt: skip


# The text encoder for each text space, and its files. The query process opens an encoder at its first question. Its
# error would then go to a client, who cannot mend it: so `require_encoder_files` checks the files before the start.


def encoder_spec(settings: ServiceSettings, text_space: str, requested: str | None) -> str:
    """Return the specification of a query's text encoder: of the requested space, else of the lift's.

    The default stands in for a space that has none only where the operator chose it: scores of an encoder of
    another space look like any others, and mean nothing. Encoders that need no file answer for their own spaces,
    and a lift with words of its own is queried in these: ``OWN_WORDS``. A lift's own space may
    be requested by its name.

    Raises:
        InvalidRequest: no encoder is configured by that name, or for the lift's text space.
    """
    if requested == "default":
        return settings.encoder
    if requested in (None, text_space) and text_space == OWN_WORDS:
        return OWN_WORDS
    if requested not in (None, text_space):
        if requested not in settings.text_spaces:
            names = ", ".join(["default", *sorted(settings.text_spaces)])
            raise InvalidRequest(
                "encoder", expected="the name of a text space that the operator set up", got=repr(requested),
                hint=f"known here: {names}",
            )  # fmt: skip
        return settings.text_spaces[requested]
    if text_space in settings.text_spaces:
        return settings.text_spaces[text_space]
    if text_space == settings.encoder or (text_space != NO_WORDS and "encoder" in settings.model_fields_set):
        return settings.encoder
    for encoder, space in BUILT_IN.items():
        if text_space == space:
            return encoder
    raise _no_encoder(settings, text_space)


def _no_encoder(settings: ServiceSettings, text_space: str) -> InvalidRequest:
    if text_space == NO_WORDS:
        return InvalidRequest(
            "lift", expected="features that share a space with a text encoder", got="text space 'none'",
            hint="ask by example, with like=; or name an encoder with encoder= if you know better",
        )  # fmt: skip
    example = json.dumps({text_space or "NAME": "table:FILE"})
    return InvalidRequest(
        "lift", expected="features of a text space that this server has an encoder for",
        got=f"text space {text_space!r}" if text_space else "features that name no text space",
        hint="ask with table=ID of an uploaded text table, or by example, with like="
        + ("" if text_space else "; PATCH /assets/{asset} names a pack's text space, for a lift of it")
        + f"; or the operator sets SPLATLIFT_TEXT_SPACES='{example}' or SPLATLIFT_ENCODER;"
        f" encoder=default asks {encoder_label(settings.encoder)} all the same",
    )  # fmt: skip


def encoder_label(spec: str) -> str:
    """Return the specification of an encoder without private paths."""
    return "table" if spec.startswith("table:") or spec.endswith(".safetensors") else spec.partition("@")[0]


def encoder_version(spec: str) -> list[int] | None:
    """Return the time and size of an encoder's file, which change with it; None without a file."""
    file = encoder_file(spec)
    try:
        status = file.stat() if file is not None else None
    except OSError:
        return None
    return None if status is None else [status.st_mtime_ns, status.st_size]


def require_encoder_files(settings: ServiceSettings) -> None:
    """Require that every file of a text encoder is there, and that tables look like tables.

    Raises:
        Misconfigured: there is no such encoder, a file is missing or does not open, or a table is none. The setting
            is named.
    """
    specs = {"encoder": settings.encoder}
    specs |= {f"text_spaces, {space!r}": spec for space, spec in settings.text_spaces.items()}
    for argument, spec in specs.items():
        try:
            check_encoder(spec)
        except InvalidInput as error:
            got, hint = error.got, error.hint
            raise Misconfigured(argument, expected=error.expected, got=got, hint=hint) from None
