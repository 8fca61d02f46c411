"""Configuration of curation: sources, and the form of every curated episode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from worldline_core.config import FrameRate, ImageSize, StrictModel
from worldline_core.data.episodes.episode import Split
from worldline_core.data.episodes.view_recording import VideoMode
from worldline_core.data.guards.reader_process import ReaderLimits
from worldline_core.data.sources.open import RecordingSourceConfig, SourceConfig
from worldline_core.data.video.encoder import PixelFormat
from worldline_core.geometry.cameras import Fit
from worldline_core.geometry.embodiment import load_embodiment, own_embodiment

AVAILABLE = "available"


class DrawnSplits(StrictModel):
    """Test, validation and train are drawn: scenes by a hash of (seed, scene), or episodes, evenly over tasks and outcomes.

    Recordings for evaluation only keep the split that their source declares.
    """

    by: Literal["scene", "episode"]
    test: float = Field(default=0.1, ge=0, lt=1, description="share of the scenes or episodes that test")
    validation: float = Field(default=0.05, ge=0, lt=1, description="share of those that validate")
    seed: int = 0
    patterns: dict[str, Split] = Field(default={}, description="scene name pattern -> split, before the draw")

    @model_validator(mode="after")
    def _leaves_training(self) -> DrawnSplits:
        if self.test + self.validation >= 1:
            raise ValueError(f"test + validation leave nothing to train on: {self.test} + {self.validation}")
        return self


def _kind(value: Any) -> str:
    return "drawn" if isinstance(value, DrawnSplits) or (isinstance(value, Mapping) and "by" in value) else "patterns"


Splits = Annotated[
    Annotated[dict[str, Split], Tag("patterns")] | Annotated[DrawnSplits, Tag("drawn")], Discriminator(_kind)
]
"""Scene name pattern -> split, or {by: scene | episode, ...}. A pattern table cannot hold a scene that is named "by"."""


class LeakageConfig(StrictModel):
    """Consequence when a scene that is learnt from looks like a scene that is tested on."""

    action: Literal["report", "quarantine", "off"] = Field(
        default="report",
        description="report: write it down; quarantine: take the learning scene out (scene_leak)",
    )
    max_distance: int = Field(
        default=52, ge=0, le=256, description="most differing bits of 256 between first images of one scene"
    )


class CurateConfig(StrictModel):
    """Sources to read, and the form of every kept episode."""

    sources: tuple[SourceConfig, ...] = Field(min_length=1)
    image_size: ImageSize | None = Field(
        default=None, description="(height, width) of all images; null keeps each size"
    )
    fit: Fit = Field(default="stretch", description="how images come to that size; letterbox and crop keep the aspect")
    fps: FrameRate | None = Field(default=None, description="rate of all episodes; null keeps each rate")
    stride: int | None = Field(default=None, ge=1, description="instead of fps: keep every so many frames")
    views: tuple[str, ...] | Literal["available"] | None = Field(
        default=None,
        description="views to keep, in this order; null keeps all that the source names, and refuses episodes that lack one;"
        " available keeps those that are there",
    )
    trim: Literal["common"] | None = Field(
        default=None,
        description="common: where states and videos differ by one frame, keep the frames that all have; null refuses it",
    )
    primary_view: str | None = Field(
        default=None,
        description="task-facing view for single-view training; null: the source's, else head, else most motion",
    )
    splits: Splits = Field(
        default={},
        description="scene name pattern -> split, first match wins, else the source's; or {by: scene | episode, test: 0.1,"
        " validation: 0.05, seed: 0}",
    )
    near_duplicates: bool = Field(default=True, description="quarantine copies that were encoded, resized or cut again")
    leakage: LeakageConfig = LeakageConfig()
    normalise_instructions: bool = Field(default=True, description="bring task texts to one spelling")
    sampling_alpha: float = Field(
        default=1.0, ge=0, le=1, description="share of a source in training ~ hours ** alpha: 1 by hours, 0 all equal"
    )
    require_calibration: bool = Field(default=False, description="quarantine episodes with an uncalibrated view")
    min_frames: int = Field(default=2, ge=1)
    video_mode: VideoMode = Field(
        default="auto",
        description="auto: where neither size, rate nor lens changes, encoded videos are copied as they are, with their own "
        "codec; encode: every video is encoded again with the four settings below",
    )
    video_crf: int = Field(default=10, ge=0, le=51)
    video_preset: str = "veryfast"
    pixel_format: PixelFormat = Field(
        default="yuv444p",
        description="full colour: at 64x96 yuv420p costs 9 dB at the same file size; few browsers play it",
    )
    key_frame_interval: int = Field(
        default=32,
        ge=1,
        description="frames from one key frame to the next: a clip that begins in between costs the decoding up to there",
    )

    reader: ReaderLimits = Field(
        default=ReaderLimits(), description="what reading one recording may take: more is quarantined"
    )

    @model_validator(mode="after")
    def _one_rate(self) -> CurateConfig:
        if self.fps is not None and self.stride is not None:
            raise ValueError("fps and stride both say how frames are thinned: give one of them")
        return self

    @model_validator(mode="after")
    def _even_sides(self) -> CurateConfig:
        sizes = {"image_size": self.image_size}
        sizes |= {f"sources[{n}].image_size": source.image_size for n, source in enumerate(self.sources)}
        odd = [f"{name} {size[0]}x{size[1]}" for name, size in sizes.items() if size and (size[0] % 2 or size[1] % 2)]
        if self.pixel_format == "yuv420p" and odd:
            raise ValueError(f"yuv420p needs even sides: {', '.join(odd)}; choose others, or pixel_format yuv444p")
        return self

    @property
    def recordings(self) -> dict[int, str]:
        """Names of the run's own recordings, by the number of the source that reads each."""
        return {n: s.recording for n, s in enumerate(self.sources) if isinstance(s, RecordingSourceConfig)}

    def own_robots(self) -> dict[int, Path]:
        """Files of robots that do not ship with the project, by the numbers of the sources that name them."""
        named = {n: getattr(source, "embodiment", None) for n, source in enumerate(self.sources)}
        found = {n: own_embodiment(name) for n, name in named.items() if name}
        return {n: path for n, path in found.items() if path is not None}

    def with_located_robots(self) -> CurateConfig:
        """The configuration with absolute paths of such robots, for processes that may work in another folder."""
        robots = {n: {"embodiment": str(path.resolve())} for n, path in self.own_robots().items()}
        sources = tuple(source.model_copy(update=robots.get(n)) for n, source in enumerate(self.sources))
        return self.model_copy(update={"sources": sources})

    def weights_read(self) -> Mapping[str, Path | None]:
        """Descriptions of robots, and calibration files outside of the recordings, whose content counts in the cache key."""
        named = {
            f"sources.{n}.calibration": getattr(source, "calibration", None) for n, source in enumerate(self.sources)
        }
        cameras = {key: Path(name) for key, name in named.items() if name and Path(name).is_absolute()}
        robots = {f"sources.{n}.embodiment": path for n, path in self.own_robots().items()}
        described = {f"{key}.description": load_embodiment(path).description_path for key, path in robots.items()}
        return {**robots, **described, **cameras}

    def for_source(self, number: int) -> CurateConfig:
        """The configuration as it holds for sources[number]: what the source says of itself goes before what is said for
        all."""
        source = self.sources[number]
        own = {name: getattr(source, name) for name in ("image_size", "fit", "primary_view")}
        changes = {name: value for name, value in own.items() if value is not None}
        if source.target_fps is not None or source.stride is not None:
            changes |= {"fps": source.target_fps, "stride": source.stride}
        return self.model_copy(update=changes) if changes else self
