"""Rollouts of the views that there are, of any length, and of models that take control vectors where cameras are missing."""

import asyncio
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError

from tests.rollout.conftest import SIZE, N, recorded, rolled, write_recordings
from worldline_core.actions.episode_tracks import ActionTracks, open_controls, write_index
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import QuarantineRow, read_quarantine, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import WorldLineEnv
from worldline_core.errors import CheckpointError, ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.model.world_model_config import NativeVectors, TrainedClips
from worldline_core.rollout.observation import Camera
from worldline_core.rollout.predictions import plan_predictions
from worldline_core.rollout.recorded_starts import RecordedStarts, read_start
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import FullClipConfig, RolloutConfig
from worldline_core.rollout.worldline import WorldLine
from worldline_core.serving.play_session import PlaySession
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.serving.session_host import SessionHost

HEAD, RIGHT = ("head",), ("head", "right_wrist")
SETS = (HEAD, VIEWS, RIGHT)
EPISODES = (
    ("three", "test", 33, VIEWS, VIEWS), ("two", "test", 33, RIGHT, RIGHT), ("one", "test", 33, HEAD, HEAD),
    ("uncalibrated-wrist", "test", 33, RIGHT, HEAD), ("long", "test", 70, VIEWS, VIEWS),
    ("no-head", "test", 33, VIEWS[1:], VIEWS[1:]), ("no-camera", "test", 33, HEAD, VIEWS[1:]),
    ("short", "test", 9, VIEWS, VIEWS),
)  # fmt: skip
CONFIG = RolloutConfig(method="causal", batch_size=8, bfloat16=False)


@pytest.fixture(scope="module")
def mixed(inputs, tmp_path_factory):
    """Recordings of several sets of views and lengths, some of which cannot be predicted, and a model of three sets."""
    root = tmp_path_factory.mktemp("mixed")
    return inputs | write_recordings(root, EPISODES) | {"checkpoint": trained_on(inputs, root / "sets", SETS)}


def trained_on(inputs, folder, view_sets, strides=(1,)):
    """The causal model as one that saw these sets of views, at these strides."""
    model, info = load_checkpoint(inputs["checkpoint"])
    trained = TrainedClips(view_sets=tuple(view_sets), strides=strides)
    save_checkpoint(folder, model, kind="causal", action_contract=info.contract, causal=info.causal, trained=trained)
    return folder


@pytest.fixture(scope="module")
def predicted(mixed, tmp_path_factory):
    return rolled(CONFIG, mixed, tmp_path_factory.mktemp("predicted"))


def test_every_recording_is_predicted_in_its_views_or_left_out_with_a_reason(predicted):
    rollouts, summary = predicted
    views = {name: tuple(view for view in VIEWS if view in rollouts.views(name)) for name in rollouts.episode_ids}
    assert views == {"long": VIEWS, "one": HEAD, "three": VIEWS, "two": RIGHT, "uncalibrated-wrist": HEAD}
    assert summary["left_out"] == {"missing_view": 1, "missing_calibration": 1, "too_short": 1}
    assert summary["without_view"] == {"left_wrist": 3, "right_wrist": 2}
    reasons = {row.episode_id: row.reason for row in read_quarantine(rollouts.root)}
    assert reasons == {"no-head": "missing_view", "no-camera": "missing_calibration", "short": "too_short"}
    assert len(views) + len(reasons) == len(EPISODES)


def test_a_prediction_does_not_depend_on_whose_views_share_the_run(mixed, predicted, tmp_path):
    together, alone = predicted[0], rolled(CONFIG, mixed, tmp_path, batch_size=1)[0]
    for row in together.rows:
        pair = [part.frames(row.episode_id, row.view).astype(int) for part in (together, alone)]
        # Single precision rounds sums of another batch size otherwise, at most by one grey level here.
        assert np.abs(pair[0] - pair[1]).max() <= 1, row
        assert np.abs(pair[0] - pair[1]).mean() < 1e-3


def test_the_views_that_are_asked_for_are_predicted_alone(mixed, tmp_path):
    found, summary = rolled(CONFIG, mixed, tmp_path, views=("right_wrist", "head"))
    assert {(row.episode_id, row.view) for row in found.rows} == {
        (name, view) for name in ("long", "three", "two") for view in RIGHT
    }
    assert summary["left_out"] == {"missing_view": 3, "missing_calibration": 1, "too_short": 1}
    for wrong in (("right_wrist",), ("head", "left_wrist"), ("head", "exterior_2"), ()):
        with pytest.raises(DataError, match=r"(?s)on these views together.*rollout\.views.*or head \+ right_wrist or"):
            rolled(CONFIG, mixed, tmp_path / "wrong", views=wrong)
    with pytest.raises(DataError, match=r"(?s)No episode can be predicted.*1 left out.*no video of head"):
        rollout(CONFIG, mixed | write_recordings(tmp_path / "none", EPISODES[5:6]), tmp_path / "none" / "out")


def test_views_that_were_not_trained_together_are_refused_everywhere(inputs, mixed, tmp_path):
    """Models of all views, of these and the head alone, and of the head alone: at every door but the rollout step's."""
    found, summary = rolled(CONFIG, mixed | {"checkpoint": inputs["checkpoint"]}, tmp_path / "out")
    assert {row.episode_id for row in found.rows} == {"three", "long"}
    assert summary["left_out"] == {"missing_view": 5, "too_short": 1}
    head = mixed | {"checkpoint": trained_on(inputs, tmp_path / "one", [HEAD])}
    found, summary = rolled(CONFIG, head, tmp_path / "out head")
    assert {row.view for row in found.rows} == {"head"} and "without_view" not in summary
    with pytest.raises(CheckpointError, match=r"trained.view_sets: \['exterior_2'\] are none of the model's views"):
        trained_on(inputs, tmp_path / "other", [("exterior_2",)])
    images = {view: np.zeros((*SIZE, 3), np.uint8) for view in VIEWS}
    camera = Camera(np.array([[40.0, 0, SIZE[1] / 2], [0, 40, SIZE[0] / 2], [0, 0, 1]]), np.eye(4))
    for name, sets, wrong in (("all", [VIEWS], HEAD), ("both", [VIEWS, HEAD], RIGHT), ("one", [HEAD], VIEWS)):
        folder = trained_on(inputs, tmp_path / name, sets)
        world = WorldLine.from_pretrained(folder, tokenizer=inputs["tokenizer"], bfloat16=False)
        assert (world.views, world.info.strides) == (sets[0], (1,))
        shown, cameras = {view: images[view] for view in wrong}, dict.fromkeys(wrong, camera)
        doors = {
            partial(world.predict, embodiment="ur5e_silver"): (shown, np.zeros((17, 14)), cameras),
            partial(world.start, embodiment="ur5e_silver", state=np.zeros(14)): (shown, cameras),
            world.session: (torch.zeros(1, len(wrong), 3, *SIZE), [0], wrong),
            partial(WorldLineEnv, model=world, views=wrong): (),
        }
        for door, arguments in doors.items():
            with pytest.raises(DataError, match=r"(?s)not trained on these views together.*expected:.*head"):
                door(*arguments)


def test_a_view_keeps_its_slot_whichever_others_are_there(inputs):
    """With cross-view attention switched off by distance nothing may move: the same vector and offset per view name."""
    model, _ = load_checkpoint(inputs["checkpoint"])
    latents = torch.randn(1, 3, 8, 2, 4, 6, generator=torch.Generator().manual_seed(0))
    level = torch.tensor([0.5])
    pair, wrong = (model(latents[:, [0, 2]], level, views=views).velocity for views in (RIGHT, VIEWS[:2]))
    swapped = model(latents[:, [2, 0]], level, views=RIGHT[::-1]).velocity
    torch.testing.assert_close(pair, swapped[:, [1, 0]], rtol=1e-4, atol=1e-5)
    assert not torch.allclose(pair, wrong, atol=1e-3)


@pytest.mark.slow
def test_whole_recordings_are_predicted_to_their_end(mixed, tmp_path):
    rollouts, summary = rolled(CONFIG, mixed, tmp_path, num_frames="whole", crf=0)
    counts = {row.episode_id: row.num_frames for row in rollouts.rows}
    assert counts == {name: n for name, _, n, *_ in EPISODES if name not in ("no-head", "no-camera")}
    assert rollouts.frames("long", "head").shape == (70, *SIZE, 3)
    # 70 = 1 + 5 blocks of 16 less 11; 9 = 1 + 1 block less 8: what lies after the end is cut off, and said.
    assert summary["cut_frames"] == 11 + 8
    assert summary["left_out"] == {"missing_view": 1, "missing_calibration": 1}
    shorter, _ = rolled(CONFIG, mixed, tmp_path / "numbered", num_frames=65, crf=0)
    difference = shorter.frames("long", "head").astype(int) - rollouts.frames("long", "head")[:65]
    assert np.abs(difference).max() <= 1  # the same blocks, sampled beside others


def pictures(videos):
    """The last pictures of videos, as a model begins at them."""
    return torch.stack([frames_to_video(videos[view][-1:])[:, 0] for view in VIEWS])[None]


def long_start(mixed):
    """First pictures and tracks of the long recording."""
    episodes = EpisodeSet.open(mixed["episodes"])
    first = {view: episodes.frames(episodes.position("long"), view, [0]) for view in VIEWS}
    return pictures(first), ActionTracks.open(mixed["tracks"]).tracks("long")


def test_stage2_goes_on_where_its_last_clip_ended(mixed, inputs):
    """A chain is what one gets by predicting again from the last picture, with the noise going on."""
    checkpoint = inputs["checkpoint"].parent / "stage2"
    options = {"tokenizer": inputs["tokenizer"], "bfloat16": False, "steps": 2}
    world = WorldLine.from_pretrained(checkpoint, clip_frames=17, **options)
    images, tracks = long_start(mixed)

    def pieces(world, frames):
        return [clips[0]["head"] for clips in world.stream(images, [tracks], frames, [42])]

    chained = pieces(world, 40)
    assert [len(piece) for piece in chained] == [1, 16, 16, 7]
    first = pieces(WorldLine.from_pretrained(checkpoint, **options), 17)
    assert np.array_equal(np.concatenate(chained)[:17], np.concatenate(first))
    session = world.session(images, [42])
    last = session.step(world.action_maps([tracks], range(0, 17, 4), views=VIEWS))[0]
    again = world.session(pictures(last), [42])
    again._sampler._noise = session._sampler._noise
    maps = world.action_maps([tracks], range(16, 33, 4), views=VIEWS)
    assert np.array_equal(again.step(maps)[0]["head"], chained[2])
    with pytest.raises(ValidationError, match=r"clip_frames\n.*1 \+ a multiple of 4"):
        FullClipConfig(clip_frames=16)


def test_a_causal_rollout_begins_anew_at_its_own_picture_every_few_blocks(mixed, inputs):
    """With anchors every two blocks, the third block is the first one of a rollout from the last picture of the second."""
    world = WorldLine.from_pretrained(inputs["checkpoint"], tokenizer=inputs["tokenizer"], bfloat16=False)
    images, tracks = long_start(mixed)
    free = [clips[0] for clips in world.stream(images, [tracks], 65, [42])]
    world.causal = world.causal.model_copy(update={"anchor_blocks": 2})
    pieces = [clips[0] for clips in world.stream(images, [tracks], 65, [42])]
    assert [len(piece["head"]) for piece in pieces] == [1, 16, 16, 16, 16]
    for view in VIEWS:
        assert all(np.array_equal(pieces[block][view], free[block][view]) for block in range(3))
        assert not np.array_equal(pieces[3][view], free[3][view])
    session = world.session(pictures(pieces[2]), [42])
    for _ in range(2):  # the noise goes on
        session._sampler.noise.draw((3, world.model.config.latent_channels, 4, *world.contract.grid_size))
    for block in (3, 4):
        maps = world.action_maps([tracks], range(16 * (block - 1), 16 * block + 1, 4), views=VIEWS)
        assert np.array_equal(session.step(maps)[0]["head"], pieces[block]["head"])


def test_strides_are_those_of_the_training(inputs, mixed, tmp_path):
    strided = CONFIG.model_copy(update={"stride": 2, "num_frames": "whole"})
    with pytest.raises(CheckpointError, match=r"(?s)not trained at this stride.*\(1,\).*got: 2"):
        rollout(strided, mixed, tmp_path / "refused")
    model = trained_on(inputs, tmp_path / "model", [VIEWS], (1, 2))
    rollouts, _ = rolled(strided, mixed | {"checkpoint": model}, tmp_path / "out", crf=0)
    found = rollouts.frames("long", "head").astype(int)
    assert (rollouts.fps, len(found)) == (4.0, 35)
    # Every second control of the recording is what a recording at half the rate would hold.
    world = WorldLine.from_pretrained(model, tokenizer=inputs["tokenizer"], bfloat16=False)
    images, tracks = long_start(mixed)

    def difference(frames):
        clips = world.stream(images, [tracks.clip(frames)], 35, list(CONFIG.seeds))
        return float(np.abs(np.concatenate([clip["head"] for (clip,) in clips]).astype(int) - found).mean())

    # The colours of the stored video are rounded.
    assert difference(range(0, 70, 2)) < 0.5
    assert difference(range(35)) > 1


def test_recordings_of_another_rate_are_left_out(mixed):
    episodes, tracks = EpisodeSet.open(mixed["episodes"]), ActionTracks.open(mixed["tracks"])
    chosen = [episodes.position(name) for name in ("three", "two")]
    episodes.rows[chosen[1]] = replace(episodes.rows[chosen[1]], fps=5.0)
    facts = {"views": VIEWS, "view_sets": SETS, "frames_per_unit": 16, "takes_maps": True, "vector_robots": ()}
    model = SimpleNamespace(**facts, unit=lambda frames: 16)
    planned, left_out = plan_predictions(CONFIG, episodes, tracks, chosen, model, 8.0)
    assert [item.episode_id for item in planned] == ["three"]
    assert [row.reason for row in left_out] == ["wrong_fps"]


ROBOT = "ur5e_pair"
POSE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]])
CAMERAS = {view: Camera(np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), POSE) for view in VIEWS}
IMAGES = {view: recorded(seed, 1)[0] for seed, view in enumerate(VIEWS)}
CONTROLS = np.linspace(np.zeros(14), np.full(14, 0.3), N)
DRIVEN = ("film", "either", "either_causal")


def world_of(inputs, name):
    folder = inputs["checkpoint"].parent / name
    return WorldLine.from_pretrained(folder, tokenizer=inputs["tokenizer"], steps=1, bfloat16=False)


def predict(world, cameras, controls=CONTROLS):
    return np.stack([*world.predict(IMAGES, controls, cameras, embodiment=ROBOT).values()])


@pytest.mark.parametrize("name", DRIVEN)
def test_controls_drive_a_prediction_with_all_cameras_with_some_and_with_none(inputs, name):
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


def test_what_cannot_be_driven_is_named(inputs, tmp_path):
    maps, film = world_of(inputs, "causal"), world_of(inputs, "film")
    head = {"head": CAMERAS["head"]}
    missing = r"No camera of the view left_wrist, right_wrist.*got: head.*train_stage2\.native_size"
    foreign = "does not know this robot's control vectors.*aloha_viperx, ur5e_pair.*got: viperx_pearl"
    for ask, message in (
        (lambda: predict(maps, head), missing),
        (lambda: maps.start(IMAGES, head, embodiment=ROBOT, state=CONTROLS[0]), missing),
        (lambda: predict(film, {"exterior": CAMERAS["head"]}), "cameras are not those of the images"),
        (lambda: film.predict(IMAGES, CONTROLS, CAMERAS, embodiment="viperx_pearl"), foreign),
    ):
        with pytest.raises(DataError, match=f"(?s){message}"):
            ask()
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


def test_a_rollout_takes_maps_where_there_are_cameras_and_vectors_elsewhere(inputs, tmp_path):
    sets = {"all": VIEWS, "some": ("head",), "none": ()}
    episodes = [(name, "test", 17, VIEWS, calibrated) for name, calibrated in sets.items()]
    made = inputs | write_recordings(tmp_path, episodes)
    either = made | {"checkpoint": inputs["checkpoint"].parent / "either_causal"}
    config = RolloutConfig.model_validate({"num_frames": 17, "bfloat16": False})

    def videos(name, given, **changes):
        found, _ = rolled(config, given, tmp_path / name, **changes)
        names = [one for one in found.episode_ids if "left_wrist" in found.views(one)]
        return {one: found.frames(one, "left_wrist").tobytes() for one in names}

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
    given = {"action_contract": info.contract, "causal": info.causal}
    stranger = NativeVectors(embodiments=("aloha_viperx",), share=0.3)
    save_checkpoint(tmp_path / "stranger", model, kind="causal", vectors=stranger, **given)
    known = videos("stranger", either | {"checkpoint": tmp_path / "stranger"})
    assert known == {"all": both["all"]}  # maps need not know the robot
    assert {row.reason for row in read_quarantine(tmp_path / "stranger")} >= {"unknown_embodiment"}


def test_an_environment_a_server_and_the_page_drive_a_robot_without_cameras(inputs, tmp_path):
    world = world_of(inputs, "either_causal")
    made = write_recordings(tmp_path, [("a", "test", N, VIEWS, ("head",))])
    environment = WorldLineEnv(model=world, recordings=made["episodes"], success=None, episode_frames=16)
    first, _ = environment.reset(seed=0)
    for _ in range(16):
        seen, *_ = environment.step(first["agent_pos"])
    assert not np.array_equal(seen["pixels"]["left_wrist"], first["pixels"]["left_wrist"])

    host = SessionHost(world, ServeConfig.model_validate({"episodes": made["episodes"], "output": tmp_path / "played"}))
    assert host.metadata()["needs_cameras"] is False
    start = {"op": "start", "images": IMAGES, "embodiment": ROBOT, "state": CONTROLS[0]}
    played = []

    async def send(content):
        played.append(json.loads(content) if isinstance(content, str) else content)

    async def drive():
        replies = [await host.handle(1, given) for given in (start, {"op": "start", "episode": "a"})]
        step = {"op": "step", "controls": CONTROLS[None, 1:17]}
        replies += [await host.handle(1, step | {"session": reply["session"]}) for reply in replies]
        page = PlaySession(host, send)
        await page.receive(json.dumps({"type": "start", "episode": "a"}))
        for _ in range(16):
            await page.receive(json.dumps({"type": "tick", "arms": [{"move": [0, 0, 1]}, {}]}))
        await page.receive('{"type": "save"}')
        goal = {"view": "left_wrist", "u": 0.5, "v": 0.5}
        await page.receive(json.dumps({"type": "tick", "arms": [{"goal": goal}, {}]}))
        await page.close()
        return replies

    replies = asyncio.run(drive())
    assert all("error" not in reply for reply in replies), replies
    assert replies[2]["frames"]["head"].shape == (1, 16, *SIZE, 3)
    told = [message for message in played if not isinstance(message, bytes)]
    *_, saved, error = [message for message in told if message["type"] in ("saved", "error")]
    assert "view without a camera" in error["what"]
    episode = EpisodeSet.open(Path(saved["path"])).episode(0)
    assert (episode.num_frames, set(episode.cameras)) == (17, {"head"})
    host.shut_down()


def test_an_observation_as_files_may_lack_cameras(tmp_path):
    robot = load_embodiment(ROBOT)
    for view, picture in IMAGES.items():
        Image.fromarray(picture).save(tmp_path / f"{view}.png")
    state = dict.fromkeys(robot.state_names, 0.0)
    (tmp_path / "state.yaml").write_text(json.dumps(state))
    found = read_start(tmp_path, robot, VIEWS, needs_cameras=False)
    assert (set(found.images), found.cameras) == (set(VIEWS), {})
    with pytest.raises(Exception, match=r"calibration\.yaml"):
        read_start(tmp_path, robot, VIEWS)
    # Cameras as `worldline calibrate estimate` writes them: that of a wrist is where the state has the tool.
    height, width = next(iter(IMAGES.values())).shape[:2]
    known = {"width": width, "height": height, "K": [[60, 0, width / 2], [0, 60, height / 2], [0, 0, 1]]}
    still = known | {"maps": "camera_to_base", "axes": "opencv", "T": np.eye(4).tolist()}
    mount = np.eye(4)
    mount[:3, 3] = 0.06, 0.0, -0.05
    views = {view: known | {"T_tool_camera": mount.tolist()} if "wrist" in view else still for view in VIEWS}
    (tmp_path / "calibration.yaml").write_text(json.dumps({"views": views}))
    found = read_start(tmp_path, robot, VIEWS)
    tools = ArmKinematics(robot).tool_poses(found.state[None]).numpy()[0]
    by_view = {arm.camera_view: tool for arm, tool in zip(robot.arms, tools, strict=True)}
    for view in VIEWS:
        expected = by_view[view] @ mount if "wrist" in view else np.eye(4)
        assert np.allclose(found.cameras[view].T_base_camera, expected, atol=1e-6)
    for name, content, said in (
        ("calibration.yaml", {"views": {"head": still}}, r"(?s)each view.*view left_wrist.*got: nothing"),
        ("left_wrist.png", None, r"(?s)Not a picture to start from.*left_wrist.png"),
        ("state.yaml", state | {robot.state_names[0]: "zero"}, r"(?s)Not the robot's state.*left/shoulder_pan_joint"),
    ):
        (tmp_path / name).write_text(json.dumps(content))
        with pytest.raises(DataError, match=said):
            read_start(tmp_path, robot, VIEWS)


def test_what_was_refused_for_its_controls_is_no_vector_either(tmp_path):
    made = write_recordings(tmp_path, [("a", "test", 5, VIEWS, VIEWS), ("b", "test", 5, VIEWS, ())])
    rows = [row for row in ActionTracks.open(made["tracks"]).rows if row["episode_id"] == "a"]
    write_index(made["tracks"], rows, sigma_px_ref=40.0)
    episodes = EpisodeSet.open(made["episodes"])
    for reason, known in (("no_calibration", "ab"), ("invalid_controls", "a"), ("missing_actions", "a"), (None, "ab")):
        write_quarantine(made["tracks"], [QuarantineRow("b", "synthetic", reason, "", "{}")] if reason else [])
        tracks = open_controls(made, episodes, vectors=True)
        assert set(tracks.episode_ids) == {*known}, reason
        assert tracks.calibrated_views("a") == VIEWS
        for name in known:
            native = tracks.tracks(name).native
            assert native is not None and np.array_equal(native, episodes.episode(episodes.position(name)).action)
    assert set(open_controls(made, episodes, vectors=False).episode_ids) == {"a"}
