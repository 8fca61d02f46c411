"""Every embodiment whose description is here against MuJoCo, and the commands around it."""

from __future__ import annotations

import os
import re
import sys

import pytest

from flows.command_line import main
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry import kinematic_tree
from worldline_core.geometry.embodiment import embodiment_names, load_embodiment
from worldline_core.geometry.embodiment_report import check_embodiment

pytest.importorskip("mujoco", reason="the independent kinematics are MuJoCo's")


@pytest.mark.parametrize("name", embodiment_names())
def test_kinematics_equal_mujoco_at_a_hundred_random_positions(name):
    embodiment = load_embodiment(name)
    if not embodiment.description_path.is_file():
        pytest.skip(f"the description of {name} is not here")
    check = check_embodiment(embodiment, samples=100)
    frames = [(error["kind"], error["frame"]) for error in check["errors"]]
    for arm in embodiment.arms:
        assert ("end-effector", arm.end_effector_link) in frames
        assert ("tool", arm.name) in frames
        assert arm.wrist_camera is None or ("camera", arm.camera_view) in frames
    assert check["passed"]
    # The promise is 1e-5; in float64 all of it is rounding.
    assert max(max(error["position_m"], error["rotation_rad"]) for error in check["errors"]) <= 1e-12
    assert not [note for note in check["notes"] if "limits" in note]


def test_agibot_equals_mujoco(shared_data):
    urdf = shared_data / "agibot_g1_urdf" / "G1_omnipicker_calibrated.urdf"
    if not urdf.is_file():
        pytest.skip("the AgiBot G1 URDF is not here")
    check = check_embodiment(load_embodiment("agibot_g1", urdf), samples=100)
    assert check["passed"]
    assert max(error["position_m"] for error in check["errors"]) <= 1e-9


def break_the_reader(monkeypatch: pytest.MonkeyPatch, metres: float) -> None:
    """The reader on our side puts the flange of the Panda somewhere else."""
    read = kinematic_tree.read_mjcf

    def wrong(text, where):
        tree = read(text, where)
        next(body for body in tree.walk() if body.name == "panda_link8").T_parent_body[0, 3] += metres
        return tree

    monkeypatch.setattr(kinematic_tree, "read_mjcf", wrong)
    monkeypatch.setattr(kinematic_tree, "_read", kinematic_tree._read.__wrapped__)  # not cached


@pytest.mark.parametrize(("metres", "passed"), [(2e-5, False), (5e-6, True)])
def test_a_wrong_pose_is_found(monkeypatch, metres, passed):
    break_the_reader(monkeypatch, metres)
    check = check_embodiment(load_embodiment("franka_panda"), samples=20)
    assert check["passed"] is passed
    flange = next(error for error in check["errors"] if error["kind"] == "end-effector")
    assert flange["position_m"] == pytest.approx(metres, rel=1e-6)


def test_other_limits_than_the_description_has_are_noted(tmp_path):
    source = load_embodiment("franka_panda").description_path
    text = (source.parent / "franka_panda.yaml").read_text().replace("[-1.7628, 1.7628]", "[-1.7628, 2.0]")
    (tmp_path / "franka_panda.yaml").write_text(text)
    (tmp_path / "franka_panda.xml").write_text(source.read_text())
    (note,) = check_embodiment(load_embodiment(tmp_path / "franka_panda.yaml"), samples=2)["notes"]
    assert note.startswith("panda_joint2: limits -1.7628 to 2,")


def test_a_check_needs_mujoco_and_samples(monkeypatch):
    with pytest.raises(ConfigError, match="--samples of at least 1"):
        check_embodiment(load_embodiment("so101"), samples=0)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UnavailableError, match=r"MuJoCo[\s\S]*--extra sim"):
        check_embodiment(load_embodiment("so101"), samples=2)


def test_list_names_every_embodiment_and_how_to_get_its_description(capsys, monkeypatch):
    for name in [name for name in os.environ if name.startswith("WORLDLINE_DESCRIPTION_")]:
        monkeypatch.delenv(name)
    main(["embodiment", "list"])
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.split("\n\n")[0].splitlines()[1:]] == embodiment_names()
    assert "set WORLDLINE_DESCRIPTION_GALAXEA_R1=" in text
    with pytest.raises(SystemExit, match="1"):
        main(["embodiment", "check", "galaxea_r1"])
    assert "github.com/userguide-galaxea/URDF" in capsys.readouterr().err


def test_check_command_ends_with_status_one_on_a_wrong_pose(capsys, monkeypatch):
    main(["embodiment", "check", "franka_panda", "--samples", "5"])
    break_the_reader(monkeypatch, 1e-3)
    with pytest.raises(SystemExit, match="1"):
        main(["embodiment", "check", "franka_panda", "--samples", "5"])
    assert re.search(r"panda_link8 .*FAILED", capsys.readouterr().out)
