"""`worldline init` on every other kind of recordings, on folders that hold nothing, on the hub, and as a command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.command_line import main
from tests.data.test_source_agibot import write_clip
from tests.data.test_source_agibot import write_episode as write_agibot
from tests.data.test_source_robomind import write_franka
from tests.data.test_source_robotwin import write_episode as write_robotwin
from tests.data.test_source_unitree_h5 import write_hdf5, write_transitions
from tests.discovery.recorded_sets import motion, pictures, write_so101, write_video
from tests.mcap.conftest import robot
from worldline_core.calibration.check import episodes_of_config
from worldline_core.data.curation.curate import curate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.rejection import unreadable
from worldline_core.data.video.clip import decode_video
from worldline_core.discovery.cameras import name_views, watch
from worldline_core.discovery.findings import Discovery, write_config
from worldline_core.discovery.look import discover, look
from worldline_core.errors import DataError
from worldline_core.exports.export import export
from worldline_core.filters.filter import filter_episodes
from worldline_core.pipeline.pipeline_config import PipelineConfig


def init(tmp_path: Path, name: str = "raw", **answers: object) -> tuple[Discovery, PipelineConfig, dict[str, Any]]:
    """Look, write, answer what is asked, and curate."""
    found, path = look(tmp_path / name), tmp_path / "my.yaml"
    write_config(found, path, str(tmp_path / name))
    assert {question.name for question in found.questions} == set(answers)
    answered = [f"todo.{name}={value}" for name, value in answers.items()]
    # What tests write looks alike.
    config = PipelineConfig.load(None, path, [*answered, "curate.near_duplicates=false"])
    counts = curate(config.curate, {}, tmp_path / "curated")
    assert counts["kept"] + counts["quarantined"] == counts["found"]
    assert len(episodes_of_config(path, answered)[0]) == counts["found"]  # as `worldline calibrate` reads it
    return found, config, counts


def test_a_folder_of_videos(tmp_path: Path) -> None:
    for n in range(3):
        write_video(tmp_path / f"raw/{n}/clip.mp4", pictures(motion(5, 40, n), "still", n), 10)
    (tmp_path / "raw/captions.csv").write_text("video,caption\n")
    (tmp_path / "raw/LICENSE").write_text("MIT License\n")
    found, config, counts = init(tmp_path)
    assert (found.kind, found.state_size, counts["kept"]) == ("video_folder", None, 3)
    assert config.train_stage1 is not None and (
        config.train_stage1.trainer.minutes,
        config.train_stage1.trainer.steps,
    ) == (20, None)
    assert any("captions.csv" in note for note in found.notes)
    assert config.curate.sources[0].license == "MIT"


def test_an_episode_set_and_its_mcap_files(tmp_path: Path, project_root: Path) -> None:
    shipped = project_root / "artifacts/shipped/recordings"
    found = look(shipped)
    views = ["head", "right_wrist"]  # of all robots
    assert (found.kind, found.views, found.cameras) == ("episode_set", views, "all")
    write_config(found, tmp_path / "my.yaml", str(shipped))
    assert PipelineConfig.load(None, tmp_path / "my.yaml").render_actions is not None
    export(shipped, tmp_path / "mcap", ["mcap"], episode_ids=[EpisodeSet.open(shipped).rows[0].episode_id])
    exported = look(tmp_path / "mcap")
    assert (exported.kind, set(exported.views) >= {"head", "right_wrist"}, exported.cameras) == ("mcap", True, "all")


def test_ros_2_topics(tmp_path: Path) -> None:
    for n in range(3):
        robot(seconds=3.0 + 0.2 * n, seed=n).write(tmp_path / f"raw/{n}.mcap")
    found, config, counts = init(tmp_path)
    assert found.source["views"] == {
        view: {"image": f"/{name}/image/compressed", "calibration": f"/{name}/camera_info"}
        for view, name in (("head", "head"), ("right_wrist", "wrist"))
    }
    assert found.source["arms"][0]["state"]["gripper"]["range"] == {"closed": 0, "open": 0.04}
    assert (found.fps, found.source["embodiment"], found.source["base_frame"]) == (30, "none", "base_link")
    assert "/command" in found.evidence["without_commands",]
    assert counts["kept"] == 3
    assert config.train_stage2.native_size == 3


@pytest.mark.parametrize("write", [write_hdf5, write_transitions])
def test_unitree(tmp_path: Path, write: Any) -> None:
    for n in range(3):
        write(tmp_path / "raw", n, 20 * n)
    found, _, counts = init(tmp_path)
    assert (found.source["robot"], found.source["embodiment"]) == ("g1_dex1", "unitree_g1_29dof")
    assert found.source["views"] == {"head": "cam_left_high", "right_wrist": "cam_right_wrist"}
    assert counts["found"] == 3


def test_the_file_that_an_estimate_writes_is_found_beside_recordings(tmp_path: Path) -> None:
    for n in range(3):
        write_hdf5(tmp_path / "raw", n, 20 * n)
    camera = {"width": 64, "height": 48, "K": [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], "T": np.eye(4).tolist()}
    views = {"head": camera | {"maps": "camera_to_base", "axes": "opencv"}}
    (tmp_path / "raw/cameras.json").write_text(json.dumps({"views": views}))
    found, config, counts = init(tmp_path)
    assert (found.cameras, found.head_camera, counts["kept"]) == ("some", True, 3)
    assert config.render_actions is not None and config.train_stage2.native_size == 16
    assert set(EpisodeSet.open(tmp_path / "curated").episode(0).cameras) == {"head"}


def test_unitrees_other_arms(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "one", robot="z1_single")
    found = look(tmp_path / "one")
    assert (found.source["robot"], found.source["embodiment"]) == ("z1_single", "none")
    assert {question.name for question in found.questions} == {
        f"gripper_{track}_{end}" for track in ("state", "command") for end in ("closed", "open")
    }
    for name in ("two", "tmp.KnOv7pHKz1/two"):  # a folder's letters are no robot
        write_hdf5(tmp_path / name, robot="aloha")
        found = look(tmp_path / name)
        assert (found.source["robot"], found.source["channels"], found.source["fps"]) == ("aloha", "as_written", 50)
    write_hdf5(tmp_path / "Z1_Dual_Dex1_StackBox", robot="z1_dual")
    assert look(tmp_path / "Z1_Dual_Dex1_StackBox").source["robot"] == "z1_dual"


def test_robomind(tmp_path: Path) -> None:
    for n in range(3):
        write_franka(tmp_path / "h5_franka_3rgb", f"task_{n}", seed=n)
    answers = {"fps": 30, "gripper_state_closed": 1, "gripper_state_open": 0}
    found, config, counts = init(tmp_path, "h5_franka_3rgb", **answers)
    assert (found.source["layout"], counts["kept"]) == ("h5_franka_3rgb", 3)
    assert config.curate.sources[0].gripper_state.closed == 1  # type: ignore[union-attr]


def test_agibot_and_enerverse(tmp_path: Path) -> None:
    for n in range(3):
        write_agibot(tmp_path / "world", 327, 648642 + n, 20 * n)
    found = look(tmp_path / "world")
    assert (found.kind, found.views, found.cameras) == ("agibot_world", ["head", "left_wrist", "right_wrist"], "all")
    write_clip(tmp_path / "clips", "1-2-3")
    assert look(tmp_path / "clips").kind == "enerverse_ac"
    for name in ("world", "clips"):
        write_config(look(tmp_path / name), tmp_path / f"{name}.yaml", name)
        assert PipelineConfig.load(None, tmp_path / f"{name}.yaml").render_actions is not None


def test_robotwin_is_for_evaluation(tmp_path: Path) -> None:
    write_robotwin(tmp_path / "raw")
    found, config, counts = init(tmp_path, fps=16.667)
    assert (found.trains, counts["kept"], config.curate.splits) == (False, 1, {})


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "folder is empty"),
        ({"notes.txt": b"x", "a/b.bin": b"x"}, r"(?s)Nothing here.*meta/info\.json.*1 \.txt"),
        ({"dataset.tar.gz": b"x"}, r"(?s)Nothing here.*unpack dataset\.tar\.gz"),
        ({"meta/info.json": b"{}"}, r"meta/info\.json is not understood"),
        ({"meta/info.json": b'{"codebase_version": "v1.6", "fps": 1, "features": {}}'}, r"another version"),
        ({"a.mp4": b"no video"}, "None of the videos can be read"),
        ({"a.mcap": b"no mcap"}, r"a\.mcap"),
        ({"a.db3": b"x"}, r"(?s)a\.db3.*mcap"),
        ({"trajectory.hdf5": b"x"}, r"trajectory\.hdf5|layout"),
        ({"x/episode_0.hdf5": b"no hdf5"}, r"episode_0\.hdf5"),
        ({"annotation/val/0.json": b"["}, r"0\.json"),
    ],
    ids=lambda value: next(iter(value), "empty") if isinstance(value, dict) else "",
)
def test_wrong_and_empty_folders_are_one_clear_error(tmp_path: Path, files: dict[str, bytes], said: str) -> None:
    (tmp_path / "raw").mkdir()
    for name, content in files.items():
        (tmp_path / "raw" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "raw" / name).write_bytes(content)
    if files.keys() == {"trajectory.hdf5"}:
        assert "layout" in {question.name for question in look(tmp_path / "raw").questions}
        return
    with pytest.raises(DataError, match=said):
        discover(tmp_path / "raw")


def test_a_network_failure_is_raised_and_not_taken_for_a_damaged_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "ab":
        (tmp_path / f"{name}.mcap").write_bytes(b"x")
    opened = []

    def unreachable(path: Path) -> None:
        opened.append(path.name)
        with unreadable("No MCAP file", path, (ConnectionError,)):
            raise ConnectionError("reset by peer")

    monkeypatch.setattr("worldline_core.discovery.mcap.McapFile", unreachable)
    with pytest.raises(DataError, match="reset by peer"):
        look(tmp_path)
    assert opened == ["a.mcap"]


def test_what_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file.txt").write_text("x")
    for name, said in (("gone", "No such folder"), ("file.txt", "Not a folder")):
        with pytest.raises(DataError, match=said):
            look(tmp_path / name)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_so101(tmp_path / "raw")
    main(["init", "raw"])
    printed = capsys.readouterr().out
    assert all(fact in printed.splitlines()[0] for fact in ("LeRobotDataset v3.0", "so101_follower", "30 fps"))
    assert printed.endswith("worldline task curate --config my.yaml\n")
    with pytest.raises(SystemExit):
        main(["init", "raw"])
    assert "there already" in capsys.readouterr().err
    main(["init", "raw", "--output", "other.yaml", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["source"]["embodiment"], found["todo"], found["file"]) == ("so101", {}, "other.yaml")
    assert found["next"] == ["worldline task curate --config other.yaml"]
    assert ["angle_unit"] in [entry["key"] for entry in found["evidence"]]


@pytest.mark.slow
def test_real_wrist_cameras_are_told_by_their_pictures_alone(shared_data: Path) -> None:
    """DROID: two cameras outside, one on the wrist, here without names; one episode each, though `init` has several to look at."""
    right = []
    for file in sorted((shared_data / "droid_ctrl_world").glob("*/annotation/*/*.json")):
        record = json.loads(file.read_text())
        joints = np.array(record.get("joints") or record["observation.state.joint_position"][::3])[:48, :7]
        frames = [decode_video(file.parents[2] / video["video_path"])[: len(joints)] for video in record["videos"]]
        motion = np.abs(np.diff(joints, axis=0)).max(axis=1)
        seen = {name: watch(f, {"right": motion[: len(f) - 1]}) for name, f in zip("acb", frames, strict=True)}
        right.append(name_views("bac", ["right"], seen).views.get("b") == "right_wrist")
    assert (len(right), sum(right)) >= (15, 14)


SAMPLES = {
    "lerobot_unitree_g1": ("unitree_g1_29dof", 2, 98),
    "droid_ctrl_world": ("droid_franka", 13, 2),
    "agibot_gesim": ("agibot_g1", 2, 0),
    "agibot_gesim_v2": ("agibot_g1", 2, 0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_real_samples_run_with_nothing_changed_by_hand(tmp_path: Path, shared_data: Path, name: str) -> None:
    robot, kept, quarantined = SAMPLES[name]
    found, config, counts = init(tmp_path, str(shared_data / name))
    assert (found.source["embodiment"], counts["kept"], counts["quarantined"]) == (robot, kept, quarantined)
    assert not re.search("TODO", (tmp_path / "my.yaml").read_text())
    if name == "lerobot_unitree_g1":
        filter_episodes(config.filter, {"episodes": tmp_path / "curated"}, tmp_path / "filtered")
        assert len(EpisodeSet.open(tmp_path / "filtered").rows) == 2
