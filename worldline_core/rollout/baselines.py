"""Predictors to compare with: the copy of the first frame, text to video, and another simulator behind HTTP.

Text to video is the paper's baseline without actions: a Stage I model (or the pretrained backbone) driven by text. Each view is a
video of its own, in the slot that Stage I trains.

GE-Sim 2.0's protocol is written against its description (github.com/AgibotTech/GE-Sim-V2: docs/replay.md and
docs/adding_world_models.md). Bodies are JSON, or sections, each after its length in four bytes, big-endian, the last one JSON. A
frame is one JPEG with the views side by side; numbers are float32, little-endian. The server is driven by absolute joint targets
of two arms of seven joints (AgiBot G1), at most 25 a step, and by a picture of the tools for every frame and view (its "band"): a
disc at each tool, larger the nearer the camera, darker the wider closed, and three lines of 10 cm along the tool's axes.

Axes: t frames, v views, a arms (left, right).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.config import validate
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.plain_files import decode_image
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import CheckpointError, ConfigError, DataError, UnavailableError
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.http_exchange import IncompleteResponseError, UnreachableError, exchange
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.text import ClipFacts, load_text_encoder
from worldline_core.model.tokenizers import load_tokenizer, resized_frames, tokenizer_fingerprint, video_to_frames
from worldline_core.model.world_model_config import TextConfig
from worldline_core.rollout.predictions import Prediction
from worldline_core.rollout.rollout_config import GeSimConfig, RolloutConfig, TextToVideoConfig
from worldline_core.rollout.samplers import Noise, rollout_full_clip
from worldline_core.rollout.simulation import Frames, encode_images
from worldline_core.untrusted_text import cut

_COPIED_AT_ONCE = 64


def recorded_size(episodes: EpisodeSet) -> tuple[int, int]:
    """(H, W) of the recordings' pictures."""
    height, width = episodes.frames(0, episodes.rows[0].views[0], [0]).shape[1:3]
    return height, width


class FirstFrameCopy:
    """Every predicted frame is the observed one, at the size of the recordings."""

    steps = None
    views: tuple[str, ...] = VIEWS
    view_sets = None
    frames_per_unit = TEMPORAL_FACTOR
    takes_maps = False
    vector_robots: tuple[str, ...] | None = None

    def __init__(self, episodes: EpisodeSet) -> None:
        self.image_size = recorded_size(episodes)

    def unit(self, frames: int) -> int:
        return 1

    def stream(self, images: Float[Tensor, "b v 3 h w"], batch: Sequence[Prediction]) -> Iterator[Frames]:
        """Copies of the images, piece by piece."""
        views, frames = batch[0].views, max(item.frames for item in batch)
        clips = [{view: video_to_frames(first[v, :, None]) for v, view in enumerate(views)} for first in images]
        for begin in range(0, frames, _COPIED_AT_ONCE):
            count = min(_COPIED_AT_ONCE, frames - begin)
            yield [{view: np.repeat(still, count, axis=0) for view, still in clip.items()} for clip in clips]


class TextToVideo:
    """Predicts each view from its first image and the episode's instruction, the whole clip at once.

    Raises:
        CheckpointError: the checkpoint is no base or Stage I model with both towers, or of another tokenizer.
        ConfigError: nothing states how text is read, or the recordings' pictures do not divide into patches.
    """

    takes_maps = False
    vector_robots: tuple[str, ...] | None = None
    view_sets = None

    def __init__(
        self,
        config: RolloutConfig,
        sampler: TextToVideoConfig,
        checkpoint: Path,
        tokenizer: Path,
        episodes: EpisodeSet,
    ) -> None:
        dtype = getattr(torch, config.weights)
        model, self.info = load_checkpoint(checkpoint, expect_kind=("base", "stage1"), towers="both", dtype=dtype)
        self.model = model.to(config.device).eval().requires_grad_(False)
        self.tokenizer = load_tokenizer(tokenizer, config.device, dtype)
        found, trained = tokenizer_fingerprint(self.tokenizer, tokenizer), self.info.metadata.get("tokenizer")
        if trained not in (None, found):
            raise CheckpointError(
                "The model was trained on another tokenizer's latents", where=tokenizer, expected=trained, got=found
            )
        if sampler.decoder is not None:
            self.tokenizer = SmallDecoder.load(sampler.decoder, self.tokenizer, found, config.device)
        stated = self.info.metadata.get("text")
        if sampler.text is None and stated is None:
            raise ConfigError(
                "Nothing says how this model reads text",
                where=f"{checkpoint}, rollout.sampler.text",
                expected="kind cosmos3 and the path of the backbone's text tokenizer, or kind bytes",
                next_step="set text in the rollout's sampler",
            )
        text = sampler.text or validate(TextConfig, stated or {}, where=f"{checkpoint}, metadata.text")
        self.text = load_text_encoder(text, self.info.config)
        self.views = tuple(self.info.config.views)
        self.steps = sampler.steps
        self.frames_per_unit = self.tokenizer.temporal_compression
        self.image_size = recorded_size(episodes)
        cell = self.tokenizer.spatial_compression * self.info.config.patch_size
        if any(side % cell for side in self.image_size):
            raise ConfigError(
                "The recordings' pictures do not divide into the model's patches",
                where=episodes.root,
                expected=f"multiples of {cell} pixels",
                got=self.image_size,
                next_step="curate them at such a size (curate.image_size)",
            )
        self._config, self._sampler, self._episodes = config, sampler, episodes

    def unit(self, frames: int) -> int:
        """A prediction is as long as its frames, in whole latent frames."""
        return self.frames_per_unit

    @torch.no_grad()
    def stream(self, images: Float[Tensor, "b v 3 h w"], batch: Sequence[Prediction]) -> Iterator[Frames]:
        """Videos of a batch, in one piece."""
        config, device, frames = self._config, self._config.device, max(item.frames for item in batch)
        rows = [self._episodes.rows[item.position] for item in batch]
        latent_frames = 1 + -(-(frames - 1) // self.frames_per_unit)
        length, fps = 1 + (latent_frames - 1) * self.frames_per_unit, rows[0].fps / config.stride
        ids, mask = self.text([row.instruction for row in rows], [ClipFacts(length, fps, self.image_size)] * len(rows))
        images = images.to(device)
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
            text = self.model.encode_text(ids.to(device), mask.to(device))
        first = encode_images(self.tokenizer, images)
        clips: Frames = [{} for _ in rows]
        for number, view in enumerate(batch[0].views):
            latents = rollout_full_clip(
                self.model, first[:, number : number + 1], None, noise=Noise([item.seed for item in batch]),
                steps=self.steps, shift=self._sampler.shift, frames=latent_frames, views=self.views[:1], text=text, fps=fps,
                bfloat16=config.bfloat16,
            )  # fmt: skip
            with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
                for clip, one, observed in zip(clips, latents, images, strict=True):
                    video = self.tokenizer.decode(one, rearrange(observed[number], "c h w -> 1 c h w"))
                    clip[view] = video_to_frames(video[0])[:frames]
        yield clips


CHUNK = 25
REPLAYED = 2 * CHUNK
"""From this many frames on the server takes a band as the whole episode's, and remembers its earlier parts."""
ACTIONS, GRIPPERS = 16, (7, 15)
_JPEG_QUALITY, _MAX_JSON_BYTES = 95, 1 << 16
_PATIENCE = 3
"""Refused predictions in a row after which the server counts as out of order."""
_BACKGROUND, _AXIS_M, _AXIS_WIDTH = 50, 0.1, 8
_TOOL_OFFSET_M = 0.15
"""From the end link of an arm to the tool, along its z."""
# The sequential maps "Greens" and "Reds" of ColorBrewer, from light to dark.
_DISC = (
    np.array([(247, 252, 245), (229, 245, 224), (199, 233, 192), (161, 217, 155), (116, 196, 118), (65, 171, 93),
              (35, 139, 69), (0, 109, 44), (0, 68, 27)]),
    np.array([(255, 245, 240), (254, 224, 210), (252, 187, 161), (252, 146, 114), (251, 106, 74), (239, 59, 44),
              (203, 24, 29), (165, 15, 21), (103, 0, 13)]),
)  # fmt: skip
_AXES = (((0, 0, 255), (255, 255, 0), (0, 255, 255)), ((255, 0, 255), (255, 0, 0), (0, 255, 0)))
"""Colours of the lines along x, y and z, of the left and the right tool."""


class RefusedPredictionError(DataError):
    """One prediction cannot be made, others may be; ``reason`` is its code in the quarantine."""

    reason = "simulator_failed"


class GeSim:
    """One session with a server.

    Raises:
        UnavailableError: there is no such server.
    """

    steps = None
    views: tuple[str, ...] = VIEWS
    view_sets: tuple[tuple[str, ...], ...] = (VIEWS,)
    frames_per_unit = 4
    takes_maps = True
    vector_robots: tuple[str, ...] | None = ()

    def __init__(self, config: GeSimConfig, episodes: EpisodeSet, tracks: ActionTracks, stride: int) -> None:
        self.image_size = recorded_size(episodes)
        self._config, self._episodes, self._tracks, self._stride = config, episodes, tracks, stride
        self._url = config.url.rstrip("/")
        self._refused = 0
        self._post("/healthz", None)
        answer = self._post("/init", b'{"user_name": "worldline"}')
        try:
            self._client = str(json.loads(answer)["client_id"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise self._unusable("/init", f"no client_id in its answer: {error!r}") from error

    def unit(self, frames: int) -> int:
        return 1

    def close(self) -> None:
        try:
            self._post("/close", self._body())
        except (UnavailableError, RefusedPredictionError):
            return  # the predictions are complete

    def stream(self, images: Float[Tensor, "1 v 3 h w"], batch: Sequence[Prediction]) -> Iterator[Frames]:
        """Frames of one prediction, the observed one first; the protocol has no seeds.

        Raises:
            RefusedPredictionError: the server cannot make this one.
            UnavailableError: the server cannot be used.
        """
        (item,), size, stride = batch, self._config.image_size, self._stride
        controls = self._tracks.tracks(item.controls_of)
        if controls.native is None or controls.controls == "ee_pose" or controls.native.shape[1] != ACTIONS:
            error = RefusedPredictionError(
                "GE-Sim is driven by joint targets of two arms of seven joints and a gripper each",
                where=f"episode {controls.episode_id}, embodiment {controls.embodiment}",
                expected=f"{ACTIONS} numbers a frame",
                got=f"{controls.controls} of {None if controls.native is None else controls.native.shape[1]} numbers",
            )
            error.reason = "unsupported_controls"
            raise error
        observed = rearrange((images[0] + 1) * 127.5, "v c h w -> v h w c").round().clamp(0, 255).byte().numpy()
        yield [{view: picture[None] for view, picture in zip(item.views, observed, strict=True)}]
        K = ImageTransform.of(controls.image_size).resize(size).intrinsics(controls.K)
        cameras = controls.clip([0]).T_base_camera[0]
        self._post("/reset", self._body())
        self._post("/set_task", self._body(task=self._episodes.rows[item.position].instruction))
        self._post("/set_camera_params", self._body(intrinsic=K.tolist(), extrinsic=cameras.tolist()))
        picture = _jpeg(resized_frames(observed, size))
        self._post("/set_episode_data", self._body(picture, frame_shape=[3, len(observed), *size]))
        shown = controls.clip(range(stride, item.frames * stride, stride))
        if whole := item.frames - 1 >= REPLAYED:
            self._condition(shown, K)
        for start in range(0, item.frames - 1, CHUNK):
            chunk = shown.clip(range(start, min(start + CHUNK, item.frames - 1)))
            if not whole:
                self._condition(chunk, K)
            actions = chunk.native.astype(np.float32)  # type: ignore[union-attr]
            actions[:, GRIPPERS] = 1 - chunk.gripper[:, 0]  # the server counts 0 open, 1 closed
            found = self._step(actions)
            frames = np.ascontiguousarray(found.swapaxes(0, 1))
            yield [{v: resized_frames(f, self.image_size) for v, f in zip(item.views, frames, strict=True)}]

    def _condition(self, tracks: EpisodeTracks, K: np.ndarray) -> None:
        """Send the pictures of the tools and the camera poses of the coming frames."""
        band = tool_band(tracks, K, self._config.image_size)
        poses = tracks.T_base_camera.swapaxes(0, 1)
        shape = [3, band.shape[1], band.shape[0], *band.shape[2:4]]
        sections = [_packed(_jpeg(views) for views in band), _floats(poses)]
        self._post("/set_episode_traj", self._body(*sections, traj_shape=shape, c2w_shape=poses.shape))

    def _step(self, actions: np.ndarray) -> np.ndarray:
        """Frames of the next actions (t, 16), uint8 (t, v, H, W, 3)."""
        size, views = self._config.image_size, len(self.views)
        # A JPEG is never much larger than its pixels.
        most = _MAX_JSON_BYTES + 6 * len(actions) * views * math.prod(size) + 4 * CHUNK * ACTIONS
        answer = self._post("/step", self._body(_floats(actions), action_shape=actions.shape), most)
        try:
            _, *pictures, _ = _sections(answer)  # between JSON and the state
            if len(pictures) != len(actions):
                raise ValueError(f"{len(pictures)} frames for {len(actions)} actions")
            frames = [_views(picture, size, views) for picture in pictures]
        except (ValueError, RejectedInputError) as error:
            raise self._refusal("/step", str(error)) from error
        self._refused = 0
        return np.stack(frames)

    def _body(self, *sections: bytes, **values: object) -> bytes:
        meta = json.dumps({"client_id": self._client, **values}).encode()
        return _packed([*sections, meta]) if sections else meta

    def _post(self, path: str, body: bytes | None, most: int = _MAX_JSON_BYTES) -> bytes:
        kind = "application/json" if body is None or body.startswith(b"{") else "application/octet-stream"
        headers = {"Content-Type": kind, "Accept-Encoding": "identity"}
        try:
            status, answer = exchange(
                self._url + path, body, headers=headers, timeout_s=self._config.timeout_s, max_bytes=most
            )
        except (UnreachableError, IncompleteResponseError) as error:
            raise self._unusable(path, str(error)) from error
        if status != 200:
            refuses = self._refusal if status in (400, 500) else self._unusable  # these two understood the request
            raise refuses(path, f"HTTP {status}: {answer.decode(errors='replace')}")
        if len(answer) > most:
            raise self._refusal(path, f"an answer of more than {most:,} bytes")
        return answer

    def _refusal(self, path: str, reason: str) -> RefusedPredictionError | UnavailableError:
        self._refused += 1
        if self._refused >= _PATIENCE:
            return self._unusable(path, f"{_PATIENCE} refusals in a row, the last one: {reason}")
        return RefusedPredictionError("The simulator refused", where=self._url + path, got=cut(reason, 500))

    def _unusable(self, path: str, reason: str) -> UnavailableError:
        return UnavailableError(
            "The simulator's server cannot be used",
            where=self._url + path,
            expected="a server of GE-Sim 2.0's protocol, and no other client of it meanwhile",
            got=cut(reason, 500),
            next_step="start it, check sampler.url and sampler.timeout_s, and run again: finished predictions are kept",
        )


def tool_band(tracks: EpisodeTracks, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pictures of the tools, uint8 (t, v, H, W, 3) RGB, for K (v, 3, 3) in pixels of ``size``.

    A tool behind the camera or outside of the picture is not drawn. The distance of the end link decides the size of the disc.
    """
    T_camera_tool = np.linalg.inv(tracks.T_base_camera)[:, :, None] @ tracks.T_base_tool[:, None].astype(np.float64)
    ends = np.array([[0, 0, 0, 1], [_AXIS_M, 0, 0, 1], [0, _AXIS_M, 0, 1], [0, 0, _AXIS_M, 1]]).T
    points = (T_camera_tool @ ends)[..., :3, :]  # t v a 3 4: the tool, and the ends of its axes
    depth = points[..., 2, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (K[:, None] @ points)[..., :2, :] / depth[..., None, :]
    link = (T_camera_tool @ np.array([0, 0, -_TOOL_OFFSET_M, 1]))[..., :3]
    radius = np.clip(1 - np.linalg.norm(link, axis=-1) - 0.07 / (0.8 - 0.07), 0, 1) * 100
    closed = ((1 - tracks.gripper[:, 0]) * (120 - 35) + 35) / 120
    band = np.full((*depth.shape[:2], *size, 3), _BACKGROUND, np.uint8)
    for (t, v), picture in zip(np.ndindex(*depth.shape[:2]), rearrange(band, "t v h w c -> (t v) h w c"), strict=True):
        inside = [bool(((pixel >= 0) & (pixel < size[::-1])).all()) for pixel in pixels[t, v, :, :, 0]]
        drawn = [arm for arm in range(2) if depth[t, v, arm, 0] > 0 and inside[arm]]
        for arm in drawn:
            place = np.clip(closed[t, arm], 0, 1) * (len(_DISC[arm]) - 1)
            colour = [int(np.interp(place, range(len(_DISC[arm])), channel)) for channel in _DISC[arm].T]
            cv2.circle(picture, _point(pixels[t, v, arm, :, 0]), int(radius[t, v, arm]), colour, -1)
        for arm in drawn:
            for axis, colour in enumerate(_AXES[arm], start=1):
                if depth[t, v, arm, axis] > 0:
                    start, stop = (_point(pixels[t, v, arm, :, end]) for end in (0, axis))
                    cv2.line(picture, start, stop, colour, _AXIS_WIDTH)
    return band


def _point(pixel: np.ndarray) -> tuple[int, int]:
    """Whole pixels; those far outside, where an axis points at the camera, are brought near."""
    x, y = np.clip(pixel, -1e4, 1e4)
    return int(x), int(y)


def _floats(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values, "<f4").tobytes()


def _jpeg(views: np.ndarray) -> bytes:
    """One JPEG of views uint8 (v, H, W, 3), side by side."""
    picture = np.concatenate(list(views), axis=1)[..., ::-1]
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _views(content: bytes, size: tuple[int, int], views: int) -> np.ndarray:
    """Views uint8 (v, H, W, 3) of an untrusted JPEG."""
    expected, picture = (size[0], views * size[1]), decode_image(content, "a frame")
    if (found := picture.shape[:2]) != expected:
        raise ValueError(f"a frame of {found[0]} x {found[1]} pixels, not of {expected[0]} x {expected[1]}")
    return np.stack(np.split(picture, views, axis=1))


def _packed(sections: Iterable[bytes]) -> bytes:
    return b"".join(len(section).to_bytes(4, "big") + section for section in sections)


def _sections(content: bytes) -> list[bytes]:
    sections, position = [], 0
    while position < len(content):
        start = position + 4
        position = start + int.from_bytes(content[position:start], "big")
        if position > len(content) or start > len(content):
            raise ValueError(f"section {len(sections)} breaks off: {position - len(content)} bytes are missing")
        sections.append(content[start:position])
    return sections
