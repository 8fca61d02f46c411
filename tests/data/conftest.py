from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode

HEIGHT, WIDTH, FRAMES, FPS = 32, 48, 9, 8.0
Sample = tuple[Episode, dict[str, np.ndarray], dict[str, np.ndarray]]


def make_sample(
    number: int = 0,
    *,
    num_frames: int = FRAMES,
    views: tuple[str, ...] = VIEWS,
    height: int = HEIGHT,
    width: int = WIDTH,
    **changes: object,
) -> Sample:
    """A smooth synthetic episode of ur5e_pair: (episode, frames, robot masks)."""
    rng = np.random.default_rng(number)
    time = np.arange(num_frames) / FPS
    rows, columns = np.mgrid[:height, :width]
    frames, masks = {}, {}
    for k, view in enumerate(views):
        shift = (columns * 3 + rows * 2 + 8 * np.arange(num_frames)[:, None, None] + 40 * k + 9 * number) % 200
        frames[view] = np.stack([shift, 220 - shift, np.full_like(shift, 90 + 10 * k)], axis=-1).astype(np.uint8)
        masks[view] = shift < 60
    state = (0.3 * np.sin(time[:, None] + rng.uniform(0, 6, 14)[None])).astype(np.float32)
    state[:, [6, 13]] = np.abs(state[:, [6, 13]])
    K = np.array([[40.0 + number, 0.5, (width - 1) / 2], [0.0, 41.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    moving = np.tile(np.eye(4), (num_frames, 1, 1))
    moving[:, :3, :3] = Rotation.from_euler("z", 0.1 * time[:, None]).as_matrix()
    moving[:, 0, 3] = 0.05 * time + 1 / 3
    cameras = {v: CameraTrack(v, K, moving[:1] if v == "head" else moving, width, height) for v in views}
    values: dict[str, object] = {
        "episode_id": f"episode-{number:03d}", "source": "synthetic", "embodiment": "ur5e_pair", "scene": f"scene-{number}",
        "task_family": "lift", "instruction": f"lift block {number % 2}", "outcome": "success", "split": "train", "fps": FPS,
        "state": state, "action": state + np.float32(0.01), "timestamps": time, "cameras": cameras,
        "state_names": tuple(f"{a}/{n}" for a in ("left", "right") for n in (*(f"j{i}" for i in range(6)), "gripper")),
    }  # fmt: skip
    return Episode(**(values | changes)), frames, masks  # type: ignore[arg-type]
