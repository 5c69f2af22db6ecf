"""What the operator decides. A field may be an environment variable, SPLATLIFT_ and its name; empty is not set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from liftcore.query.text import NO_WORDS
from service.errors import InvalidRequest

MiB = 1 << 20
GiB = 1 << 30


class ServiceSettings(BaseSettings):
    """Settings of the service; nothing here can be changed over HTTP."""

    model_config = SettingsConfigDict(env_prefix="SPLATLIFT_", env_ignore_empty=True, frozen=True, extra="forbid")

    data: Path = Field(Path("splatlift-data"), description="the directory that holds the database and all files")
    host: str = Field("127.0.0.1", description="the address to bind; beyond loopback only with keys")
    port: int = Field(8787, ge=0, le=65_535, description="the port to bind; 0 picks a free one")

    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="names in Host and Origin beside those of loopback and the bound address, with commas between"
    )

    keys: Literal["required", "none"] | None = Field(
        None, description="whether requests need a key: required, none; not set = required once one was made"
    )
    key_bytes: int = Field(100 * GiB, ge=0, description="bytes of assets and results that a key may store")
    key_queued: int = Field(20, ge=0, description="jobs of a key that may wait in line; more are answered 429")
    key_uploads: int = Field(4, ge=0, description="uploads of a key at the same time; more are answered 429")

    log_format: Literal["json", "text"] = Field("json", description="of the log on stderr: json or text")
    commit: str | None = Field(None, description="the git commit that this was built from, for /version")
    notice_seconds: float = Field(
        0, ge=0, le=600, description="how long a stopping server still listens, for a load balancer to notice"
    )
    stop_seconds: float = Field(10, gt=0, le=600, description="time that open requests have to end in a stop")

    max_splats_bytes: int = Field(4 * GiB, gt=0, description="the largest splat file, compressed or not")
    max_cameras_bytes: int = Field(256 * MiB, gt=0, description="the largest camera file, compressed or not")
    max_features_bytes: int = Field(16 * GiB, gt=0, description="the largest feature pack, compressed or not")
    max_masks_bytes: int = Field(256 * MiB, gt=0, description="the largest file of masks, compressed or not")
    max_table_bytes: int = Field(64 * MiB, gt=0, description="the largest text table, compressed or not")
    max_body_bytes: int = Field(MiB, gt=0, description="the largest body of any request that is not an upload")

    min_bytes_per_second: int = Field(
        1024, ge=1, description="the least speed of a client that sends a body; slower ones get 408 and are cut off"
    )
    slow_grace_seconds: float = Field(10, gt=0, description="the time over which that speed is measured")
    header_seconds: float = Field(10, gt=0, description="how long the headers of a request may take to come")
    max_connections: int = Field(400, ge=1, description="connections that may be open; more get 503")

    parallel_checks: int = Field(2, ge=1, le=64, description="uploads that are validated at the same time")
    check_seconds: float = Field(300, gt=0, description="wall time that the validation of one upload may take")
    check_memory_bytes: int = Field(
        8 * GiB, gt=0, description="private memory that the validation of one upload may take (Linux)"
    )

    disk_floor_bytes: int = Field(
        256 * MiB, ge=0, description="free disk that uploads and jobs must leave; else they are answered 507"
    )
    garbage_seconds: float = Field(3600, gt=0, description="time between collections of garbage; one is at start-up")
    garbage_grace_seconds: float = Field(3600, ge=0, description="how long a file without an owner is left alone")
    quarantine_seconds: float = Field(
        604_800, ge=0, description="how long it is then kept in quarantine/ before it is removed"
    )

    lift_threads: int | None = Field(
        None, ge=1, description="threads of a job; not set = the cores shared out among the parallel jobs"
    )
    parallel_lifts: int = Field(1, ge=1, le=64, description="jobs that run at the same time")
    max_queued: int = Field(100, ge=1, description="jobs that may wait in line; more are answered 503")
    lift_seconds: float = Field(86_400, gt=0, description="wall time that one attempt at a job may take")
    lift_memory_bytes: int | None = Field(
        None, ge=1, description="private memory of a job's processes (Linux); not set = no limit"
    )
    tradeoff_seconds: float = Field(
        3600, ge=10, description="the largest budget of a trade-off; larger ones are answered 422"
    )
    lease_seconds: float = Field(
        30,
        ge=3,
        description="silence after which a job's process is given up, unless it computes, and its job waits anew",
    )
    checkpoint_seconds: float = Field(2, ge=0, description="work that a killed lift may have to do again")
    max_streams: int = Field(32, ge=1, description="clients that may follow events at the same time; more get 503")

    encoder: str = Field(
        "minilm",
        description="text encoder of its own space and, if you set it, of lifts whose text space has none: "
        "minilm, table:FILE, open_clip:MODEL...",
    )
    text_spaces: dict[str, str] = Field(
        default_factory=dict, description="text space -> text encoder, in the same notation (JSON object)"
    )
    query_waiting: int = Field(16, ge=1, le=32, description="queries that may wait or run; more are answered 503")
    query_seconds: float = Field(120, gt=0, description="wall time after which a query is given up")
    query_scenes: int = Field(2, ge=1, description="lifts that the query process keeps open")
    query_cache_bytes: int = Field(
        256 * MiB, ge=0, description="answers and views that the query process keeps for what is asked next"
    )

    @field_validator("allowed_hosts", mode="before")
    @classmethod
    def _names(cls, given: Any) -> Any:
        return [name.strip() for name in given.split(",") if name.strip()] if isinstance(given, str) else given

    def max_upload_bytes(self, kind: str) -> int:
        """The size limit of an asset kind."""
        limits = {
            "splats": self.max_splats_bytes,
            "cameras": self.max_cameras_bytes,
            "features": self.max_features_bytes,
            "masks": self.max_masks_bytes,
            "table": self.max_table_bytes,
        }
        return limits[kind]

    def encoder_spec(self, text_space: str, asked: str | None) -> str:
        """The text encoder of a query: the one of the space asked for, else of the lift's.

        The default stands in for a space that has none only where the operator chose it: scores of an encoder of
        another space look like any others, and mean nothing.

        Raises:
            InvalidRequest: no encoder was set up under the name asked for, or for the lift's text space.
        """
        if asked == "default":
            return self.encoder
        if asked is not None:
            if asked not in self.text_spaces:
                known = ", ".join(["default", *sorted(self.text_spaces)])
                raise InvalidRequest(
                    "encoder", expected="the name of a text space that the operator set up", got=repr(asked),
                    hint=f"known here: {known}",
                )  # fmt: skip
            return self.text_spaces[asked]
        if text_space in self.text_spaces:
            return self.text_spaces[text_space]
        if text_space == self.encoder or (text_space != NO_WORDS and "encoder" in self.model_fields_set):
            return self.encoder
        raise self._no_encoder(text_space)

    def _no_encoder(self, text_space: str) -> InvalidRequest:
        if text_space == NO_WORDS:
            return InvalidRequest(
                "lift", expected="features that share a space with a text encoder", got="text space 'none'",
                hint="ask by example, with like=; or name an encoder with encoder= if you know better",
            )  # fmt: skip
        example = json.dumps({text_space or "NAME": "table:FILE"})
        return InvalidRequest(
            "lift", expected="features of a text space that this server has an encoder for",
            got=f"text space {text_space!r}" if text_space else "features that name no text space",
            hint=f"ask by example, with like=; or the operator sets SPLATLIFT_TEXT_SPACES='{example}' or"
            f" SPLATLIFT_ENCODER; encoder=default asks {encoder_label(self.encoder)} all the same",
        )  # fmt: skip


def encoder_label(spec: str) -> str:
    """An encoder as clients may know it: its specification without a file of the server."""
    return "table" if spec.startswith("table:") or spec.endswith(".safetensors") else spec.partition("@")[0]


def encoder_file(spec: str) -> Path | None:
    """The file that an encoder specification names, None when it names none."""
    if spec.startswith("table:"):
        return Path(spec.removeprefix("table:"))
    if spec.startswith("open_clip:") and "@" in spec:
        return Path(spec.partition("@")[2])
    return Path(spec) if spec.endswith(".safetensors") else None


def encoder_version(spec: str) -> list[int] | None:
    """What changes when the file of an encoder does: its time and size; None without a file."""
    file = encoder_file(spec)
    try:
        status = file.stat() if file is not None else None
    except OSError:
        return None
    return None if status is None else [status.st_mtime_ns, status.st_size]
