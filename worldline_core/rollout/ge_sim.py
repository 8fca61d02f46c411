"""Predictions of a GE-Sim 2.0 server as rollouts: what it is sent of our recordings, and what comes back.

It is driven by absolute joint targets of two arms of seven joints (AgiBot G1), and by a picture of the tools for every frame
and view (its "band"): a disc at each tool, larger the nearer the camera, darker the wider closed, and three lines of 10 cm
along the tool's axes. Its model was trained at 384 x 512.

Axes: t frames, v views, a arms (left, right).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.model.video_tokenizer import resize_frame
from worldline_core.rollout.ge_sim_client import CHUNK, GeSimClient, RefusedPredictionError
from worldline_core.rollout.rollout_config import GeSimConfig
from worldline_core.rollout.session import Frames

ACTIONS = 16
GRIPPERS = (7, 15)
"""Of an action: seven joints and the gripper of the left arm, then of the right one."""
REPLAYED = 2 * CHUNK
"""From so many frames on the server takes a band as the whole episode's, and remembers its earlier parts."""
_BACKGROUND = 50
_AXIS_M, _AXIS_WIDTH = 0.1, 8
# The sequential maps "Greens" and "Reds" of ColorBrewer, from light to dark.
_DISC = (
    np.array([(247, 252, 245), (229, 245, 224), (199, 233, 192), (161, 217, 155), (116, 196, 118), (65, 171, 93),
              (35, 139, 69), (0, 109, 44), (0, 68, 27)]),
    np.array([(255, 245, 240), (254, 224, 210), (252, 187, 161), (252, 146, 114), (251, 106, 74), (239, 59, 44),
              (203, 24, 29), (165, 15, 21), (103, 0, 13)]),
)  # fmt: skip
_AXES = (((0, 0, 255), (255, 255, 0), (0, 255, 255)), ((255, 0, 255), (255, 0, 0), (0, 255, 0)))
"""Colours of the lines along x, y and z, of the left and the right tool."""


class UnsupportedControlsError(RefusedPredictionError):
    """The controls are not those of two arms of seven joints."""

    reason = "unsupported_controls"


class GeSim:
    """A server's model, as `rollout` asks for predictions."""

    steps = causal = None
    views: tuple[str, ...] = VIEWS
    frames_per_unit = 4
    needs_cameras = True
    block_seconds = ()

    def __init__(self, config: GeSimConfig, episodes: EpisodeSet) -> None:
        height, width = episodes.frames(0, episodes.rows[0].views[0], [0]).shape[1:3]
        self.image_size = (height, width)
        self._config, self._episodes = config, episodes
        self._client = GeSimClient(config.url, config.timeout_s)

    def unit(self, frames: int) -> int:
        """Frames come one by one."""
        return 1

    def close(self) -> None:
        """End the session."""
        self._client.close()

    def stream(
        self,
        images: Float[Tensor, "1 v 3 h w"],
        tracks: Sequence[EpisodeTracks],
        frames: int,
        seeds: Sequence[int],
        *,
        views: Sequence[str],
        stride: int,
        without_actions: bool = False,
    ) -> Iterator[Frames]:
        """As :meth:`WorldLine.stream`, of one prediction; the protocol knows no seed.

        Raises:
            RefusedPredictionError: the server cannot make this one.
            UnavailableError: the server cannot be used.
        """
        del seeds, without_actions
        (controls,), size = tracks, self._config.image_size
        if controls.native is None or controls.controls == "ee_pose" or controls.native.shape[1] != ACTIONS:
            raise UnsupportedControlsError(
                "GE-Sim is driven by joint targets of two arms of seven joints and a gripper each",
                where=f"episode {controls.episode_id}, embodiment {controls.embodiment}",
                expected=f"{ACTIONS} numbers a frame",
                got=f"{controls.controls} of {None if controls.native is None else controls.native.shape[1]} numbers",
            )
        row = self._episodes.rows[self._episodes.position(controls.episode_id)]
        observed = rearrange((images[0] + 1) * 127.5, "v c h w -> v h w c").round().clamp(0, 255).byte().numpy()
        yield [{view: picture[None] for view, picture in zip(views, observed, strict=True)}]
        K = ImageTransform.of(controls.image_size).resize(size).intrinsics(controls.K)
        client, now = self._client, controls.clip([0])
        client.begin(row.instruction, K, now.T_base_camera[0], _resized(observed, size))
        shown = controls.clip(range(stride, frames * stride, stride))
        whole = frames - 1 >= REPLAYED
        if whole:
            client.condition(self._band(shown, K), shown.T_base_camera.swapaxes(0, 1))
        for start in range(0, frames - 1, CHUNK):
            chunk = shown.clip(range(start, min(start + CHUNK, frames - 1)))
            if not whole:
                client.condition(self._band(chunk, K), chunk.T_base_camera.swapaxes(0, 1))
            found = client.step(actions_of(chunk), size, len(views))
            yield [{view: _resized(found[:, v], self.image_size) for v, view in enumerate(views)}]

    def _band(self, tracks: EpisodeTracks, K: np.ndarray) -> np.ndarray:
        return tool_band(tracks, K, self._config.image_size, self._config.tool_offset_m)


def actions_of(tracks: EpisodeTracks) -> np.ndarray:
    """Joint targets (t, 16) [rad] with the grippers as the server counts them: 0 open, 1 closed."""
    assert tracks.native is not None  # noqa: S101  (checked where predictions begin)
    actions = tracks.native.astype(np.float32)
    actions[:, GRIPPERS] = 1 - tracks.gripper[:, 0]
    return actions


def tool_band(tracks: EpisodeTracks, K: np.ndarray, size: tuple[int, int], tool_offset_m: float) -> np.ndarray:
    """Pictures of the tools, uint8 (t, v, H, W, 3) RGB (GE-Sim-V2, docs/replay.md: "trajectory band").

    A tool behind the camera, or outside of the picture, is not drawn.

    Args:
        K: (v, 3, 3) in pixels of ``size``.
        tool_offset_m: from the end link, whose distance says how large the disc is, to the tool, along its z.
    """
    T_camera_tool = np.linalg.inv(tracks.T_base_camera)[:, :, None] @ tracks.T_base_tool[:, None].astype(np.float64)
    ends = np.array([[0, 0, 0, 1], [_AXIS_M, 0, 0, 1], [0, _AXIS_M, 0, 1], [0, 0, _AXIS_M, 1]]).T
    points = (T_camera_tool @ ends)[..., :3, :]  # t v a 3 4: the tool, and the ends of its axes
    depth = points[..., 2, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (K[:, None] @ points)[..., :2, :] / depth[..., None, :]
    link = (T_camera_tool @ np.array([0, 0, -tool_offset_m, 1]))[..., :3]
    radius = np.clip(1 - np.linalg.norm(link, axis=-1) - 0.07 / (0.8 - 0.07), 0, 1) * 100
    closed = ((1 - tracks.gripper[:, 0]) * (120 - 35) + 35) / 120
    band = np.full((*depth.shape[:2], *size, 3), _BACKGROUND, np.uint8)
    for (t, v), picture in zip(np.ndindex(*depth.shape[:2]), rearrange(band, "t v h w c -> (t v) h w c"), strict=True):
        drawn = [arm for arm in range(2) if depth[t, v, arm, 0] > 0 and _inside(pixels[t, v, arm, :, 0], size)]
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


def _inside(pixel: np.ndarray, size: tuple[int, int]) -> bool:
    return bool(0 <= pixel[0] < size[1] and 0 <= pixel[1] < size[0])


def _point(pixel: np.ndarray) -> tuple[int, int]:
    """Whole pixels; those far outside, where an axis points at the camera, are brought near."""
    x, y = np.clip(pixel, -1e4, 1e4)
    return int(x), int(y)


def _resized(pictures: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 (n, H, W, 3) at another size."""
    resized = np.empty((len(pictures), *size, 3), np.uint8)
    for picture, target in zip(pictures, resized, strict=True):
        resize_frame(np.ascontiguousarray(picture), size, out=target)
    return resized
