"""A robot of the user's own: named by the path of its file, or put into configs/embodiments of the working folder."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import run
from tests.data.published_lerobot import write_droid
from tests.data.test_lerobot import source
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.geometry import embodiment as embodiments
from worldline_core.geometry.embodiment import EMBODIMENT_ROOT, embodiment_names, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.store.store import ArtifactStore

STATE = {"feature": "observation.state"}
ARM = {
    "name": "right",
    "state": {
        "joints": {**STATE, "columns": ["joint_*"]},
        "gripper": {**STATE, "columns": ["gripper"], "closed": -1, "open": 1},
    },
}


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(embodiments, "_carried", {})
    return tmp_path


def write_robot(folder: Path, name: str = "my_arm") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text = (EMBODIMENT_ROOT / "droid_franka.yaml").read_text().replace("droid_franka", name)
    text = re.sub(r"- \[-?\d+\.\d+, -?\d+\.\d+\]", "- [-7.0, 7.0]", text)
    (folder / f"{name}.yaml").write_text(text)
    description = (EMBODIMENT_ROOT / "franka_panda.xml").read_text()
    (folder / "franka_panda.xml").write_text(f"{description}<!-- the user's copy -->\n")
    return folder / f"{name}.yaml"


@pytest.mark.parametrize(("folder", "named"), [("robots", "robots/my_arm.yaml"), ("configs/embodiments", "my_arm")])
def test_recordings_of_an_own_robot_carry_it(working_folder: Path, folder: str, named: str) -> None:
    robot = write_robot(working_folder / folder)
    write_droid(working_folder / "raw")
    counts, curated = run(working_folder, source(working_folder / "raw", embodiment=named, arms=[ARM]))
    assert (counts["kept"], {row.embodiment for row in curated.rows}) == (2, {"my_arm"})
    filtered = working_folder / "filtered"
    filter_episodes(FilterConfig(min_segment_frames=5), {"episodes": working_folder / "out"}, filtered)
    # The files that it was described by may go, and another process knows only the set.
    expected = ArmKinematics(load_embodiment(robot)).tool_poses(np.zeros((1, 8)))
    robot.rename(working_folder / "elsewhere.yaml")
    embodiments._carried.clear()
    assert "my_arm" not in embodiment_names()
    run(working_folder / "again", {"kind": "episode_set", "path": str(working_folder / "out"), "name": "again"})
    assert (working_folder / "again/out/embodiments/my_arm.yaml").is_file()
    embodiments._carried.clear()
    EpisodeSet.open(filtered)
    assert "my_arm" in embodiment_names()
    assert np.array_equal(ArmKinematics(load_embodiment("my_arm")).tool_poses(np.zeros((1, 8))), expected)


def test_a_changed_robot_is_new_work(working_folder: Path) -> None:
    robot, store = write_robot(working_folder / "robots"), ArtifactStore(working_folder / "artifacts")
    raw = source(working_folder / "raw", embodiment="robots/my_arm.yaml", arms=[ARM])
    config = CurateConfig.model_validate({"sources": [raw]})
    keys = [store.key("curate", 1, config, {})]
    for path, old, new in ((robot, "0.155", "0.156"), (robot.with_name("franka_panda.xml"), "0.333", "0.334")):
        path.write_text(path.read_text().replace(old, new))
        keys.append(store.key("curate", 1, config, {}))
    assert len(set(keys)) == 3
    # What ships with the project is part of its version.
    shipped = CurateConfig.model_validate({"sources": [{**raw, "embodiment": "droid_franka"}]})
    assert not shipped.weights_read()


def test_one_name_is_one_robot(working_folder: Path) -> None:
    write_robot(working_folder / "configs/embodiments", "droid_franka")
    with pytest.raises(ConfigError, match=r"(?s)Two files describe one robot differently.*droid_franka"):
        load_embodiment("droid_franka")
    (working_folder / "configs/embodiments/droid_franka.yaml").unlink()
    first, second = write_robot(working_folder / "a"), write_robot(working_folder / "b")
    second.write_text(second.read_text().replace("0.155", "0.2"))
    with pytest.raises(ConfigError, match=r"(?s)Two files describe one robot differently.*my_arm"):
        embodiments.carry_embodiments([first, second])
    for wrong, message in (("gone.yaml", "gone.yaml"), ("my_robot", "configs/embodiments/my_robot.yaml")):
        with pytest.raises((ValidationError, ConfigError), match=message):
            CurateConfig.model_validate({"sources": [source(working_folder, embodiment=wrong)]})
