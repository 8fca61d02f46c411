"""`source: action` projects commands and `source: state` measurements, whatever kind of source an episode comes from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter

h5py = pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

from tests.data.test_source_worldarena import settings, write_track_2
from tests.mcap.conftest import declared, robot
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.actions.action_tracks import MissingActionsError, compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import NO_EMBODIMENT, CameraTrack, Episode
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.sources.open import SourceConfig, open_source
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import euler_fixed_xyz_from_rotation, quaternion_xyzw_from_rotation

COMMANDED = {
    "episode_set", "lerobot_v21", "lerobot_v3", "agibot_world", "agibot_gesim_v2", "enerverse_ac_joints", "mcap",
    "mcap_topics", "unitree_h5",
}  # fmt: skip
NOT_COMMANDED = {"agibot_gesim", "enerverse_ac", "droid_annotation", "robomind", "robotwin", "video_folder"}
"""Whose samples have commands, and whose say that they have none. WorldArena's have commands alone."""
PLACE = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.3], [1, 0, 0, 2.0], [0, 0, 0, 1]])
WAIST = {"idx01_waist_lift_joint": 0.11, "idx02_waist_pitch_joint": 0.3}


def write_agibot_urdf(path: Path) -> Path:
    """A body with the joints that configs/embodiments/agibot_g1.yaml names, and arms of its own lengths."""
    joints = [
        ("idx01_waist_lift_joint", "prismatic", "base_link", "lift", "0 0 0.5", "0 0 1"),
        ("idx02_waist_pitch_joint", "revolute", "lift", "torso", "0 0 0.3", "0 1 0"),
        ("idx03_head_yaw_joint", "revolute", "torso", "neck", "0 0 0.4", "0 0 1"),
        ("idx04_head_pitch_joint", "revolute", "neck", "head", "0 0 0.1", "0 1 0"),
    ]
    for side, arm in zip((1, -1), load_embodiment("agibot_g1").arms, strict=True):
        links = ["torso", *(f"{name}_link" for name in arm.joints[:-1]), arm.end_effector_link]
        for number, (name, parent, child) in enumerate(zip(arm.joints, links, links[1:], strict=False)):
            xyz = f"0.02 {0 if number else 0.2 * side} -0.1"
            joints.append((name, "revolute", parent, child, xyz, ("0 0 1", "0 1 0", "1 0 0")[number % 3]))
    text = "".join(
        f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="-4" upper="4" effort="1" velocity="1"/></joint>'
        for name, kind, parent, child, xyz, axis in joints
    )
    path.write_text(f'<robot name="g1"><link name="base_link"/>{text}</robot>')
    return path


@pytest.fixture(scope="module")
def agibot(tmp_path_factory: pytest.TempPathFactory) -> ArmKinematics:
    return ArmKinematics(load_embodiment("agibot_g1", write_agibot_urdf(tmp_path_factory.mktemp("g1") / "g1.urdf")))


@pytest.fixture(scope="module")
def kinematics_of(tmp_path_factory, agibot: ArmKinematics) -> Callable[[Episode], ArmKinematics]:
    folder = tmp_path_factory.mktemp("toy")
    body = '<body name="upper"><joint name="a" axis="0 0 1"/><body name="hand" pos="0.3 0 0"><joint name="b" axis="0 1 0"/>'
    (folder / "toy.xml").write_text(f"<mujoco><worldbody>{body}</body></body></worldbody></mujoco>")
    arm = {"name": "right", "joints": ["a", "b"], "limits": [[-1, 1]] * 2, "end_effector_link": "hand"}
    values = {"name": "toy", "description": {"format": "mjcf", "file": "toy.xml"}, "base_link": "world", "arms": [arm]}
    (folder / "toy.yaml").write_text(yaml.safe_dump(values))
    toy = ArmKinematics(load_embodiment(folder / "toy.yaml"))

    def of(episode: Episode) -> ArmKinematics:
        """For a robot without a description: one with as many joints."""
        if episode.embodiment == NO_EMBODIMENT:
            return {3: toy, 7: ArmKinematics(load_embodiment("ur5e"))}[episode.state.shape[1]]
        return agibot if episode.embodiment == "agibot_g1" else ArmKinematics(load_embodiment(episode.embodiment))

    return of


def end_poses(kinematics: ArmKinematics, joints: np.ndarray, lift: np.ndarray | float) -> np.ndarray:
    """(n, 2, 4, 4) of the end links of joints (n, 14) without grippers."""
    vector = np.insert(joints, (7, 14), 0.0, axis=1)
    links = kinematics.link_poses(vector, WAIST | {"idx01_waist_lift_joint": lift})
    return np.stack([links[f"arm_{side}_end_link"].numpy() for side in "lr"], axis=1)


def record_poses(path: Path, kinematics: ArmKinematics, *, lift: np.ndarray | float = 0.11) -> None:
    """Give a recording the poses that its joints have with a waist which is not the embodiment's default one."""
    with h5py.File(path, "r+") as file:
        count = len(file["state/joint/position"])
        ends = end_poses(kinematics, file["state/joint/position"][()], lift)
        pitch = np.full(count, WAIST["idx02_waist_pitch_joint"])
        file.pop("state/waist/position", None)
        file["state/waist/position"] = np.stack([pitch, np.broadcast_to(lift, count)], axis=1)
        file["state/end/position"][...] = ends[..., :3, 3]
        file["state/end/orientation"][...] = quaternion_xyzw_from_rotation(ends[..., :3, :3])
        file["action/joint/position"][...] = file["state/joint/position"][()] + 0.2


def write_gesim_v2(root: Path, kinematics: ArmKinematics) -> dict[str, Any]:
    folder, count = root / "demo_000", 5
    folder.mkdir(parents=True)
    joints = 0.3 * np.sin(np.arange(count)[:, None] + np.arange(14))
    waist = [0.0, 0.4, WAIST["idx02_waist_pitch_joint"], WAIST["idx01_waist_lift_joint"]]
    np.save(folder / "state_joints_0.npy", np.hstack([joints, np.full((count, 2), 60.0), np.tile(waist, (count, 1))]))
    np.save(folder / "actions_0.npy", np.insert(joints + 0.2, (7, 14), 0.3, axis=1))
    ends = end_poses(kinematics, joints, WAIST["idx01_waist_lift_joint"])
    angles = euler_fixed_xyz_from_rotation(ends[..., :3, :3])
    measured = np.concatenate([ends[..., :3, 3], angles, np.full((count, 2, 1), 60.0)], axis=2)
    np.save(folder / "state_eef_poses_0.npy", measured.reshape(count, 14))
    np.save(folder / "intrinsic.npy", np.tile([[80.0, 0, 47.5], [0, 80, 31.5], [0, 0, 1]], (3, 1, 1)))
    np.save(folder / "extrinsic_alignstate_0.npy", np.tile(np.eye(4), (3, count, 1, 1)))
    for name in ("cur_head", "cur_left", "cur_right"):
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((64, 96, 3), np.uint8))
    return {"kind": "agibot_gesim", "path": str(root), "fps": 30}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory, agibot: ArmKinematics) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("kinds")
    written = write_one_of_each(folder)
    recorded = next((folder / "agibot_world").rglob("*.h5"))
    record_poses(recorded, agibot)
    clip = shutil.copytree(folder / "enerverse_ac", folder / "enerverse_ac_joints") / "296-655235-0"
    shutil.copy(recorded, clip / "proprio_stats.h5")
    extrinsics = clip / "head_extrinsic_params_aligned.json"
    extrinsics.write_text(json.dumps(json.loads(extrinsics.read_text())[:1]))
    written["enerverse_ac_joints"] = {**written["enerverse_ac"], "path": str(clip.parent)}
    written["agibot_gesim_v2"] = write_gesim_v2(folder / "agibot_gesim_v2", agibot)
    (folder / "mcap_topics").mkdir()
    robot().write(folder / "mcap_topics" / "a.mcap")
    written["mcap_topics"] = declared(folder / "mcap_topics")
    write_track_2(folder / "worldarena")
    written["worldarena"] = settings(folder / "worldarena")
    return {name: TypeAdapter(SourceConfig).validate_python(source) for name, source in written.items()}


def first_episode(config: Any) -> Episode:
    """With a camera for the head where the source has none: tracks are of a view."""
    source = open_source(config, config.path)
    episode = source.load(source.episode_ids()[0]).episode
    camera = CameraTrack("head", np.array([[80.0, 0, 47.5], [0, 80, 31.5], [0, 0, 1]]), PLACE[None], 96, 64)
    return episode if episode.cameras else replace(episode, cameras={"head": camera})


def test_every_kind_is_here(sources: dict[str, Any]) -> None:
    union = get_args(get_args(SourceConfig)[0])
    kinds = {kind for each in union for kind in get_args(each.model_fields["kind"].annotation)}
    assert {config.kind for config in sources.values()} == kinds - {"recording"}  # an episode_set
    assert sources.keys() == COMMANDED | NOT_COMMANDED | {"worldarena"}
    assert first_episode(sources["worldarena"]).commanded


@pytest.mark.parametrize("name", sorted(COMMANDED))
def test_commands_and_measurements_give_other_tracks(sources, kinematics_of, name):
    episode = first_episode(sources[name])
    kinematics = kinematics_of(episode)
    by_action, by_state = (compute_tracks(episode, kinematics, controls=c)[0] for c in ("action", "state"))
    assert by_action.controls == "action"
    assert np.abs(by_action.T_base_tool - by_state.T_base_tool).max() > 1e-4
    other = replace(episode, action=episode.state)
    assert np.abs(compute_tracks(other, kinematics)[0].T_base_tool - by_state.T_base_tool).max() < 1e-6


@pytest.mark.parametrize("name", sorted(NOT_COMMANDED))
def test_commands_that_are_not_recorded_are_refused(sources, kinematics_of, name):
    episode = first_episode(sources[name])
    needed = episode.state_kind == "joints" and episode.T_base_ee is None
    kinematics = kinematics_of(episode) if needed else None
    with pytest.raises(MissingActionsError, match=r"no commands[\s\S]*source=state|no states and no actions"):
        compute_tracks(episode, kinematics, controls="action")
    if name != "video_folder":
        assert compute_tracks(episode, kinematics, controls="state")[0].num_frames == episode.num_frames


def test_commands_follow_the_recorded_waist(sources: dict[str, Any], agibot: ArmKinematics) -> None:
    """The embodiment's own posture would put the tools elsewhere, without a word."""
    for name in ("agibot_world", "agibot_gesim_v2", "enerverse_ac_joints"):
        episode = first_episode(sources[name])
        assert agibot.embodiment.noted_posture(episode.conventions).items() >= WAIST.items()
        assert episode.T_base_ee is not None
        offset = float(episode.conventions["tool_offset_m"])
        joints = np.delete(episode.action.astype(np.float64), (7, 15), axis=1)
        expected = along_tool_z(end_poses(agibot, joints, WAIST["idx01_waist_lift_joint"]), offset)
        tracks, _ = compute_tracks(episode, agibot)
        np.testing.assert_allclose(tracks.T_base_tool, expected, atol=1e-5)
        elsewhere = agibot.tool_poses(episode.action.astype(np.float64)).numpy()[..., :3, 3] - expected[..., :3, 3]
        assert np.linalg.norm(elsewhere, axis=-1).min() > 0.1


def test_a_waist_that_moves_is_refused(sources: dict[str, Any], agibot: ArmKinematics, tmp_path: Path) -> None:
    root = shutil.copytree(sources["agibot_world"].path, tmp_path / "raw")
    path = next(root.rglob("*.h5"))
    with h5py.File(path) as file:
        lift = np.linspace(0.11, 0.17, len(file["timestamp"]))
    record_poses(path, agibot, lift=lift)
    moving = first_episode(sources["agibot_world"].model_copy(update={"path": root}))
    with pytest.raises(DataError, match=r"do not lead to the recorded tool poses[\s\S]*60 mm[\s\S]*waist moves"):
        compute_tracks(moving, agibot)
    assert compute_tracks(moving, agibot, controls="state")[0].controls == "ee_pose"
    one = replace(moving, T_base_ee=moving.T_base_ee[:, :1], gripper=moving.gripper[:, :1])  # type: ignore[index]
    with pytest.raises(DataError, match=r"differ in the number of arms"):
        compute_tracks(one, agibot)


def test_the_step_projects_commands_or_says_what_is_missing(sources, agibot, tmp_path, monkeypatch):
    source = sources["agibot_world"].model_dump(mode="json")
    curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "set")
    inputs = {"episodes": tmp_path / "set"}
    name = EpisodeSet.open(tmp_path / "set").rows[0].episode_id

    def tracks(folder: str, **values: Any) -> EpisodeTracks:
        config = RenderActionsConfig.model_validate({"previews": 0, **values})
        assert render_actions(config, inputs, tmp_path / folder)["kept"] == 1
        return ActionTracks.open(tmp_path / folder).tracks(name)

    given = {"description_paths": {"agibot_g1": str(agibot.embodiment.description_path)}}
    measured, commanded = tracks("state", source="state"), tracks("action", **given)
    assert (measured.controls, commanded.controls) == ("ee_pose", "action")
    assert np.abs(measured.T_base_tool - commanded.T_base_tool).max() > 0.01
    with pytest.raises(DataError, match=r"(?s)1 kinematics_unavailable.*G1_omnipicker_calibrated.*source=state"):
        tracks("nothing")
    assert [row.reason for row in read_quarantine(tmp_path / "nothing")] == ["kinematics_unavailable"]
    # What was missing lies outside of the set: once it is there, the same call takes it.
    monkeypatch.setenv("WORLDLINE_DESCRIPTION_AGIBOT_G1", str(agibot.embodiment.description_path))
    assert np.array_equal(tracks("nothing").T_base_tool, commanded.T_base_tool)
