"""Models that take control vectors, driven through every door with all cameras, with some, and with none."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rollout.conftest import SIZE, N, recorded, write_recordings  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import ActionTracks, open_controls, write_index
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import QuarantineRow, read_quarantine, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import WorldLineEnv
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.world_model_config import NativeVectors
from worldline_core.rollout.observation import Camera
from worldline_core.rollout.recorded_starts import RecordedStarts, read_start
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.rollout.worldline import WorldLine
from worldline_core.serving.play_session import PlaySession
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.serving.session_host import SessionHost

ROBOT = "ur5e_pair"
POSE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]])
CAMERAS = {view: Camera(np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), POSE) for view in VIEWS}
IMAGES = {view: recorded(seed, 1)[0] for seed, view in enumerate(VIEWS)}
CONTROLS = np.linspace(np.zeros(14), np.full(14, 0.3), N)
DRIVEN = ("film", "either", "either_causal")


def world_of(inputs: dict[str, Path], name: str) -> WorldLine:
    return WorldLine.from_pretrained(
        inputs["checkpoint"].parent / name, tokenizer=inputs["tokenizer"], steps=1, bfloat16=False
    )


def predict(world: WorldLine, cameras: dict[str, Camera], controls: np.ndarray = CONTROLS) -> np.ndarray:
    return np.stack([*world.predict(IMAGES, controls, cameras, embodiment=ROBOT).values()])


@pytest.mark.parametrize("name", DRIVEN)
def test_controls_drive_a_prediction_with_all_cameras_with_some_and_with_none(
    inputs: dict[str, Path], name: str
) -> None:
    world = world_of(inputs, name)
    whole, some, none = (predict(world, cameras) for cameras in (CAMERAS, {"head": CAMERAS["head"]}, {}))
    if name == "film":  # cameras change nothing of vectors
        assert np.array_equal(whole, some) and np.array_equal(whole, none)
    else:
        assert len({video.tobytes() for video in (whole, some, none)}) == 3
        alone = "stage2" if name == "either" else "causal"
        assert np.array_equal(whole, predict(world_of(inputs, alone), CAMERAS))  # maps alone, with the same weights
    assert not np.array_equal(none, predict(world, {}, CONTROLS[::-1]))
    simulation = world.start(IMAGES, {}, embodiment=ROBOT, state=CONTROLS[0], limits=False)
    (clip,) = simulation.step(CONTROLS[None, 1 : 1 + simulation.frames_per_step])
    assert np.array_equal(clip["head"], none[0][1 : 1 + simulation.frames_per_step])
    assert simulation.tool_poses.shape == (1, 2, 4, 4)


def test_what_cannot_be_driven_is_named(inputs: dict[str, Path], tmp_path: Path) -> None:
    maps, film = world_of(inputs, "causal"), world_of(inputs, "film")
    head = {"head": CAMERAS["head"]}
    missing = r"(?s)No camera of the view left_wrist, right_wrist.*got: head.*train_stage2\.native_size"
    with pytest.raises(DataError, match=missing):
        predict(maps, head)
    with pytest.raises(DataError, match=missing):
        maps.start(IMAGES, head, embodiment=ROBOT, state=CONTROLS[0])
    with pytest.raises(DataError, match="cameras are not those of the images"):
        predict(film, {"exterior": CAMERAS["head"]})
    foreign = r"(?s)does not know this robot's control vectors.*aloha_viperx, ur5e_pair.*got: viperx_pearl"
    with pytest.raises(DataError, match=foreign):
        film.predict(IMAGES, CONTROLS, CAMERAS, embodiment="viperx_pearl")
    made = write_recordings(tmp_path, [("a", "test", N, VIEWS, ()), ("b", "test", N, VIEWS, VIEWS)])
    for world, count in ((maps, 1), (film, 2)):
        starts = RecordedStarts(made["episodes"], view_sets=world.view_sets, fps=8, needs_cameras=world.needs_cameras)
        assert len(starts) == count
    with pytest.raises(ConfigError, match=r"(?s)takes action maps alone.*rollout\.cameras"):
        rollout(RolloutConfig(cameras=False), inputs | made, tmp_path / "out")
    either = inputs | made | {"checkpoint": inputs["checkpoint"].parent / "either_causal"}
    with pytest.raises(ConfigError, match=r"(?s)no control vectors.*rollout\.actions"):
        rollout(RolloutConfig(cameras=False, actions="mirrored"), either, tmp_path / "out")
    model, info = load_checkpoint(inputs["checkpoint"].parent / "either_causal")
    with pytest.raises(Exception, match="vectors: None, of a model that takes either"):
        save_checkpoint(tmp_path / "m", model, kind="causal", action_contract=info.contract, causal=info.causal)


def test_a_rollout_takes_maps_where_there_are_cameras_and_vectors_elsewhere(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    episodes = [("all", "test", N, VIEWS, VIEWS), ("some", "test", N, VIEWS, ("head",)), ("none", "test", N, VIEWS, ())]
    made = inputs | write_recordings(tmp_path, episodes)
    either = made | {"checkpoint": inputs["checkpoint"].parent / "either_causal"}
    config = RolloutConfig.model_validate({"num_frames": 17, "bfloat16": False})

    def videos(name: str, given: dict[str, Path], **changes: Any) -> dict[str, bytes]:
        rollout(config.model_copy(update=changes), given, tmp_path / name)
        found = RolloutSet.open(tmp_path / name)
        return {
            one: found.frames(one, "left_wrist").tobytes()
            for one in found.episode_ids
            if "left_wrist" in found.views(one)
        }

    maps, both = videos("maps", made), videos("both", either)
    assert set(maps) == {"all"}
    assert {row.reason for row in read_quarantine(tmp_path / "maps")} == {"missing_calibration"}
    assert set(both) == {"all", "some", "none"}
    assert both["all"] == maps["all"]
    blind = videos("blind", either, cameras=False)
    assert set(blind) == set(both)
    assert [blind[name] == both[name] for name in ("all", "some", "none")] == [False, False, True]
    untracked = {name: folder for name, folder in either.items() if name != "tracks"}
    assert videos("untracked", untracked) == blind

    model, info = load_checkpoint(either["checkpoint"])
    stranger = NativeVectors(embodiments=("aloha_viperx",), share=0.3)
    save_checkpoint(
        tmp_path / "stranger", model, kind="causal", action_contract=info.contract, causal=info.causal, vectors=stranger
    )
    known = videos("stranger", either | {"checkpoint": tmp_path / "stranger"})
    assert known == {"all": both["all"]}  # maps need not know the robot
    assert {row.reason for row in read_quarantine(tmp_path / "stranger")} >= {"unknown_embodiment"}


@pytest.mark.parametrize("cameras", [(), ("head",)])
def test_an_environment_a_server_and_the_page_drive_a_robot_without_cameras(
    inputs: dict[str, Path], tmp_path: Path, cameras: tuple[str, ...]
) -> None:
    world = world_of(inputs, "either_causal")
    made = write_recordings(tmp_path, [("a", "test", N, VIEWS, cameras)])
    environment = WorldLineEnv(model=world, recordings=made["episodes"], success=None, episode_frames=16)
    first, _ = environment.reset(seed=0)
    seen = first
    for _ in range(16):
        seen, *_ = environment.step(first["agent_pos"])
    assert not np.array_equal(seen["pixels"]["left_wrist"], first["pixels"]["left_wrist"])

    host = SessionHost(world, ServeConfig.model_validate({"episodes": made["episodes"], "output": tmp_path / "played"}))
    assert host.metadata()["needs_cameras"] is False
    start = {"op": "start", "images": IMAGES, "embodiment": ROBOT, "state": CONTROLS[0]}
    played: list[Any] = []

    async def send(content: str | bytes) -> None:
        played.append(json.loads(content) if isinstance(content, str) else content)

    async def drive() -> list[dict[str, Any]]:
        replies = [await host.handle(1, given) for given in (start, {"op": "start", "episode": "a"})]
        step = {"op": "step", "controls": CONTROLS[None, 1:17]}
        replies += [await host.handle(1, step | {"session": reply["session"]}) for reply in replies]
        page = PlaySession(host, send)
        await page.receive(json.dumps({"type": "start", "episode": "a"}))
        for _ in range(16):
            await page.receive(json.dumps({"type": "tick", "arms": [{"move": [0, 0, 1]}, {}]}))
        await page.receive('{"type": "save"}')
        await page.receive(
            json.dumps({"type": "tick", "arms": [{"goal": {"view": "left_wrist", "u": 0.5, "v": 0.5}}, {}]})
        )
        await page.close()
        return replies

    replies = asyncio.run(drive())
    assert all("error" not in reply for reply in replies), replies
    assert replies[2]["frames"]["head"].shape == (1, 16, *SIZE, 3)
    *_, saved, error = [
        message for message in played if not isinstance(message, bytes) and message["type"] in ("saved", "error")
    ]
    assert "view without a camera" in error["what"]
    episode = EpisodeSet.open(Path(saved["path"])).episode(0)
    assert (episode.num_frames, set(episode.cameras)) == (17, set(cameras))
    host.shut_down()


def test_an_observation_as_files_may_lack_cameras(inputs: dict[str, Path], tmp_path: Path) -> None:
    from PIL import Image

    world = world_of(inputs, "film")
    simulation = world.start(IMAGES, {}, embodiment=ROBOT, state=CONTROLS[0])
    for view, picture in IMAGES.items():
        Image.fromarray(picture).save(tmp_path / f"{view}.png")
    names = simulation.embodiment.state_names
    (tmp_path / "state.yaml").write_text("".join(f"{name}: 0.0\n" for name in names))
    found = read_start(tmp_path, simulation.embodiment, VIEWS, needs_cameras=False)
    assert (set(found.images), found.cameras) == (set(VIEWS), {})
    with pytest.raises(Exception, match=r"calibration\.yaml"):
        read_start(tmp_path, simulation.embodiment, VIEWS)


@pytest.mark.parametrize(
    ("reason", "known"),
    [("no_calibration", {"a", "b"}), ("invalid_controls", {"a"}), ("missing_actions", {"a"}), (None, {"a", "b"})],
)
def test_what_was_refused_for_its_controls_is_no_vector_either(
    tmp_path: Path, reason: str | None, known: set[str]
) -> None:
    made = write_recordings(tmp_path, [("a", "test", N, VIEWS, VIEWS), ("b", "test", N, VIEWS, ())])
    rows = [row for row in ActionTracks.open(made["tracks"]).rows if row["episode_id"] == "a"]
    write_index(made["tracks"], rows, sigma_px_ref=40.0)
    write_quarantine(made["tracks"], [QuarantineRow("b", "synthetic", reason, "", "{}")] if reason else [])
    episodes = EpisodeSet.open(made["episodes"])
    tracks = open_controls(made, episodes, vectors=True)
    assert set(tracks.episode_ids) == known
    assert tracks.calibrated_views("a") == VIEWS
    for name in known:
        native = tracks.tracks(name).native
        assert native is not None and np.array_equal(native, episodes.episode(episodes.position(name)).action)
    assert set(open_controls(made, episodes, vectors=False).episode_ids) == {"a"}
