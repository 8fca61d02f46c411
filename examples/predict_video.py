"""Predict the camera pictures of a robot that follows given controls, from one observation, as a video file.

Takes the first image of each camera and the controls of a shipped held-out recording, and writes the recorded head view
beside the predicted one.

Run: python examples/predict_video.py [--episode ID] [--model causal|stage2] [--steps N] [--output prediction.mp4]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.encoder import encode_video
from worldline_core.model.tokenizers import resize_frame
from worldline_core.shipped import shipped_folder


def main() -> None:
    """Predict one shipped recording and write the video."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episode", default="ur5e_silver-test-s1-00000")
    parser.add_argument("--model", choices=("causal", "stage2"), default="causal")
    parser.add_argument("--steps", type=int, help="Euler steps; by default the model's own")
    parser.add_argument("--frames", type=int, default=33, help="length of the video: 1 + whole blocks of the model")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--output", type=Path, default=Path("prediction.mp4"))
    arguments = parser.parse_args()

    recordings = EpisodeSet.open(shipped_folder() / "recordings")
    position = [row.episode_id for row in recordings.rows].index(arguments.episode)
    recording = recordings.episode(position)
    views = tuple(recording.cameras)
    images = {view: recordings.frames(position, view, [0])[0] for view in views}
    # The head camera stands still; where the wrist cameras are follows from the arms, whose mounts the robot's file knows.
    cameras = {view: Camera(camera.K) for view, camera in recording.cameras.items()}
    cameras["head"] = Camera(recording.cameras["head"].K, recording.cameras["head"].T_base_camera[0])

    world = WorldLine.from_pretrained(shipped_folder() / "models" / arguments.model, steps=arguments.steps)
    controls = recording.action[: arguments.frames]
    predicted = world.predict(images, controls, cameras, embodiment=recording.embodiment, seed=arguments.seed)

    recorded = np.empty_like(predicted["head"])
    for frame, target in zip(recordings.frames(position, "head", range(len(controls))), recorded, strict=True):
        resize_frame(frame, world.image_size, out=target)
    encode_video(arguments.output, np.concatenate((recorded, predicted["head"]), axis=2), world.contract.fps)
    print(f"{arguments.output}: {len(controls)} frames, recorded on the left, predicted on the right")


if __name__ == "__main__":
    main()
