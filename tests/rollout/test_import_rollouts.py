"""Folders of videos as sets of rollouts: names and tiles; every file accounted for; counts, rates and sizes."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from pydantic import ValidationError

from tests.data.curating import preset
from tests.data.curating import run as curate
from tests.rollout.conftest import recorded as make_frames
from tests.rollout.conftest import write_recordings
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import DataError
from worldline_core.rollout.import_rollouts import import_rollouts
from worldline_core.rollout.rollout_config import ImportRolloutsConfig
from worldline_core.rollout.rollout_set import RolloutSet

N = 9
EPISODES = ("robot_a-1", "robot_a-2")


def recorded(episode, view):
    return make_frames([len(view), *episode.encode()], N)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    root = tmp_path_factory.mktemp("import")
    made = [(name, "train" if "train" in name else "test", N, VIEWS, VIEWS) for name in (*EPISODES, "robot_train")]
    return write_recordings(root, made, frames=recorded)["episodes"]


def encode(path, frames, fps=8):
    path.parent.mkdir(parents=True, exist_ok=True)
    encode_video(path, frames, fps, crf=0, preset="ultrafast", pixel_format="yuv444p")


def close(found, wanted):
    return found.shape == wanted.shape and float(np.abs(found.astype(int) - wanted).mean()) < 2


@pytest.fixture
def videos(tmp_path):
    """Predictions that are the recordings, of every view of both test episodes."""
    for episode in EPISODES:
        for view in VIEWS:
            encode(tmp_path / "videos" / f"{episode}_{view}.mp4", recorded(episode, view))
    return tmp_path / "videos"


def run(videos, episodes, **config):
    output = videos.parent / "out"
    counts = import_rollouts(
        ImportRolloutsConfig.model_validate({"method": "theirs", **config}), {"videos": videos, "episodes": episodes}, output
    )  # fmt: skip
    return RolloutSet.open(output), counts, pq.read_table(output / "files.parquet").to_pylist()


def test_named_files_become_a_set_of_the_same_bytes(videos, episodes):
    found, counts, files = run(videos, episodes)
    assert (found.method, found.fps, found.episode_ids) == ("theirs", 8.0, list(EPISODES))
    assert set(found.views(EPISODES[0])) == set(VIEWS)
    assert close(found.frames("robot_a-2", "left_wrist", 0), recorded("robot_a-2", "left_wrist"))
    copied = found.root / found.rows[0].path
    assert copied.read_bytes() == (videos / "robot_a-1_head.mp4").read_bytes()
    assert counts["files"] == {"matched": 6}
    assert counts["frames"] == 6 * N
    assert {(file["status"], file["view"]) for file in files} == {("matched", view) for view in VIEWS}


def test_every_file_and_every_expected_video_is_accounted_for(videos, episodes):
    (videos / "robot_a-1_head.mp4").rename(videos / "robot_a-9_head.mp4")
    encode(videos / "robot_train_head.mp4", recorded("robot_train", "head"))
    encode(videos / "sub" / "notes.mp4", recorded("robot_train", "head"))
    (videos / "readme.txt").write_text("no video")
    with pytest.raises(DataError, match=r"(?s)not those of the recordings.*'matched': 5.*'missing': 1") as refused:
        run(videos, episodes)
    for line in (
        "unknown: robot_a-9_head.mp4 (no episode robot_a-9)",
        "unknown: robot_train_head.mp4 (of the split train)",
        "unknown: sub/notes.mp4 (its name does not fit)",
        "missing: robot_a-1 head seed 0 (no file)",
    ):
        assert line in str(refused.value)
    found, counts, files = run(videos, episodes, missing="report", unknown="report")
    assert counts["files"] == {"matched": 5, "missing": 1, "unknown": 3}
    assert found.views("robot_a-1") == ["left_wrist", "right_wrist"]
    assert [file["episode_id"] for file in files if file["status"] == "missing"] == ["robot_a-1"]
    with pytest.raises(DataError, match="not those of the recordings"):
        run(videos, episodes, name="other_{episode}_{view}.mp4", missing="report", unknown="report")


def test_counts_rates_and_sizes_are_compared_before_anything_is_written(videos, episodes):
    frames = recorded("robot_a-1", "head")
    encode(videos / "robot_a-1_head.mp4", frames, fps=16)
    encode(videos / "robot_a-1_left_wrist.mp4", np.concatenate([frames, frames[:2]]))
    encode(videos / "robot_a-2_head.mp4", frames.repeat(2, axis=1))
    with pytest.raises(DataError, match=r"(?s)do not fit together.*got: 4 problems") as refused:
        run(videos, episodes)
    for line in (
        "robot_a-1_head.mp4: 16 frames per second, the recording has 8",
        "robot_a-1_left_wrist.mp4: 11 frames, the recording has 9",
        "robot_a-2_head.mp4: pictures of (64, 48), the recording's are (32, 48)",
        "robot_a-1, seed 0: views of [9, 11] frames",
    ):
        assert line in str(refused.value)
    assert not (videos.parent / "out").exists()
    encode(videos / "robot_a-1_left_wrist.mp4", frames)
    found, _, _ = run(videos, episodes, fps=8, resize=True)
    assert close(found.frames("robot_a-2", "head"), frames)
    (videos / "robot_a-1_head.mp4").write_bytes((videos / "robot_a-2_left_wrist.mp4").read_bytes()[:400])
    with pytest.raises(DataError, match="cannot be decoded"):
        run(videos, episodes, fps=8, resize=True)


def test_templates_with_folders_seeds_and_other_names_of_views(videos, episodes):
    folder = videos.parent / "theirs"
    for episode in EPISODES:
        for seed in (1, 2):
            encode(folder / f"run7/{episode[8:]}/cam_high-{seed}.mp4", recorded(episode, "head"))
    config = {"name": "*/{episode}/{view}-{seed}.mp4", "views": {"cam_high": "head"}, "episode_id": "robot_a-{episode}"}
    with pytest.raises(DataError, match=r"unknown: run7/1/cam_high-1.mp4 \(no episode robot_a-1robot|no episode"):
        run(folder, episodes, **{**config, "episode_id": "robot-{episode}"})
    found, counts, _ = run(folder, episodes, **config)
    assert counts["views"] == ["head"]
    assert found.seeds("robot_a-1") == [1, 2]


def test_ctrl_world_s_pictures_of_two_rows_are_taken_apart(videos, episodes):
    """As its replay script writes them: recorded views above, predicted ones below, three side by side, at 4 frames/s."""
    folder = videos.parent / "synthetic_traj/Rollouts_replay/video"
    for episode in EPISODES:
        shown = [recorded(episode, view) for view in VIEWS]
        predicted = [255 - frames for frames in shown]
        picture = np.concatenate([np.concatenate(row, axis=2) for row in (shown, predicted)], axis=1)
        encode(folder / f"time_20251103_101500_traj_{episode[8:]}_0_5_lift_the_cube.mp4", picture, fps=4)
    config = {
        "name": "Rollouts_replay/video/time_*_traj_{episode}_0_5_*.mp4", "episode_id": "robot_a-{episode}", "fps": 8,
        "tiles": [[None, None, None], list(VIEWS)],
    }  # fmt: skip
    found, counts, _ = run(videos.parent / "synthetic_traj", episodes, **config)
    assert counts["frames"] == 2 * 3 * N
    assert close(found.frames("robot_a-1", "right_wrist"), 255 - recorded("robot_a-1", "right_wrist"))
    with pytest.raises(DataError, match="do not divide into 5 x 3 tiles"):
        run(videos.parent / "synthetic_traj", episodes, **config | {"tiles": [["head", None, None], *[[None] * 3] * 4]})


@pytest.mark.slow
def test_oscar_s_outputs_are_compared_from_their_start_frames_on(tmp_path):
    """As its README and its script say: recordings below assets, 81 frames of each from a frame of its own on."""
    grey = np.arange(40, 212, 2, dtype=np.uint8)[:, None, None, None]
    for name in ("rgb", "gripper_scenario"):
        encode(tmp_path / f"assets/agibot_360/{name}.mp4", np.broadcast_to(grey, (86, 24, 32, 3)), fps=15)
    encode(tmp_path / "outputs/agibot_360.mp4", np.broadcast_to(grey[5:], (81, 480, 640, 3)), fps=15)
    source = {**preset("oscar", tmp_path / "assets"), "image_size": [24, 32]}
    assert len(source["starts"]) == 14
    with pytest.raises(DataError, match=r"(?s)Not a video of the folder.*agibot_465/rgb.mp4"):
        curate(tmp_path / "set", source)
    start = source["starts"]["agibot_360/rgb.mp4"]
    with pytest.raises(DataError, match=r"too_short(?s:.*)expected: frames 6 to 86"):
        curate(tmp_path / "set", source | {"starts": {"agibot_360/rgb.mp4": start + 1}})
    _, curated = curate(tmp_path / "cases", source | {"starts": {"agibot_360/rgb.mp4": start}})
    assert [row.episode_id for row in curated.rows] == ["oscar-agibot_360-rgb"]
    assert close(curated.frames(0, "head"), np.broadcast_to(grey[5:], (81, 24, 32, 3)))
    _, counts, _ = run(tmp_path / "outputs", curated.root, layout="oscar", resize=True)
    assert (counts["frames"], counts["files"]) == (81, {"matched": 1})
    encode(tmp_path / "outputs/agibot_360.mp4", np.broadcast_to(grey[5:], (81, 32, 48, 3)), fps=15)
    with pytest.raises(DataError, match=r"48 x 32 pixels, the layout has 640 x 480") as refused:
        run(tmp_path / "outputs", curated.root, layout="oscar", resize=True)
    assert "1 problems" in str(refused.value)


def test_what_departs_from_a_layout_is_listed(episodes, tmp_path):
    """Samples of Cosmos' framework by their names alone; WorldArena's videos by rate, length and size too."""
    for episode in EPISODES:
        encode(tmp_path / f"samples/{episode}/vision.mp4", recorded(episode, "head"))
        encode(tmp_path / f"archive/fixed_scene_task_episode{episode[8:]}.mp4", recorded(episode, "head")[:-1])
    found, _, _ = run(tmp_path / "samples", episodes, layout="sim_bimanual")
    assert close(found.frames("robot_a-2", "head", 0), recorded("robot_a-2", "head"))
    with pytest.raises(DataError, match="got: 6 problems") as refused:
        run(tmp_path / "archive", episodes, layout="worldarena", episode_id="robot_a-{episode}")
    for line in (
        "episode1.mp4: 8 frames per second, the layout has 24",
        f"episode1.mp4: {N - 1} frames, a video has {N} as its recording",
        "episode2.mp4: 48 x 32 pixels, the layout has 640 x 480, or more in these proportions",
    ):
        assert f"fixed_scene_task_{line}" in str(refused.value)


def test_configurations_that_name_no_episode_or_no_view_are_refused():
    for values, message in (
        ({"name": "{view}.mp4"}, "needed are"), ({"name": "{episode}.mp4"}, "needed are"),
        ({"name": "{episode}_{view}_{camera}.mp4"}, "needed are"), ({"views": {"top": "ceiling"}}, "each once"),
        ({"tiles": [["head", "head"]], "name": "{episode}.mp4"}, "each once"),
        ({"views": {"": "head", "top": "left_wrist"}, "name": "{episode}.mp4"}, "needed are"),
        ({"layout": "cosmos"}, "worldarena"), ({"layout": "oscar", "episode_id": "oscar"}, "pattern"),
    ):  # fmt: skip
        with pytest.raises(ValidationError, match=message):
            ImportRolloutsConfig.model_validate({"method": "m", **values})
