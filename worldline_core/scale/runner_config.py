"""Where mapped work runs. It never changes a result, and is therefore no part of any cache key."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from worldline_core.config.base import StrictModel
from worldline_core.scale.mapping import DEFAULT_EPISODES_PER_SHARD, DEFAULT_RETRIES, DEFAULT_RETRY_SECONDS


class RunnerConfig(StrictModel):
    """What does the work on many episodes.

    `auto` takes this process for few episodes, since starting others takes longer than the work, and processes for many.
    """

    kind: Literal["auto", "serial", "processes", "dask", "ray"] = "auto"
    workers: int | None = Field(default=None, ge=1, description="processes; null: one for each core of this machine")
    address: str | None = Field(
        default=None, description="scheduler of a Dask or Ray cluster; null: a cluster of its own on this machine"
    )
    episodes_per_shard: int = Field(default=DEFAULT_EPISODES_PER_SHARD, ge=1)
    in_flight: int | None = Field(default=None, ge=1, description="shards handed out at a time; null: two for a worker")
    serial_below: int = Field(default=256, ge=0, description="auto: fewer episodes than this are done in this process")
    retries: int = Field(
        default=DEFAULT_RETRIES, ge=0, description="further attempts at a shard that could not reach its input"
    )
    retry_seconds: float = Field(
        default=DEFAULT_RETRY_SECONDS, ge=0, description="pause before the first of them; doubles"
    )
    remote_cache_gb: float = Field(default=8.0, gt=0, description="room for copies of remote files, each worker")

    @model_validator(mode="after")
    def _address_is_of_a_cluster(self) -> RunnerConfig:
        if self.address is not None and self.kind not in ("dask", "ray"):
            raise ValueError(f"an address is that of a Dask or Ray cluster; the kind is {self.kind}")
        return self
