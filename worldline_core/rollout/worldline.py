"""A trained world model with its tokenizer: what the cameras see now and controls in, what they will see out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.action_maps import ControlDrawing
from worldline_core.actions.episode_tracks import EpisodeTracks, collate_tracks, drawn_size
from worldline_core.errors import CheckpointError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import CheckpointInfo, CheckpointKind, load_checkpoint
from worldline_core.model.pretrained import load_model_tokenizer, pretrained_folder
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.tokenizers import VideoTokenizer, require_device
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import match_views
from worldline_core.processor import bfloat16_by_default
from worldline_core.rollout.observation import Camera, check_controls, real_numbers, require_drivable
from worldline_core.rollout.samplers import FULL_STEPS, BlockCausalSimulator, FullClipSampler, Noise, sigmas_causal
from worldline_core.rollout.simulation import USUAL_CLIP_FRAMES, Frames, Session, Simulation, Starts
from worldline_core.store.artifact_files import verify_artifact


class WorldLine:
    """Predicts videos with a Stage II model (a whole clip at once) or a causal one (block by block).

    ``WorldLine.from_pretrained(folder).predict(images, controls, cameras, embodiment="ur5e_pair")``

    Attributes:
        views: of the largest set that it was trained on together.
        view_sets: all such sets; a prediction shows the views of one of them.
        contract: what the controls mean: their rate (``fps``), how they are drawn, the grid of the latents.
        causal: blocks, window and nodes of a causal model; None for Stage II, which predicts a clip at once.
        steps: Euler steps per block, or of the whole clip.
        frames_per_unit: a prediction has 1 + k times this many frames (k blocks, or k latent frames).
        image_size: (H, W) of the predicted frames.
        needs_cameras: controls are drawn into every view; a model that also takes control vectors does without some or all cameras.
        vector_robots: robots whose control vectors it knows.
    """

    def __init__(
        self,
        model: WorldModel,
        info: CheckpointInfo,
        tokenizer: VideoTokenizer,
        *,
        device: str = "cpu",
        bfloat16: bool | None = None,
        steps: int | None = None,
        shift: float = 1.0,
        clip_frames: int | None = None,
    ) -> None:
        self.model = model.to(device).eval().requires_grad_(False)
        self.info = info
        self.tokenizer = tokenizer
        self.device = device
        self.bfloat16 = bfloat16_by_default({"device": device}) if bfloat16 is None else bfloat16
        self.views, self.view_sets = info.views, info.view_sets
        self.needs_cameras, self.takes_maps = info.vectors is None, info.config.takes_maps
        self.vector_robots = () if info.vectors is None else info.vectors.embodiments
        self.contract = info.contract
        self.causal = info.causal
        if self.causal is not None:
            self.causal = self.causal.model_copy(update={"sigmas": sigmas_causal(self.causal, steps)})
        self.steps = (steps or FULL_STEPS) if self.causal is None else self.causal.steps
        self.shift = shift
        self.clip_frames = clip_frames
        block = 1 if self.causal is None else self.causal.block_size
        self.frames_per_unit = tokenizer.temporal_compression * block
        rows, columns = self.contract.grid_size
        self.image_size = (rows * tokenizer.spatial_compression, columns * tokenizer.spatial_compression)

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str,
        *,
        tokenizer: Path | str | None = None,
        decoder: Path | str | None = None,
        expect_kind: Literal["stage2", "causal"] | None = None,
        device: str = "cpu",
        bfloat16: bool | None = None,
        weights: Literal["float32", "bfloat16"] = "float32",
        compiled: bool = False,
        steps: int | None = None,
        shift: float = 1.0,
        clip_frames: int | None = None,
    ) -> WorldLine:
        """Load a Stage II or causal checkpoint and the tokenizer that it was trained with.

        Args:
            folder: of the checkpoint, or ORG/NAME of the hub (safetensors and JSON files are fetched, nothing else).
            tokenizer: its folder; by default ``tokenizer`` in the checkpoint's folder or beside it, or, of an artifact, that
                of its store.
            decoder: folder of a small decoder for its latents (train_tokenizer), which decodes in the tokenizer's place.
            expect_kind: refuse checkpoints of another kind.
            bfloat16: mixed precision of the model and the decoder; None: true, except on a processor without native bfloat16.
            weights: of the model, and of a Wan autoencoder, in memory; in bfloat16 no copy in float32 ever exists.
            compiled: torch.compile of each layer but its attention: faster on a GPU after a minute at the first step.
            steps: Euler steps; by default those of the causal model, 35 for a Stage II model.
            shift: of a Stage II model's noise levels towards noise (1: even steps, as in the paper).
            clip_frames: of a Stage II model, frames of the longest clip predicted at once (1 + 4 k); longer predictions are
                chained. None: all at once.

        Raises:
            ArtifactError: files of an artifact differ from its manifest.
            CheckpointError: a folder is not what it should be, or tokenizer or decoder are not the model's.
            UnavailableError: the hub does not give it, or the device is not there.
            ConfigError: fewer than one step.
        """
        require_device(device)
        folder = pretrained_folder(folder)
        for name, place in (("Model", folder), ("Decoder", decoder)):
            if place is not None:
                verify_artifact(Path(place), what=name)  # the tokenizer is compared by its fingerprint
        kinds: tuple[CheckpointKind, ...] = ("stage2", "causal") if expect_kind is None else (expect_kind,)
        model, info = load_checkpoint(folder, expect_kind=kinds, towers="generation", dtype=getattr(torch, weights))
        codec, fingerprint, _ = load_model_tokenizer(info, folder, tokenizer, device, getattr(torch, weights))
        if decoder is not None:
            codec = SmallDecoder.load(Path(decoder), codec, fingerprint, device)
        if compiled:
            model.compile_blocks()
        if bfloat16 is None:
            bfloat16 = bfloat16_by_default({"device": device, "weights": weights})
        return cls(
            model, info, codec, device=device, bfloat16=bfloat16, steps=steps, shift=shift, clip_frames=clip_frames
        )  # fmt: skip

    def predict(
        self,
        images: Mapping[str, np.ndarray],
        controls: np.ndarray,
        cameras: Mapping[str, Camera],
        *,
        embodiment: str | Path,
        seed: int = 42,
    ) -> dict[str, np.ndarray]:
        """Videos of every given view under these controls; the same arguments give the same bytes on a CPU.

        Args:
            images: what each view sees now, ``uint8 (H, W, 3)`` RGB, all of one size: of the views of one of ``view_sets``.
            controls: ``(frames, state size)`` in the embodiment's layout (for each arm joints [rad], then the gripper's
                opening, 0 closed .. 1 open), at ``contract.fps`` frames per second. Row 0 belongs to the images.
            cameras: of the same views. A model that knows the robot's control vectors takes these in views without a camera.
            embodiment: name or YAML file of the robot.

        Returns:
            ``uint8 (frames, H, W, 3)`` per view, the observed frame first, at ``image_size``.

        Raises:
            DataError: the model was not trained on these views together, or needs the camera of one, a shape does not fit, the
                number of frames is not 1 + k whole units, or controls are in another unit.
            CalibrationError: a camera cannot be used.
            ConfigError: there is no such embodiment.
        """
        views = self.chosen_views(images)
        rows, unit = real_numbers(controls, "controls"), self.frames_per_unit
        if len(rows) <= unit or (len(rows) - 1) % unit:
            raise DataError(
                "The model predicts one observed frame and whole units", expected=f"1 + k * {unit} rows of controls",
                got=len(rows), next_step=f"give {1 + max(1, (len(rows) - 1) // unit) * unit} rows",
            )  # fmt: skip
        kinematics = ArmKinematics(load_embodiment(embodiment))
        require_drivable(self.info, views, cameras, kinematics.embodiment.name)
        check_controls(kinematics, rows, "controls")
        starts = Starts(images, cameras, kinematics, rows[0], seed)
        tracks, first = starts.project(0, rows, self.contract.fps), starts.pictures(views, self.image_size)
        pieces = [clips[0] for clips in self.stream(first, [tracks], len(rows), starts.seeds, views=views)]
        return {view: np.concatenate([piece[view] for piece in pieces]) for view in views}

    def start(
        self,
        images: Mapping[str, np.ndarray] | Sequence[Mapping[str, np.ndarray]],
        cameras: Mapping[str, Camera] | Sequence[Mapping[str, Camera]],
        *,
        embodiment: str | Path | ArmKinematics,
        state: np.ndarray,
        seed: int | Sequence[int] = 42,
        limits: bool = True,
        earlier: Sequence[np.ndarray] | None = None,
    ) -> Simulation:
        """A simulation that a policy drives from these images on, step by step.

        Args:
            images, cameras: as of :meth:`predict`, of one start or a list of starts that share robot, views and image size.
            embodiment: name or YAML file of the robot, or its kinematics.
            state: ``(state size)`` or ``(starts, state size)``, the controls that belong to the images.
            seed: of the noise, one for all starts or each.
            limits: hold commands within the embodiment's limits before they are drawn. Without, and with commands within
                them, the bytes are those of :meth:`predict` (of a Stage II model: with ``clip_frames``, 33 if not given).
            earlier: to begin in the middle of a recording: the commands ``(n, state size)`` of each start from ``state``, to which
                the cameras' poses belong, to the frame of the images.

        Raises:
            DataError, CalibrationError, ConfigError: as :meth:`predict`.
        """
        starts = Starts(images, cameras, embodiment, state, seed, earlier)
        views = self.chosen_views(starts.images[0])
        for given in starts.cameras:
            require_drivable(self.info, views, given, starts.kinematics.embodiment.name)
        frames = self.unit(USUAL_CLIP_FRAMES)
        # Rows of the tracks of a step: the start, the last known frame, the new ones.
        index = range(1, frames + 2, self.tokenizer.temporal_compression)
        maps = partial(self.action_maps, frames=index, views=views)
        session = self.session(starts.pictures(views, self.image_size), starts.seeds, views)
        return Simulation(
            session, starts, self.contract, maps, views=views, image_size=self.image_size, frames=frames, limits=limits
        )

    def chosen_views(self, given: Iterable[str] | None) -> tuple[str, ...]:
        """One of ``view_sets`` with exactly the given views, by default the largest; raises as `match_views`."""
        return self.views if given is None else match_views(self.view_sets, given)

    def stream(
        self,
        images: Float[Tensor, "b v 3 height width"],
        tracks: Sequence[EpisodeTracks],
        frames: int,
        seeds: Sequence[int],
        *,
        views: Sequence[str] | None = None,
        stride: int = 1,
        without_actions: bool = False,
        by_vector: bool = False,
    ) -> Iterator[Frames]:
        """Videos of a batch of any length, piece by piece: the observed frame, then what each step predicts.

        Args:
            images: first frames in [-1, 1] at ``image_size``.
            tracks: controls from the observed frame on; where they end early, the last ones stay.
            frames: length of the predictions. The last step predicts a whole unit, which is cut there.
            seeds: of each clip's noise, which does not depend on who shares the batch.
            views: names of the views in ``images``, one of ``view_sets`` in any order; by default the largest.
            stride: predicted frames are those of every ``stride``-th control.
            without_actions: with controls of zeros, which are none.
            by_vector: every view takes control vectors, as if no camera were known.

        Yields:
            Of every clip, ``uint8 (n, H, W, 3)`` by view.

        Raises:
            CheckpointError: the model was not trained at this stride.
        """
        if stride not in self.info.strides:
            raise CheckpointError(
                "The model was not trained at this stride", expected=self.info.strides, got=stride,
                next_step="roll out at a trained stride, or train with clips.strides",
            )  # fmt: skip
        chosen = self.views if views is None else tuple(views)
        session = self.session(images, seeds, chosen, stride)
        yield session.observed
        unit = self.unit(frames)
        begins = range(0, frames - 1, unit)

        def controls(begin: int) -> Tensor:
            index = [stride * frame for frame in range(begin, begin + unit + 1, self.tokenizer.temporal_compression)]
            maps = self.action_maps(tracks, index, views=chosen, stride=stride, by_vector=by_vector)
            return torch.zeros_like(maps) if without_actions else maps

        for begin, clips in zip(begins, session.steps(map(controls, begins)), strict=True):
            yield [{view: video[: frames - 1 - begin] for view, video in clip.items()} for clip in clips]

    def session(
        self,
        images: Float[Tensor, "b v 3 height width"],
        seeds: Sequence[int],
        views: Sequence[str] | None = None,
        stride: int = 1,
    ) -> Session:
        """A running prediction that begins at these images, to be driven unit by unit; arguments as of :meth:`stream`."""
        chosen = self.views if views is None else tuple(views)
        match_views(self.view_sets, chosen)
        shown = {"noise": Noise(seeds), "views": chosen, "fps": self.contract.fps / stride, "bfloat16": self.bfloat16}
        if self.causal is not None:
            sampler = BlockCausalSimulator(self.model, self.causal, **shown)
        else:
            sampler = FullClipSampler(self.model, steps=self.steps, shift=self.shift, **shown)
        return Session(sampler, self.tokenizer, images, device=self.device, bfloat16=self.bfloat16)

    def unit(self, frames: int) -> int:
        """Frames that a step of a prediction of ``frames`` frames adds: a block, or a clip without its first frame."""
        if self.causal is not None:
            return self.frames_per_unit
        longest = frames if self.clip_frames is None else min(frames, self.clip_frames)
        return -(-(longest - 1) // self.frames_per_unit) * self.frames_per_unit

    def action_maps(
        self,
        tracks: Sequence[EpisodeTracks],
        frames: Sequence[int],
        *,
        views: Sequence[str],
        stride: int = 1,
        by_vector: bool = False,
    ) -> Float[Tensor, "b v a t h w"]:
        """Controls of the latent frames at these recorded frames, drawn as of a clip that begins at the first of them; past the end
        of a track its last controls stay. Views without a camera take vectors; with ``by_vector`` all do.
        """
        cut = []
        count, native = self.info.config.action_frames, self.info.config.native_size
        for track in tracks:
            # Of every latent frame, and of those between it and the one before: `control_frames`.
            drawn = [max(frames[0], frame - stride * back) for frame in frames for back in range(count)]
            cut.append(track.clip([min(frame, track.num_frames - 1) for frame in drawn]))
        drawing = ControlDrawing(self.contract.grid_size, self.contract.sigma_px_ref, native, count)
        chosen = torch.full((len(cut), len(views)), by_vector)
        return drawing.draw(collate_tracks(cut, views, native), drawn_size(cut), chosen).to(self.device)
