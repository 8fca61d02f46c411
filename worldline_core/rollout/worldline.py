"""A trained world model with its tokenizer: what the cameras see now and controls in, what they will see out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.action_maps import control_frames, render_action_maps, stack_controls
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks, collate_tracks, native_vectors
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.errors import CheckpointError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import CheckpointInfo, CheckpointKind, load_checkpoint
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.model.video_tokenizer import VideoTokenizer, frames_to_video, video_to_frames
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.samplers import FULL_STEPS, BlockCausalSimulator, Noise, rollout_full_clip, sigmas_causal
from worldline_core.rollout.speed import timed


@dataclass(frozen=True)
class Camera:
    """Pinhole camera of one view.

    Attributes:
        K: (3, 3), pixels of the image that is given for this view.
        T_base_camera: camera points to the robot's base, OpenCV axes. (4, 4): the pose at the first frame; the head
            camera keeps it, a wrist camera follows its arm from there. (frames, 4, 4): the pose at every frame. None:
            a wrist camera whose mount the embodiment's file knows.
    """

    K: np.ndarray
    T_base_camera: np.ndarray | None = None


class WorldLine:
    """Predicts videos with a Stage II model (a whole clip at once) or a causal one (block by block).

    ``WorldLine.from_pretrained(folder).predict(images, controls, cameras, embodiment="ur5e_pair")``

    Attributes:
        views: of every prediction, as images and cameras must be given.
        contract: what the controls mean: their rate (``fps``), how they are drawn, the grid of the latents.
        causal: blocks, window and nodes of a causal model; None for Stage II, which predicts a clip at once.
        steps: Euler steps per block, or of the whole clip.
        frames_per_unit: a prediction has 1 + k times this many frames (k blocks, or k latent frames).
        image_size: (H, W) of the predicted frames.
        block_seconds: wall seconds of each block of the last prediction; empty where the clip is sampled whole.
    """

    def __init__(
        self,
        model: WorldModel,
        info: CheckpointInfo,
        tokenizer: VideoTokenizer,
        *,
        device: str = "cpu",
        bfloat16: bool = True,
        steps: int | None = None,
        shift: float = 1.0,
        sink_blocks: int | None = None,
        recent_blocks: int | None = None,
    ) -> None:
        self.model = model.to(device).eval().requires_grad_(False)
        self.info = info
        self.tokenizer = tokenizer
        self.device = device
        self.bfloat16 = bfloat16
        self.views = tuple(info.config.views)
        self.contract = info.contract
        self.causal = info.causal
        if self.causal is not None:
            window = {"sink_blocks": sink_blocks, "recent_blocks": recent_blocks}
            changes = {name: value for name, value in window.items() if value is not None}
            self.causal = self.causal.model_copy(update={"sigmas": sigmas_causal(self.causal, steps), **changes})
        self.steps = (steps or FULL_STEPS) if self.causal is None else self.causal.steps
        self.shift = shift
        block = 1 if self.causal is None else self.causal.block_size
        self.frames_per_unit = tokenizer.temporal_compression * block
        rows, columns = self.contract.grid_size
        self.image_size = (rows * tokenizer.spatial_compression, columns * tokenizer.spatial_compression)
        self.block_seconds: list[float] = []

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str,
        *,
        tokenizer: Path | str | None = None,
        expect_kind: Literal["stage2", "causal"] | None = None,
        device: str = "cpu",
        bfloat16: bool = True,
        steps: int | None = None,
        shift: float = 1.0,
        sink_blocks: int | None = None,
        recent_blocks: int | None = None,
    ) -> WorldLine:
        """Load a Stage II or causal checkpoint and the tokenizer that it was trained with.

        Args:
            tokenizer: its folder; by default ``tokenizer`` in the checkpoint's folder, else beside it.
            expect_kind: refuse checkpoints of another kind.
            bfloat16: mixed precision of the model and the decoder.
            steps: Euler steps; by default those of the causal model, 35 for a Stage II model.
            shift: of a Stage II model's noise levels towards noise (1: even steps, as in the paper).
            sink_blocks, recent_blocks: the causal model's window, by default the one it was trained with.

        Raises:
            CheckpointError: a folder is not what it should be, or the tokenizer is not the model's.
            ConfigError: fewer than one step.
        """
        folder = Path(folder)
        kinds: tuple[CheckpointKind, ...] = ("stage2", "causal") if expect_kind is None else (expect_kind,)
        model, info = load_checkpoint(folder, expect_kind=kinds, towers="generation")
        places = [Path(tokenizer)] if tokenizer is not None else [folder / "tokenizer", folder.parent / "tokenizer"]
        place = next((place for place in places if place.is_dir()), None)
        if place is None:
            raise CheckpointError(
                "The model's tokenizer is not here",
                where=folder,
                expected=f"a folder {' or '.join(map(str, places))}",
                next_step="give its folder as tokenizer=...",
            )
        codec = load_tokenizer(place, device)
        info.contract.require(where=place, tokenizer=tokenizer_fingerprint(codec, place))
        return cls(
            model,
            info,
            codec,
            device=device,
            bfloat16=bfloat16,
            steps=steps,
            shift=shift,
            sink_blocks=sink_blocks,
            recent_blocks=recent_blocks,
        )

    def predict(
        self,
        images: Mapping[str, np.ndarray],
        controls: np.ndarray | None,
        cameras: Mapping[str, Camera],
        *,
        embodiment: str | Path | None = None,
        tool_poses: np.ndarray | None = None,
        gripper: np.ndarray | None = None,
        seed: int = 42,
    ) -> dict[str, np.ndarray]:
        """Videos of every view under these controls; the same arguments give the same bytes on a CPU.

        Args:
            images: what each view sees now, ``uint8 (H, W, 3)`` RGB, all of one size.
            controls: ``(frames, state size)`` in the embodiment's layout (for each arm joints [rad], then the gripper's
                opening, 0 closed .. 1 open), at ``contract.fps`` frames per second. Row 0 belongs to the images. Or
                None, with tool poses instead.
            cameras: of every view.
            embodiment: name or YAML file of the robot; needed with ``controls``.
            tool_poses: ``(frames, arms, 4, 4)``, tools (between the fingertips, +z out of the gripper) to base, arms in
                the order left, right; with ``gripper``, the openings ``(frames, arms)``.

        Returns:
            ``uint8 (frames, H, W, 3)`` per view, the observed frame first, at ``image_size``.

        Raises:
            DataError: a view is missing, a shape does not fit, or the number of frames is not 1 + k whole units.
            CalibrationError: a camera cannot be used.
            ConfigError: there is no such embodiment.
        """
        episode, kinematics, follow = self._episode(images, controls, cameras, embodiment, tool_poses, gripper)
        tracks, _ = compute_tracks(
            episode,
            kinematics,
            controls="action" if controls is not None else "state",  # given tool poses stand for themselves
            without_mount="first_frame_mount" if follow else "recorded",
        )
        first = torch.stack([frames_to_video(images[view][None], self.image_size)[:, 0] for view in self.views])
        return self.predict_batch(first[None], [tracks], [episode.num_frames], [seed])[0]

    @torch.no_grad()
    def predict_batch(
        self,
        images: Float[Tensor, "b v 3 h w"],
        tracks: Sequence[EpisodeTracks],
        frames: Sequence[int],
        seeds: Sequence[int],
        *,
        without_actions: bool = False,
    ) -> list[dict[str, np.ndarray]]:
        """Videos of a batch of equal lengths.

        Args:
            images: first frames in [-1, 1] at ``image_size``.
            tracks: controls from the observed frame on; where they end early, the last ones stay.
            frames: length of each prediction.
            seeds: of each clip's noise, which does not depend on who shares the batch.
            without_actions: with maps of zeros.
        """
        first, maps = self.encode(images, tracks, frames, without_actions=without_actions)
        latents = self._sample(first, maps, seeds)
        clips: list[dict[str, np.ndarray]] = []
        with torch.autocast(self.device.split(":")[0], torch.bfloat16, enabled=self.bfloat16):
            # One clip at a time: the decoder works on whole images, which take a hundred times the memory of latents.
            for clip, observed in zip(latents, images.to(self.device), strict=True):
                video = self.tokenizer.decode(clip, observed)
                clips.append({view: video_to_frames(video[v]) for v, view in enumerate(self.views)})
        return clips

    def encode(
        self,
        images: Float[Tensor, "b v 3 height width"],
        tracks: Sequence[EpisodeTracks],
        frames: Sequence[int],
        *,
        without_actions: bool = False,
    ) -> tuple[Float[Tensor, "b v c h w"], Float[Tensor, "b v a t #h #w"]]:
        """Latents of the first frames, and the controls' maps at their resolution (or vectors, of a model with FiLM)."""
        flat = rearrange(images, "b v c h w -> (b v) c 1 h w").to(self.device)
        with torch.no_grad():
            first = rearrange(self.tokenizer.encode(flat), "(b v) c 1 h w -> b v c h w", v=len(self.views))
        cut = []
        for track, count in zip(tracks, frames, strict=True):
            index = [
                min(frame, track.num_frames - 1) for frame in control_frames(count, self.info.config.action_frames)
            ]
            cut.append(track.clip(index, wrist_projection=self.contract.wrist_projection, start=0))
        size = self.info.config.native_size
        maps = (
            native_vectors(cut, self.views, size).to(self.device)
            if size is not None
            else render_action_maps(
                collate_tracks(cut, views=self.views),
                cut[0].image_size,
                grid_size=(first.shape[-2], first.shape[-1]),
                sigma_px_ref=self.contract.sigma_px_ref,
            ).to(self.device)
        )
        maps = stack_controls(maps, self.info.config.action_frames)
        return first, torch.zeros_like(maps) if without_actions else maps

    def simulator(self, seeds: Sequence[int]) -> BlockCausalSimulator:
        """The causal model, to be driven block by block with new controls.

        Raises:
            CheckpointError: a Stage II model predicts whole clips only.
        """
        if self.causal is None:
            raise CheckpointError("Only a causal model goes block by block", expected="causal", got=self.info.kind)
        noise = Noise(seeds)
        return BlockCausalSimulator(
            self.model, self.causal, noise=noise, views=self.views, fps=self.contract.fps, bfloat16=self.bfloat16
        )

    def _sample(self, first: Tensor, maps: Tensor, seeds: Sequence[int]) -> Tensor:
        self.block_seconds = []
        if self.causal is None:
            noise = Noise(seeds)
            return rollout_full_clip(
                self.model,
                first,
                maps,
                noise=noise,
                steps=self.steps,
                shift=self.shift,
                views=self.views,
                fps=self.contract.fps,
                bfloat16=self.bfloat16,
            )
        simulator = self.simulator(seeds)
        simulator.start(first, maps[:, :, :, :1])
        blocks = [first[:, :, :, None]]
        for controls in maps[:, :, :, 1:].split(self.causal.block_size, dim=3):
            block, elapsed = timed(partial(simulator.step, controls), self.device)
            blocks.append(block)
            self.block_seconds.append(elapsed.wall)
        return torch.cat(blocks, dim=3)

    def _episode(
        self,
        images: Mapping[str, np.ndarray],
        controls: np.ndarray | None,
        cameras: Mapping[str, Camera],
        embodiment: str | Path | None,
        tool_poses: np.ndarray | None,
        gripper: np.ndarray | None,
    ) -> tuple[Episode, ArmKinematics | None, bool]:
        """The arguments of :meth:`predict` as an episode, its kinematics, and whether wrist cameras follow their arms."""
        if (controls is None) == (tool_poses is None) or (controls is not None and embodiment is None):
            raise DataError(
                "A prediction is driven by controls of an embodiment, or by tool poses",
                expected="controls and embodiment, or tool_poses and gripper",
                got={"controls": controls is not None, "embodiment": embodiment, "tool_poses": tool_poses is not None},
            )
        driven = np.asarray(controls if controls is not None else tool_poses, np.float64)
        frames, unit = len(driven), self.frames_per_unit
        if frames <= unit or (frames - 1) % unit:
            raise DataError(
                "The model predicts one observed frame and whole blocks",
                expected=f"1 + k * {unit} rows of controls",
                got=frames,
                next_step=f"give {1 + max(1, (frames - 1) // unit) * unit} rows",
            )
        for name, given in (("images", images), ("cameras", cameras)):
            if set(given) != set(self.views):
                raise DataError(f"The {name} are not those of the model's views", expected=self.views, got=list(given))
        shapes = {view: image.shape for view, image in images.items()}
        height, width = next(iter(shapes.values()))[:2]
        if any(shape != (height, width, 3) for shape in shapes.values()):
            raise DataError("First images are RGB and of one size", expected="(H, W, 3) in every view", got=shapes)
        kinematics = None if controls is None or embodiment is None else ArmKinematics(load_embodiment(embodiment))
        arms = () if kinematics is None else kinematics.embodiment.arms
        known = {arm.camera_view for arm in arms if arm.wrist_camera}
        poses, follow = _poses(cameras, known, frames)
        joints = driven if controls is not None else driven.reshape(frames, -1)
        episode = Episode(
            episode_id="prediction",
            source="prediction",
            embodiment=str(embodiment),
            scene="",
            task_family="unknown",
            instruction="",
            outcome="unknown",
            split="test",
            fps=self.contract.fps,
            state=joints,
            action=joints,
            timestamps=np.arange(frames) / self.contract.fps,
            cameras={
                view: CameraTrack(view, np.asarray(cameras[view].K, np.float64), pose, width, height)
                for view, pose in poses.items()
            },
            T_base_ee=None if controls is not None else driven,
            gripper=gripper,
        )
        return episode, kinematics, follow


def _poses(cameras: Mapping[str, Camera], mounted: set[str], frames: int) -> tuple[dict[str, np.ndarray], bool]:
    """Poses ``(1 or frames, 4, 4)`` per view, and whether wrist cameras follow their arms from the first frame's pose.

    Raises:
        DataError: a pose has a wrong shape or is missing, or wrist cameras are given in two ways.
    """
    poses: dict[str, np.ndarray] = {}
    forms: dict[str, int] = {}
    for view, camera in cameras.items():
        if camera.T_base_camera is None and view not in mounted:
            raise DataError(
                "A camera without a pose",
                where=view,
                expected="T_base_camera, or an embodiment whose file knows the mount of this wrist camera",
                got=f"known mounts: {sorted(mounted)}",
            )
        pose = np.eye(4) if camera.T_base_camera is None else np.asarray(camera.T_base_camera, np.float64)
        if pose.shape not in ((4, 4), (frames, 4, 4)):
            raise DataError(
                "A camera pose has a wrong shape", where=view, expected=f"(4, 4) or ({frames}, 4, 4)", got=pose.shape
            )
        wrist = view != HEAD_VIEW and view not in mounted
        if wrist:
            forms[view] = pose.ndim
        poses[view] = np.repeat(pose[None], frames, axis=0) if wrist and pose.ndim == 2 else pose.reshape(-1, 4, 4)
    if len(set(forms.values())) > 1:
        raise DataError(
            "Wrist cameras are given in two ways", expected="a pose each, or a pose per frame each", got=forms
        )
    return poses, 2 in forms.values()
