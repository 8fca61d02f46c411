"""Declaration of an MCAP recording: which topic is which view, joint, command and frame, and what may be missing."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, model_validator

from worldline_core.config import FrameRate, StrictModel
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import EmbodimentName, ForeignSourceConfig, GripperRange


class TopicReadings(StrictModel):
    """Some numbers of a topic: joints by name, or columns of an array of numbers."""

    topic: str
    names: tuple[str, ...] | None = Field(default=None, description="joints, for JointState messages")
    columns: tuple[NonNegativeInt, ...] | None = Field(default=None, description="places in messages without names")
    resample: Literal["linear", "hold"] = Field(default="linear", description="hold: a value counts until the next one")

    @model_validator(mode="after")
    def _one_choice(self) -> TopicReadings:
        chosen = self.names or self.columns or ()
        if (self.names is None) == (self.columns is None) or not 0 < len(chosen) == len(set(chosen)):
            raise ValueError(f"{self.topic}: give either names or columns, at least one, none twice")
        return self

    @property
    def width(self) -> int:
        return len(self.names or self.columns or ())


class JointTopic(TopicReadings):
    """The joints of an arm, in the order of the embodiment."""

    unit: Literal["rad", "deg"] = "rad"


class GripperTopic(TopicReadings):
    """The gripper of an arm; several numbers (two fingers) are averaged."""

    range: GripperRange = Field(description="what the readings are when the gripper is closed and when it is open")


class ArmReadings(StrictModel):
    """Joints and gripper of one arm, measured or commanded."""

    joints: JointTopic
    gripper: GripperTopic


class ArmTopics(StrictModel):
    """One arm. The tool is between the fingertips, +z out of the gripper (else: conventions.tool_offset_z_m)."""

    name: Literal["left", "right"]
    state: ArmReadings
    command: ArmReadings | None = None
    tool_frame: str | None = Field(default=None, description="frame of the transforms that is the tool")
    tool_pose: str | None = Field(default=None, description="topic of tool poses (PoseStamped, PoseInFrame)")

    @model_validator(mode="after")
    def _one_tool(self) -> ArmTopics:
        if self.tool_frame is not None and self.tool_pose is not None:
            raise ValueError(f"arm {self.name}: give tool_frame or tool_pose, not both")
        return self


class ViewTopics(StrictModel):
    """One camera."""

    image: str = Field(description="topic of images, compressed or raw, or of video")
    calibration: str | None = Field(default=None, description="CameraInfo or CameraCalibration; null: uncalibrated")
    frame: str | None = Field(default=None, description="with OpenCV axes (_optical_frame); null: as its messages say")
    rectified: bool = Field(default=False, description="the images are rectified: P holds their K, and no lens is left")


class WholeFiles(StrictModel):
    """Every file is an episode."""

    by: Literal["file"] = "file"


class TimeRange(StrictModel):
    """One episode inside of a file; seconds of log time since the file's first message."""

    name: str = Field(min_length=1)
    start_s: float = Field(ge=0)
    stop_s: float = Field(gt=0)
    instruction: str | None = None

    @model_validator(mode="after")
    def _forwards(self) -> TimeRange:
        if self.stop_s <= self.start_s:
            raise ValueError(f"range {self.name} ends before it starts")
        return self


class TimeRanges(StrictModel):
    """Episodes are listed here."""

    by: Literal["ranges"] = "ranges"
    ranges: tuple[TimeRange, ...] = Field(min_length=1)


class Markers(StrictModel):
    """Episodes between messages of a topic (std_msgs String or Bool, read as the texts true and false)."""

    by: Literal["markers"] = "markers"
    topic: str
    start: re.Pattern[str] = Field(
        default=re.compile(r"start(: *(?P<instruction>.*))?"), description="the whole text that begins one"
    )
    stop: re.Pattern[str] = Field(
        default=re.compile(r"stop(: *(?P<outcome>success|failure))?"), description="the whole text that ends one"
    )


class McapTopicsSourceConfig(ForeignSourceConfig):
    """MCAP files of other tools; nothing in them is guessed, so their topics are declared."""

    kind: Literal["mcap_topics"] = "mcap_topics"
    embodiment: EmbodimentName
    fps: FrameRate = Field(description="rate to which everything is brought")
    views: dict[str, ViewTopics] = Field(min_length=1)
    arms: tuple[ArmTopics, ...] = Field(default=(), description="left before right; none: the pictures alone")
    without_commands: Literal["refuse", "repeat_state"] = Field(
        default="refuse", description="repeat_state: recordings without command topics get the measured state as action"
    )
    base_frame: str = Field(default="base_link", description="the robot's base in the transforms")
    transforms: tuple[str, ...] = Field(default=("/tf",), description="topics of moving transforms")
    static_transforms: tuple[str, ...] = Field(default=("/tf_static",), description="topics of transforms that stay")
    episodes: Annotated[WholeFiles | TimeRanges | Markers, Field(discriminator="by")] = WholeFiles()
    instruction: str = ""
    time: Literal["header", "log"] = Field(
        default="header", description="which time of a message counts; messages without a header: their log time"
    )
    time_offsets_ms: dict[str, float] = Field(
        default={}, description="topic -> what to add to its header times, where its clock is known to be off"
    )
    max_image_distance_frames: float = Field(
        default=1.5, gt=0, description="of an image from its instant; 1.5 lets two images in a row be lost"
    )
    max_gap_s: float = Field(default=0.2, gt=0, description="largest interval between joint readings or transforms")
    max_clock_skew_ms: float = Field(
        default=200.0, gt=0, description="between the least delays (log time minus header time) of topics"
    )

    @model_validator(mode="after")
    def _complete(self) -> McapTopicsSourceConfig:
        names = [arm.name for arm in self.arms]
        if not names and self.embodiment != NO_EMBODIMENT:
            raise ValueError(f"the arms of {self.embodiment} are not declared; pictures alone need embodiment: none")
        if names not in ([], ["left"], ["right"], ["left", "right"]):
            raise ValueError(f"arms are {names}; expected left before right, each once")
        if len({arm.command is None for arm in self.arms}) > 1:
            raise ValueError("either all arms have commands or none")
        if names and self.arms[0].command is None and self.without_commands == "refuse":
            raise ValueError("no arm has commands: give their topics, or say without_commands: repeat_state")
        if len({arm.tool_frame is None and arm.tool_pose is None for arm in self.arms}) > 1:
            raise ValueError("either all arms have tool poses or none")
        for arm in self.arms:
            joints, commands = arm.state.joints, arm.command and arm.command.joints
            if commands is not None and commands.width != joints.width:
                raise ValueError(f"arm {arm.name} has {joints.width} joints and {commands.width} commands")
        if self.primary_view is not None and self.primary_view not in self.views:
            raise ValueError(f"primary_view {self.primary_view} is none of {', '.join(self.views)}")
        seen: dict[str, str] = {}
        for role, topics in self.topics.items():
            for topic in topics:
                if seen.setdefault(topic, role) != role:
                    raise ValueError(f"topic {topic} is declared both as {seen[topic]} and as {role}")
        return self

    def offset_ns(self, topic: str) -> int:
        """Correction added to a topic's header times [ns]."""
        return round(self.time_offsets_ms.get(topic, 0.0) * 1e6)

    @property
    def timing_view(self) -> str:
        """The view whose images the instants begin with: the primary one, else the head's, else the first declared."""
        return self.primary_view or ("head" if "head" in self.views else next(iter(self.views)))

    @property
    def readings(self) -> list[TopicReadings]:
        """Joints and grippers of all arms, measured and commanded."""
        both = [each for arm in self.arms for each in (arm.state, arm.command) if each is not None]
        return [readings for each in both for readings in (each.joints, each.gripper)]

    @property
    def topics(self) -> dict[str, set[str]]:
        """Declared topics by role."""
        return {
            "images": {view.image for view in self.views.values()},
            "calibrations": {view.calibration for view in self.views.values() if view.calibration is not None},
            "readings": {readings.topic for readings in self.readings},
            "tool poses": {arm.tool_pose for arm in self.arms if arm.tool_pose is not None},
            "transforms": {*self.transforms, *self.static_transforms},
        }
