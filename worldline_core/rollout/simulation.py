"""Running predictions: `Session` is driven by action maps, `Simulation` (of ``WorldLine.start``) by the commands of a policy.

A session begins with the current images and predicts one unit (a block or a clip) at a time. A causal model's KV cache is a
window of constant size with positions counted from its start. Every clip of a Stage II model, and every few blocks of a causal
one that has anchors, begin anew: the last predicted picture of every view is the observed one of what follows. Pictures are
decoded unit by unit, so memory does not grow with the length.

Equal seeds and controls give equal bytes on a CPU, and the noise of a clip does not depend on who shares its batch. In bfloat16
neither do the bytes; in float32 sums of another batch size are rounded otherwise, by one grey level at most.

Axis legend: b clips, v views, a channels of the action maps (of poses: arms), t latent frames, n frames, j columns of the
embodiment's state, h w pixels or latent cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from functools import partial
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import VideoDecoder, VideoTokenizer, frames_to_video, video_to_frames
from worldline_core.model.world_model_config import ActionContract
from worldline_core.rollout.observation import (
    COMMAND_OPENING,
    COMMAND_TOLERANCE_RAD,
    Camera,
    check_controls,
    checked_seeds,
    image_size,
    project_controls,
    real_numbers,
)
from worldline_core.rollout.samplers import BlockCausalSimulator, FullClipSampler

Frames = list[dict[str, np.ndarray]]
"""Videos of every clip: ``uint8 (n, H, W, 3)`` RGB by view."""


class LazyFrames:
    """A video of one view ``uint8 (n, H, W, 3)``, indexed like an array, of which some is decoded only when it is read.

    Args:
        parts: frames in their order.
    """

    def __init__(self, parts: Iterable[np.ndarray | Undecoded]) -> None:
        self._parts = list(parts)
        counts = [len(part) for part in self._parts]
        self._part_of = np.repeat(np.arange(len(counts)), counts)
        self._within = np.concatenate([np.arange(count) for count in counts])

    def __len__(self) -> int:
        return len(self._part_of)

    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> np.ndarray:
        parts, within = np.atleast_1d(self._part_of[index]), np.atleast_1d(self._within[index])
        read = {part: self._parts[part][within[parts == part]] for part in parts.tolist() or [-1]}
        frames = np.empty((len(parts), *next(iter(read.values())).shape[1:]), np.uint8)
        for part, some in read.items():
            frames[parts == part] = some
        return frames[0] if np.ndim(self._part_of[index]) == 0 else frames

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    @classmethod
    def joined(cls, *videos: LazyFrames | np.ndarray) -> LazyFrames:
        """Videos one after the other."""
        return cls(part for video in videos for part in (video._parts if isinstance(video, LazyFrames) else [video]))


class Undecoded:
    """Frames of latents; those of a latent frame are decoded when one of them is read, and kept.

    Args:
        decode: videos ``uint8 (n, H, W, 3)`` of some of the latents of each clip.
        group: frames of a latent frame.
    """

    def __init__(
        self, decode: Callable[[Tensor], list[np.ndarray]], latents: Float[Tensor, "1 c t h w"], group: int
    ) -> None:
        self._decode, self._latents, self._group = decode, latents, group
        self._decoded: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return self._group * self._latents.shape[2]

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        groups = (index // self._group).tolist()
        if missing := sorted(set(groups) - self._decoded.keys()):
            (decoded,) = self._decode(self._latents[:, :, missing])
            frames = np.split(decoded, len(missing))
            self._decoded.update(zip(missing, frames, strict=True))
        return np.stack([self._decoded[group][row % self._group] for group, row in zip(groups, index, strict=True)])


class Session:
    """One running prediction of a batch of clips that share their views.

    Args:
        images: what each view sees now, in [-1, 1] at the model's size.

    Attributes:
        observed: the given images, encoded and decoded by the tokenizer; one frame per view.
    """

    def __init__(
        self,
        sampler: BlockCausalSimulator | FullClipSampler,
        tokenizer: VideoTokenizer,
        images: Float[Tensor, "b v 3 h w"],
        *,
        device: str,
        bfloat16: bool,
    ) -> None:
        self._sampler = sampler
        self._tokenizer = tokenizer
        self._device = device
        self._bfloat16 = bfloat16
        self._decoders: list[VideoDecoder]
        self._first: Tensor | None  # observed latents of a clip that no step has begun
        self._units: int  # predicted since the observed picture
        self._last: Sequence[Mapping[str, np.ndarray | LazyFrames]] = []  # of the last unit, where a clip may begin
        self.observed = self._decode(rearrange(self._begin(images), "b v c h w -> b v c 1 h w"))

    @torch.no_grad()
    def step(self, maps: Float[Tensor, "b v a t h w"]) -> Frames:
        """The frames of the next unit, under maps of the last known latent frame and of those to predict.

        Raises:
            DataError: the controls given to a causal model are not those of one block.
        """
        if self._clip_ended:
            self._begin_anew()
        self._last = frames = self._decode(self._sample(maps))
        return frames

    def steps(
        self, maps: Iterable[Float[Tensor, "b v a t h w"]], *, overlapped: bool | None = None
    ) -> Iterator[Frames]:
        """Like `step`, for controls that are known in advance: one block is decoded while the next is sampled.

        By default so on a GPU alone, where decoding gets a stream of its own. A clip waits for the picture that it begins at.
        """
        on_gpu = torch.device(self._device).type == "cuda"
        if not (on_gpu if overlapped is None else overlapped):
            yield from map(self.step, maps)
            return
        beside = torch.cuda.Stream(self._device) if on_gpu else None
        waiting: Future[Frames] | None = None
        with ThreadPoolExecutor(1) as decoding:
            for given in maps:
                if self._clip_ended:
                    if waiting is not None:
                        self._last, waiting = (frames := waiting.result()), None
                        yield frames
                    self._begin_anew()
                latents = self._sample(given)
                if beside is not None:
                    beside.wait_stream(torch.cuda.current_stream(self._device))
                following = decoding.submit(self._decode, latents, beside)
                if waiting is not None:
                    yield waiting.result()
                waiting = following
            if waiting is not None:
                self._last = frames = waiting.result()
                yield frames

    @torch.no_grad()
    def step_lazily(self, maps: Float[Tensor, "b v a t h w"]) -> list[dict[str, LazyFrames]]:
        """Like `step`, but only the last latent frame is decoded now, where the tokenizer can decode the others alone."""
        if self._clip_ended:
            self._begin_anew()
        self._last = frames = self._decode_lazily(self._sample(maps))
        return frames

    @property
    def _clip_ended(self) -> bool:
        return self._sampler.units_per_clip is not None and self._units >= self._sampler.units_per_clip

    @torch.no_grad()
    def _begin_anew(self) -> None:
        """Begin a clip at the last pictures, which are not decoded again."""
        last = [[frames_to_video(clip[v][-1:])[:, 0] for v in self._sampler.views] for clip in self._last]
        first = self._begin(torch.stack([torch.stack(pictures) for pictures in last]))
        with self._precision():
            for decoder, clip in zip(self._decoders, first, strict=True):
                decoder.begin(rearrange(clip, "v c h w -> v c 1 h w"))

    @torch.no_grad()
    def _sample(self, maps: Tensor) -> Tensor:
        if self._first is not None:
            self._sampler.start(self._first, maps[:, :, :, :1])
            self._first = None
        self._units += 1
        return self._sampler.step(maps[:, :, :, 1:])

    def select(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> Session:
        """A session of these clips that continues from their present state, independently of this one. Naming a clip several
        times makes branches of it, which share the cached history of a causal model. ``seeds``: of the noise from here on, one
        for each of ``clips``; by default it continues unchanged.
        """
        other = copy(self)
        other._sampler = self._sampler.fork(clips, seeds)
        other._first = None if self._first is None else self._first[list(clips)]
        other._decoders = [self._decoders[clip].copy() for clip in clips]
        other._last = [self._last[clip] for clip in clips] if self._last else []
        other.observed = [self.observed[clip] for clip in clips]
        return other

    @torch.no_grad()
    def _begin(self, images: Tensor) -> Tensor:
        """Begin a clip at these images, and return their latents."""
        images, self._units = images.to(self._device), 0
        self._first = first = encode_images(self._tokenizer, images)
        self._decoders = [self._tokenizer.decoder(clip) for clip in images]
        return first

    def _precision(self) -> torch.autocast:
        return torch.autocast(self._device.split(":")[0], torch.bfloat16, enabled=self._bfloat16)

    @torch.no_grad()
    def _decode(self, latents: Tensor, stream: torch.cuda.Stream | None = None) -> Frames:
        """Frames of latents; on a stream of its own where another thread decodes."""
        if stream is not None:
            latents.record_stream(stream)
        with torch.cuda.stream(stream):
            # One clip at a time: the decoder works on whole images, which take a hundred times the memory of latents.
            videos = (self._frames(decoder, clip) for decoder, clip in zip(self._decoders, latents, strict=True))
            return [dict(zip(self._sampler.views, frames, strict=True)) for frames in videos]

    def _decode_lazily(self, latents: Tensor) -> list[dict[str, LazyFrames]]:
        videos: list[dict[str, LazyFrames]] = []
        for decoder, clip in zip(self._decoders, latents, strict=True):
            alone = [decoder.out_of_order(row) for row in range(len(clip))]
            newest = self._frames(decoder, clip if None in alone else clip[:, :, -1:])
            videos.append(
                {view: LazyFrames([frames]) for view, frames in zip(self._sampler.views, newest, strict=True)}
            )
            for row, (view, later) in enumerate(zip(self._sampler.views, alone, strict=True)):
                if later is not None:
                    decode = partial(self._frames, later)
                    earlier = Undecoded(decode, clip[row : row + 1, :, :-1], len(newest[row]))
                    videos[-1][view] = LazyFrames([earlier, newest[row]])
        return videos

    @torch.no_grad()
    def _frames(self, decoder: VideoDecoder, latents: Float[Tensor, "v c t h w"]) -> list[np.ndarray]:
        """Decoded frames of each view; on any thread."""
        with self._precision():
            return [video_to_frames(video) for video in decoder(latents)]


@torch.no_grad()
def encode_images(tokenizer: VideoTokenizer, images: Float[Tensor, "b v 3 h w"]) -> Float[Tensor, "b v c h_l w_l"]:
    """Latents of single frames."""
    latents = tokenizer.encode(rearrange(images, "b v c h w -> (b v) c 1 h w"))
    return rearrange(latents, "(b v) c 1 h w -> b v c h w", v=images.shape[1])


USUAL_CLIP_FRAMES = 33
"""Clip length of a stepped Stage II model without ``clip_frames``: the paper's."""


class Starts:
    """Checked observations and states at which simulations of one robot begin.

    Args:
        images, cameras: by view, of one start or of each; a wrist camera has its pose at the start, or a known mount.
        state: ``(j)`` or ``(b, j)``, the controls that belong to the images, or to the cameras where there are ``earlier`` ones.
        earlier: commands ``(n, j)`` of each start from there to its images, however many; None: the images are of the state.

    Raises:
        DataError: the starts do not fit together, a shape is wrong, a view or a camera is missing, a number is not finite,
            or the state is far beyond the robot's limits.
        ConfigError: there is no such embodiment.
    """

    def __init__(
        self,
        images: Mapping[str, np.ndarray] | Sequence[Mapping[str, np.ndarray]],
        cameras: Mapping[str, Camera] | Sequence[Mapping[str, Camera]],
        embodiment: str | Path | ArmKinematics,
        state: np.ndarray,
        seeds: int | Sequence[int],
        earlier: Sequence[np.ndarray] | None = None,
    ) -> None:
        self.images = [images] if isinstance(images, Mapping) else list(images)
        count = len(self.images)
        self.cameras = [cameras] * count if isinstance(cameras, Mapping) else list(cameras)
        self.seeds = checked_seeds(seeds, count)
        known = isinstance(embodiment, ArmKinematics)
        self.kinematics = embodiment if known else ArmKinematics(load_embodiment(embodiment))
        rows = np.atleast_1d(real_numbers(state, "the state at the start"))
        self.state = np.repeat(rows[None], count, axis=0) if rows.ndim == 1 else rows
        none = np.empty((0, rows.shape[-1]))
        self.earlier = [none] * count if earlier is None else [real_numbers(one, "earlier commands") for one in earlier]
        given = {name: len(getattr(self, name)) for name in ("images", "cameras", "seeds", "state", "earlier")}
        if count == 0 or len(set(given.values())) > 1:
            raise DataError(
                "The starts of a simulation do not fit together", expected="one of each per clip", got=given
            )
        check_controls(self.kinematics, self.state, "the state at the start")
        for clip, commands in enumerate(self.earlier):
            where = f"earlier commands, clip {clip}"
            check_controls(self.kinematics, commands, where, COMMAND_TOLERANCE_RAD, COMMAND_OPENING)
        sizes = {image_size(*pair) for pair in zip(self.images, self.cameras, strict=True)}
        if len(sizes) > 1 or len({frozenset(start) for start in self.images}) > 1:
            raise DataError(
                "Clips of one batch show the same views at one size",
                expected="the same views and (H, W)",
                got={"sizes": sorted(sizes), "views": [sorted(start) for start in self.images]},
            )
        self.image_size = sizes.pop()

    def pictures(self, views: Sequence[str], size: tuple[int, int]) -> Float[Tensor, "b v 3 h w"]:
        return torch.stack(
            [torch.stack([frames_to_video(start[view][None], size)[:, 0] for view in views]) for start in self.images]
        )

    def project(self, clip: int, controls: np.ndarray, fps: float) -> EpisodeTracks:
        """Tracks of controls ``(rows, j)`` whose first row is that of the start."""
        return project_controls(self.cameras[clip], self.image_size, self.kinematics, controls=controls, fps=fps)

    def select(self, clips: Sequence[int]) -> Starts:
        other = copy(self)
        for name in ("images", "cameras", "seeds", "earlier"):
            setattr(other, name, [getattr(self, name)[clip] for clip in clips])
        other.state = self.state[list(clips)]
        return other


SPEED_RAD_S, SPEED_M_S, GRIPPER_TRAVEL_S = math.pi, 1.0, 0.4


class CommandedRobot:
    """Robots of one embodiment that follow commands within their limits, one for each clip: what is executed, and their places.

    A joint's command is clipped to its position limits and to what pi rad/s or 1 m/s reaches in a frame from the command
    before; a gripper's to its range. These are the *executed* commands. Joints are at every frame where that frame's command
    wants them; a gripper follows within 0.4 s from open to closed.

    Args:
        start: (b, j) where they are and what was commanded last, in the embodiment's layout. A limit never moves a robot that
            began beyond it.
        limits: hold commands within the embodiment's limits.
        earlier: commands (n, j) of each clip that were executed since then as they are, whatever the limits.

    Attributes:
        command, state: (b, j) of the last frame.
    """

    def __init__(
        self,
        kinematics: ArmKinematics,
        fps: float,
        start: np.ndarray,
        *,
        limits: bool,
        earlier: Sequence[np.ndarray] = (),
    ) -> None:
        embodiment = kinematics.embodiment
        self._fastest = np.full(start.shape[1], np.inf)
        self._low, self._high = np.full_like(start, -np.inf), np.full_like(start, np.inf)
        self._grippers = [embodiment.gripper_column(arm) for arm in embodiment.arms]
        ranges = np.array([sorted((arm.gripper.closed, arm.gripper.open)) for arm in embodiment.arms])
        self._gripper_steps = (ranges[:, 1] - ranges[:, 0]) / (GRIPPER_TRAVEL_S * fps)
        self.command, self.state = start.copy(), start.copy()
        for clip, commands in enumerate(earlier):
            if len(commands):
                moved = self.select([clip]).follow(commands[None])[0]
                self.command[clip], self.state[clip] = moved.command[0], moved.state[0]
        if not limits:
            return
        for arm, gripper_range in zip(embodiment.arms, ranges, strict=True):
            columns, gripper = embodiment.joint_columns(arm), embodiment.gripper_column(arm)
            self._low[:, columns], self._high[:, columns] = np.array(arm.limits).T
            self._low[:, gripper], self._high[:, gripper] = gripper_range
            speeds = [SPEED_RAD_S if name in kinematics.revolute else SPEED_M_S for name in arm.joints]
            self._fastest[columns] = np.array(speeds) / fps
        self._low, self._high = np.minimum(self._low, self.command), np.maximum(self._high, self.command)

    def follow(self, commands: np.ndarray) -> tuple[CommandedRobot, np.ndarray, np.ndarray]:
        """The robots after finite commands (b, n, j), executed commands (b, n, j) and states (b, n, j); this one stays."""
        executed, before = np.empty_like(commands), self.command
        for frame in range(commands.shape[1]):
            reachable = np.clip(commands[:, frame], before - self._fastest, before + self._fastest)
            executed[:, frame] = before = np.clip(reachable, self._low, self._high)
        states, opening = executed.copy(), self.state[:, self._grippers]
        for frame in range(commands.shape[1]):
            wanted = executed[:, frame, self._grippers]
            opening = np.clip(wanted, opening - self._gripper_steps, opening + self._gripper_steps)
            states[:, frame, self._grippers] = opening
        other = copy(self)
        other.command, other.state = executed[:, -1], states[:, -1]
        return other, executed, states

    def select(self, clips: Sequence[int]) -> CommandedRobot:
        """The robots of these clips, in their present state."""
        other, index = copy(self), list(clips)
        for name in ("command", "state", "_low", "_high"):
            setattr(other, name, getattr(self, name)[index])
        return other


class Simulation:
    """A batch of running predictions of one robot, stepped by controls (made by ``WorldLine.start``).

    Args:
        maps: action maps of the tracks of each clip, at the latent frames of a step; the first of a track's frames is the start.

    Attributes:
        views, fps, image_size: of the pictures, (H, W).
        frames_per_step: controls that a step takes, and pictures that it gives.
        num_frames: pictures so far, the observed one with them.
        pictures: last picture of every view, of each clip; at the start the observed one, as the tokenizer shows it.
        commands, states: ``(b, n, j)`` of the last step's frames: what was executed (commands within the limits), and where
            the robot then is (`CommandedRobot`). At the start those of the observed frame.
    """

    def __init__(
        self,
        session: Session,
        starts: Starts,
        contract: ActionContract,
        maps: Callable[[Sequence[EpisodeTracks]], Tensor],
        *,
        views: tuple[str, ...],
        image_size: tuple[int, int],
        frames: int,
        limits: bool,
    ) -> None:
        self._session, self._starts, self._maps = session, starts, maps
        self._draws_commands, self.fps = contract.controls == "action", contract.fps
        self._robot = CommandedRobot(starts.kinematics, self.fps, starts.state, limits=limits, earlier=starts.earlier)
        self.views, self.image_size, self.frames_per_step = views, image_size, frames
        self.num_frames = 1
        self.pictures = [{view: video[-1] for view, video in clip.items()} for clip in session.observed]
        self.commands, self.states = self._robot.command[:, None], self._robot.state[:, None]
        self._drawn = self._robot.command if self._draws_commands else self._robot.state
        self._tracks = [self._project(clip, rows[None]) for clip, rows in enumerate(self._drawn)]

    def __len__(self) -> int:
        return len(self._starts.state)

    @property
    def embodiment(self) -> Embodiment:
        return self._starts.kinematics.embodiment

    @property
    def state(self) -> np.ndarray:
        """``(b, j)``: where the robot is at the last picture, in the embodiment's layout and units."""
        return self.states[:, -1]

    @property
    def tracks(self) -> list[EpisodeTracks]:
        """Controls of each clip as drawn into the maps of the last step's frames: for overlays."""
        return [tracks.clip(range(2, tracks.num_frames)) for tracks in self._tracks]

    @property
    def tool_poses(self) -> np.ndarray:
        """``(b, a, 4, 4)`` float32, tools to base at the last picture, as they were drawn."""
        return np.stack([tracks.T_base_tool[-1] for tracks in self._tracks])

    def step(self, controls: np.ndarray) -> Frames:
        """Predict the next ``frames_per_step`` frames.

        Args:
            controls: ``(b, n, j)`` commands in the embodiment's layout and units, one row a frame at ``fps``; ``(n, j)`` of a
                single clip.

        Returns:
            Of every clip, ``uint8 (n, H, W, 3)`` by view. After an error the simulation is as it was before the call.

        Raises:
            DataError: the shape is another one, or a command is not finite or in another unit.
        """
        return self._step(controls, self._session.step)

    def step_lazily(self, controls: np.ndarray) -> list[dict[str, LazyFrames]]:
        """Like `step`; all but the last few frames are decoded when they are read, where the tokenizer allows that."""
        return self._step(controls, self._session.step_lazily)

    def follow(self, controls: Float[np.ndarray, "b n j"]) -> tuple[np.ndarray, np.ndarray]:
        """Executed commands and states ``(b, n, j)`` under commands from here on, however many; no picture is predicted."""
        return self._robot.follow(np.asarray(controls, dtype=np.float64))[1:]

    def fork(self, n: int, seeds: Sequence[int] | None = None) -> Simulation:
        """``n`` branches of every clip (those of a clip follow each other), to be driven separately; this simulation stays as it
        is. The history of a causal model is shared, not copied.

        Args:
            seeds: of the noise of each branch from here on, which begins anew even with the clip's own. By default all
                branches of a clip go on with its noise, so they differ by their controls alone, and each equals a simulation
                that was driven so from its start.

        Raises:
            DataError: no branch, or another number of seeds.
        """
        return self.select([clip for clip in range(len(self)) for _ in range(n)], seeds)

    def select(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> Simulation:
        """A simulation of these clips in their present state; this one stays as it is. ``seeds`` as of :meth:`fork`.

        Raises:
            DataError: there is no such clip, none is named, or the number of seeds is another one.
        """
        index = [int(clip) for clip in clips]
        if not index or min(index) < 0 or max(index) >= len(self):
            raise DataError("No such clips in the simulation", expected=f"some of 0..{len(self) - 1}", got=index[:8])
        if seeds is not None and len(seeds) != len(index):
            raise DataError("One seed for each clip is needed", expected=len(index), got=len(seeds))
        seeds = None if seeds is None else checked_seeds(seeds, len(index))
        other = copy(self)
        other._session = self._session.select(index, seeds)
        other._starts, other._robot = self._starts.select(index), self._robot.select(index)
        other.pictures = [self.pictures[clip] for clip in index]
        other.commands, other.states, other._drawn = (x[index] for x in (self.commands, self.states, self._drawn))
        other._tracks = [self._tracks[clip] for clip in index]
        return other

    def copy(self) -> Simulation:
        """A snapshot to go back to; it shares the history's tensors."""
        return self.select(range(len(self)))

    def _step[Video: np.ndarray | LazyFrames](
        self, controls: np.ndarray, predict: Callable[[Tensor], list[dict[str, Video]]]
    ) -> list[dict[str, Video]]:
        commands = self._checked(controls)
        robot, executed, states = self._robot.follow(commands)
        drawn = executed if self._draws_commands else states
        tracks = [self._project(clip, rows) for clip, rows in enumerate(drawn)]
        frames = predict(self._maps(tracks))
        self._robot, self.commands, self.states = robot, executed, states
        self._tracks, self._drawn = tracks, drawn[:, -1]
        self.num_frames += self.frames_per_step
        self.pictures = [{view: video[-1] for view, video in clip.items()} for clip in frames]
        return frames

    def _project(self, clip: int, rows: np.ndarray) -> EpisodeTracks:
        """Tracks of the start, of the last frame that is known, and of ``rows``."""
        known = (self._starts.state[clip], self._drawn[clip])
        return self._starts.project(clip, np.stack((*known, *rows)), self.fps)

    def _checked(self, controls: np.ndarray) -> np.ndarray:
        commands = real_numbers(controls, "controls of a step")
        commands = commands[None] if commands.ndim == 2 and len(self) == 1 else commands
        wanted = (len(self), self.frames_per_step, self.embodiment.state_size)
        if commands.shape != wanted:
            raise DataError(
                "Controls of a step have another shape",
                where=f"frames {self.num_frames} to {self.num_frames + self.frames_per_step - 1}",
                expected=f"{wanted}: clips, frames, {', '.join(self.embodiment.state_names)}",
                got=np.shape(controls),
            )
        for clip, rows in enumerate(commands):
            where = f"controls of a step, clip {clip}"
            check_controls(self._starts.kinematics, rows, where, COMMAND_TOLERANCE_RAD, COMMAND_OPENING)
        return commands
