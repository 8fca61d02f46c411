"""Recordings of the shipped bodies before cameras that stand where the recorder never puts one, for estimating them.

    python -m benchmarks.hidden_cameras OUTPUT [--bodies ur5e_silver,...] [--episodes 20] [--seed 0]

One still camera for all episodes of a set, drawn around the workspace (any side, 20 to 65 degrees up, rolled a little, its
own focal length), and wrist cameras mounted some centimetres and degrees from where the description has them.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast
from unittest import mock

import numpy as np

from benchmarks.harness import command_line, read_recordings
from worldline_core.data.episodes.episode import Episode
from worldline_core.geometry.embodiment import Description, Embodiment, load_embodiment, read_description
from worldline_core.geometry.kinematic_tree import parse_xml
from worldline_core.recorder.bodies import BODIES, CENTRE, CameraMount
from worldline_core.recorder.record import SPLIT_STREAM
from worldline_core.recorder.rendering import SceneRenderer, prepare_rendering
from worldline_core.recorder.scene import TASKS
from worldline_core.recorder.simulate import SCENES, EpisodeRecorder, Job

NUM_FRAMES = 33
UPRIGHT_ROLL_DEG = 4.0


class HiddenCameras(EpisodeRecorder):
    """Records one body before cameras drawn from a seed."""

    def __init__(self, body: str, seed: int) -> None:
        random = np.random.default_rng([seed, BODIES[body].stream])
        wrist = BODIES[body].wrist
        moved = CameraMount(
            eye=tuple(np.array(wrist.eye) + random.normal(0, 0.012, 3)),
            target=tuple(np.array(wrist.target) + random.normal(0, 0.015, 3)),
            fovy_deg=float(random.uniform(52, 78)),
        )
        with mock.patch.dict(BODIES, {body: replace(BODIES[body], wrist=moved)}):
            super().__init__(body)
        azimuth, rise = random.uniform(-np.pi, np.pi), np.radians(random.uniform(20, 65))
        self.fovy_deg = float(random.uniform(28, 60))
        distance = random.uniform(0.5, 0.75) / (2 * np.tan(np.radians(self.fovy_deg) / 2))
        away = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
        self.target = np.array(CENTRE) + random.normal(0, 0.05, 3)
        self.eye = self.target + max(distance, 0.6) * away
        self.roll = np.radians(random.normal(0, UPRIGHT_ROLL_DEG))

    def _set_scene(
        self, renderer: SceneRenderer, scene_id: str, jitter: np.random.Generator, held_out_camera: bool
    ) -> None:
        del held_out_camera
        renderer.set_look(SCENES[scene_id])
        self._paint_body(jitter, repaint=False)
        renderer.place_cameras(self.eye, self.target)
        head = self.scene.model.camera("head").id
        self.scene.model.cam_fovy[head] = self.fovy_deg  # the look has its own
        half, back = self.roll / 2, self.scene.model.cam_quat[head].copy()
        w, x, y, z = back
        c, s = np.cos(half), np.sin(half)  # about the camera's own axis
        self.scene.model.cam_quat[head] = [w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s]


def drawn_jobs(body: str, episodes: int, seed: int) -> Iterator[Job]:
    """Recordings of all tasks in turn."""
    families = [task for task in TASKS if task != "carry" or len(BODIES[body].arms) == 2]
    for number in range(episodes):
        entropy = (7000 + seed, BODIES[body].stream, SPLIT_STREAM["test"], number)
        yield Job(
            f"{body}-{number:02d}", body, "test", families[number % len(families)], entropy, num_frames=NUM_FRAMES
        )


def record(body: str, output: Path, episodes: int, seed: int) -> None:
    """Write a set, as `read_set` reads it."""
    recorder = HiddenCameras(body, seed)
    arrays: dict[str, np.ndarray] = {}
    views: list[str] = []
    for number, job in enumerate(drawn_jobs(body, episodes, seed)):
        found = recorder.record(job)
        views = list(found.frames)
        arrays[f"{number}/state"], arrays[f"{number}/action"] = found.episode.state, found.episode.action
        for view, camera in found.episode.cameras.items():
            arrays[f"{number}/K/{view}"], arrays[f"{number}/T/{view}"] = camera.K, camera.T_base_camera
            arrays[f"{number}/frames/{view}"] = found.frames[view]
    recorder.close()
    np.savez_compressed(output / f"{body}_{seed}.npz", **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
    (output / f"{body}_{seed}.json").write_text(json.dumps({"body": body, "episodes": episodes, "views": views}))


def read_set(facts_file: Path) -> list[tuple[Episode, dict[str, np.ndarray]]]:
    """(episode with the true cameras, uint8 (n, h, w, 3) frames by view) of each recording."""
    return read_recordings(facts_file, "frames", json.loads(facts_file.read_text())["body"], 8.0)


def with_unknown_base(body: str, folder: Path) -> Embodiment:
    """A body of two arms as a user describes it who has one arm's description and does not know where the second arm stands."""
    robot = load_embodiment(body)
    root = parse_xml(read_description(robot), robot.description_path)
    world = cast(ET.Element, root.find("worldbody"))
    left, right = world.findall("body")
    world.remove(right)
    place, turn = (tuple(map(float, left.attrib.pop(key).split())) for key in ("pos", "quat"))
    path = folder / f"{body}_arm.xml"
    path.write_text(ET.tostring(root, "unicode").replace('"left/', '"'))
    description = {"format": "mjcf", "file": path.name, "mounts": {"left": {"translation": place, "rotation_wxyz": turn}, "right": "unknown"}}  # fmt: skip
    return robot.model_copy(update={"description": Description.model_validate(description), "description_path": path})


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--bodies", default=",".join(BODIES))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    prepare_rendering()
    for body in arguments.bodies.split(","):
        if not (arguments.output / f"{body}_{arguments.seed}.json").is_file():
            record(body, arguments.output, arguments.episodes, arguments.seed)
            print(body, arguments.seed, flush=True)


if __name__ == "__main__":
    main()
