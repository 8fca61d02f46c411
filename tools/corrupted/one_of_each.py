"""One small healthy recording in each layout that curation reads, to be damaged by `mutations`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from tools.corrupted import droid_annotation, lerobot_v21, mcap
from tools.corrupted.content import FPS, HEIGHT, NUM_FRAMES, WIDTH, gripper_motion, joint_motion, pictures
from tools.corrupted.defects import Source
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.sources.hdf5 import require_h5py
from worldline_core.data.video.encoder import encode_video

_LENGTH = 4
_K = np.array([[80.0, 0, (WIDTH - 1) / 2], [0, 80.0, (HEIGHT - 1) / 2], [0, 0, 1]])


def write_one_of_each(folder: Path) -> dict[str, Source]:
    """Layout -> its `curate.sources[]` entry; each in a folder of its own."""
    random = np.random.default_rng(0)
    sources: dict[str, Source] = {}
    for module in (lerobot_v21, droid_annotation, mcap):
        name = module.__name__.rsplit(".", 1)[1]
        sources[name] = module.write(folder / name, 1, 0, random)[1]
    own = folder / "episode_set"
    curate(CurateConfig.model_validate({"sources": [sources["mcap"]]}), {}, own)
    shutil.rmtree(own / "run")
    sources["episode_set"] = {"kind": "episode_set", "path": str(own)}
    dataset = next((own / "datasets").iterdir())
    sources["lerobot_v3"] = {
        "kind": "lerobot_v3",
        "path": str(shutil.copytree(dataset, folder / "lerobot_v3")),
        "embodiment": "ur5e_pair",
        "angle_unit": "rad",
        "views": {"observation.images.head": "head"},
    }
    for write in (_agibot_world, _robotwin, _robomind, _agibot_gesim, _enerverse_ac, _unitree_h5, _video_folder):
        name = write.__name__.lstrip("_")
        sources[name] = {"path": str(folder / name), **write(folder / name, random)}
    return sources


def _jpegs(random: np.random.Generator) -> list[bytes]:
    return [cv2.imencode(".jpg", image)[1].tobytes() for image in pictures(random, _LENGTH)]


def _agibot_world(root: Path, random: np.random.Generator) -> Source:
    arrays = root / "proprio_stats/327/100000"
    videos = root / "observations/327/100000/videos"
    parameters = root / "parameters/327/100000/parameters/camera"
    for folder in (arrays, videos, parameters, root / "task_info"):
        folder.mkdir(parents=True)
    motion = joint_motion(random, 14)
    opening = np.stack([gripper_motion(random) for _ in range(2)], axis=1)
    half = 0.5 * joint_motion(random, 2)
    orientation = np.stack([np.sin(half), np.zeros_like(half), np.zeros_like(half), np.cos(half)], axis=-1)
    with require_h5py().File(arrays / "proprio_stats.h5", "w") as file:
        file["timestamp"] = 1_718_000_000_000_000_000 + np.rint(np.arange(NUM_FRAMES) * 1e9 / FPS).astype(np.int64)
        file["state/joint/position"] = motion
        file["state/effector/position"] = 120 - 85 * opening
        file["state/end/position"] = np.stack([motion[:, :3], motion[:, 3:6]], axis=1)
        file["state/end/orientation"] = orientation
        file["action/joint/position"] = motion + 0.002
        file["action/effector/position"] = 1 - opening
    for index, camera in enumerate(("head", "hand_left", "hand_right")):
        encode_video(videos / f"{camera}_color.mp4", pictures(random), FPS, preset="ultrafast")
        intrinsic = {"fx": 80.0 + index, "fy": 81.0, "ppx": 47.5, "ppy": 35.5}
        (parameters / f"{camera}_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
        poses = [
            {"rotation_matrix": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "translation_vector": [0.1, 0.01 * n, 1.2]}
            for n in range(1 if camera == "head" else NUM_FRAMES)
        ]
        listed = json.dumps([{"extrinsic": pose} for pose in poses])
        (parameters / f"{camera}_extrinsic_params_aligned.json").write_text(listed)
    rows = [{"episode_id": 100_000, "task_id": 327, "task_name": "Pick up the block", "label_info": {}}]
    (root / "task_info/task_327.json").write_text(json.dumps(rows))
    return {"kind": "agibot_world", "name": root.name, "fps": FPS, "split": "train"}


def _robotwin(root: Path, random: np.random.Generator) -> Source:
    path = root / "beat_block/demo/data/episode0.hdf5"
    path.parent.mkdir(parents=True)
    with require_h5py().File(path, "w") as file:
        for number, arm in enumerate(("left", "right")):
            pose = np.tile([0.3 * number, -0.2, 0.9, 1.0, 0, 0, 0], (_LENGTH, 1))
            file[f"endpose/{arm}_endpose"] = pose
            file[f"endpose/{arm}_gripper"] = gripper_motion(random, _LENGTH)
            file[f"joint_action/{arm}_arm"] = joint_motion(random, 6, _LENGTH)
            file[f"joint_action/{arm}_gripper"] = gripper_motion(random, _LENGTH)
        for camera in ("head_camera", "left_camera", "right_camera"):
            group = f"observation/{camera}"
            encoded = _jpegs(random)
            file[f"{group}/rgb"] = np.array(encoded, dtype=f"S{max(map(len, encoded))}")
            file[f"{group}/intrinsic_cv"] = np.tile(_K, (_LENGTH, 1, 1))
            file[f"{group}/extrinsic_cv"] = np.tile(np.eye(4)[:3], (_LENGTH, 1, 1))
            file[f"{group}/cam2world_gl"] = np.tile(np.diag([1.0, -1, -1, 1]), (_LENGTH, 1, 1))
    instructions = root / "beat_block/demo/instructions/episode0.json"
    instructions.parent.mkdir()
    instructions.write_text(json.dumps({"seen": ["Hit the block."], "unseen": []}))
    return {"kind": "robotwin", "fps": 10}


def _robomind(root: Path, random: np.random.Generator) -> Source:
    path = root / "open_drawer/success_episodes/train/1014_144602/data/trajectory.hdf5"
    path.parent.mkdir(parents=True)
    h5py = require_h5py()
    with h5py.File(path, "w") as file:
        for camera in ("camera_top", "camera_left", "camera_right"):
            images = file.create_dataset(
                f"observations/rgb_images/{camera}", (_LENGTH,), dtype=h5py.vlen_dtype(np.uint8)
            )
            for number, content in enumerate(_jpegs(random)):
                images[number] = np.frombuffer(content, np.uint8)
        bent = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 2.0, 0.5]) + 0.2 * joint_motion(random, 7, _LENGTH)
        file["puppet/joint_position"] = np.hstack([bent, gripper_motion(random, _LENGTH)[:, None]])
        file["language_raw"] = [b"Open the drawer"]
    gripper = {"closed": 1.0, "open": 0.0}
    return {"kind": "robomind", "layout": "h5_franka_3rgb", "fps": 10, "gripper_state": gripper}


def _agibot_gesim(root: Path, random: np.random.Generator) -> Source:
    folder = root / "sample_0"
    folder.mkdir(parents=True)
    pose = np.concatenate([joint_motion(random, 3, _LENGTH), np.tile([0, 0, 0, 1.0, 60.0], (_LENGTH, 1))], axis=1)
    np.save(folder / "actions.npy", np.concatenate([pose, pose], axis=1))
    for name in ("head", "hand_left", "hand_right"):
        (folder / f"{name}_color").mkdir()
        for number, image in enumerate(pictures(random, _LENGTH)):
            cv2.imwrite(str(folder / f"{name}_color/{number}.png"), image)
        np.save(folder / f"intrinsic_{name}.npy", _K)
        np.save(folder / f"extrinsic_{name}.npy", np.tile(np.eye(4), (_LENGTH, 1, 1)))
    return {"kind": "agibot_gesim", "fps": 30}


def _enerverse_ac(root: Path, random: np.random.Generator) -> Source:
    folder = root / "296-655235-0"
    folder.mkdir(parents=True)
    with require_h5py().File(folder / "proprio_stats.h5", "w") as file:
        file["state/end/position"] = np.stack([joint_motion(random, 3, _LENGTH) for _ in range(2)], axis=1)
        file["state/end/orientation"] = np.tile([0, 0, 0, 1.0], (_LENGTH, 2, 1))
        file["state/effector/position"] = np.full((_LENGTH, 2), 60.0)
    encode_video(folder / "head_color.mp4", pictures(random, _LENGTH), FPS, preset="ultrafast")
    intrinsic = {"fx": _K[0, 0], "fy": _K[1, 1], "ppx": _K[0, 2], "ppy": _K[1, 2]}
    (folder / "head_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
    pose = {"rotation_matrix": np.eye(3).tolist(), "translation_vector": [0, 0, 1]}
    (folder / "head_extrinsic_params_aligned.json").write_text(json.dumps([{"extrinsic": pose}] * _LENGTH))
    return {"kind": "enerverse_ac", "fps": FPS}


_Z1_REST = np.array([0.0, 1.5, -1.0, 0.0, 0.0, 0.0])


def _unitree_h5(root: Path, random: np.random.Generator) -> Source:
    for folder in ("transitions/stack", "videos/stack/cam"):
        (root / folder).mkdir(parents=True)
    gripper = {"closed": 0.0, "open": 1.0}
    with require_h5py().File(root / "transitions/stack/0.h5", "w") as file:
        for key in ("observation.state", "action"):
            joints = _Z1_REST + 0.3 * joint_motion(random, 6, _LENGTH)
            file[key] = np.hstack([joints, gripper_motion(random, _LENGTH)[:, None]])
    encode_video(root / "videos/stack/cam/0.mp4", pictures(random, _LENGTH), FPS, preset="ultrafast")
    (root / "stack.csv").write_text("videoid,data_dir,instruction\n0,stack/cam,stack the box\n")
    return {
        "kind": "unitree_h5", "robot": "z1_single", "embodiment": "none", "fps": FPS, "views": {"head": "cam"},
        "gripper_state": gripper, "gripper_command": gripper,
    }  # fmt: skip


def _video_folder(root: Path, random: np.random.Generator) -> Source:
    root.mkdir()
    encode_video(root / "pour.mp4", pictures(random, _LENGTH), FPS, preset="ultrafast")
    (root / "pour.txt").write_text("pour the water")
    return {"kind": "video_folder"}
