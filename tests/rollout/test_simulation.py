"""The public entry: first images and controls in, videos out; and simulations that are stepped, branched, and know where the robot is."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from tests.rollout.conftest import ROBOT
from worldline_core import Camera, WorldLine
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CalibrationError, CheckpointError, ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.tokenizers import PatchDecoding, frames_to_video
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.rollout.simulation import CommandedRobot, LazyFrames, Session, Undecoded

FRAMES = 17


@pytest.fixture(scope="module")
def observed(held_out):
    """With a camera pose of the head alone."""
    cameras = {view: Camera(camera.K) for view, camera in held_out[0].cameras.items()}
    cameras["head"] = held_out[0].cameras["head"]
    return replace(held_out[0], cameras=cameras, controls=held_out[0].controls[:FRAMES])


@pytest.fixture
def start(held_out):
    return held_out[0]


@pytest.fixture(scope="module")
def models(shipped):
    return shipped / "models"


@pytest.fixture(scope="module")
def causal(models):
    return WorldLine.from_pretrained(models / "causal")


@pytest.mark.parametrize(("kind", "sampler", "steps"), [("causal", "block_causal", None), ("stage2", "full_clip", 1)])
def test_a_prediction_is_the_rollout_steps(observed, models, tmp_path, kind, sampler, steps):
    tracks, _ = compute_tracks(observed.episode, ArmKinematics(load_embodiment(ROBOT)))
    write_index(tmp_path / "tracks", write_shard(tmp_path / "tracks", 0, [tracks]), sigma_px_ref=36.0)
    config = RolloutConfig.model_validate({
        "sampler": {"kind": sampler, "steps": steps}, "num_frames": FRAMES, "embodiments": [ROBOT],
        "max_episodes_per_embodiment": 1,
    })  # fmt: skip
    inputs = {"episodes": observed.root, "tracks": tmp_path / "tracks", "tokenizer": models / "tokenizer"}
    rollout(config, inputs | {"checkpoint": models / kind}, tmp_path / "rollout")
    world = WorldLine.from_pretrained(models / kind, steps=steps)
    predicted = world.predict(observed.images, observed.controls, observed.cameras, embodiment=ROBOT)
    writer = RolloutSetWriter(tmp_path / "mine", "worldline", 8.0)
    writer.add(observed.episode.episode_id, 42, predicted)
    writer.close()
    expected, mine = RolloutSet.open(tmp_path / "rollout"), RolloutSet.open(tmp_path / "mine")
    for view in world.views:
        assert (predicted[view].shape, predicted[view].dtype) == ((FRAMES, 64, 96, 3), np.uint8)
        assert np.array_equal(*(found.frames(observed.episode.episode_id, view) for found in (mine, expected))), view


def test_controls_of_whole_intervals_drive_a_model_that_has_not_learnt_from_them_as_before(observed, causal, models):
    adapt = lambda config: config.model_copy(update={"action_frames": 4})  # noqa: E731
    model, info = load_checkpoint(models / "causal", adapt=adapt)
    world = WorldLine(model, info.model_copy(update={"config": model.config}), causal.tokenizer)
    given = (observed.images, observed.controls, observed.cameras)
    before, after = (simulator.predict(*given, embodiment=ROBOT) for simulator in (causal, world))
    assert all(np.abs(before[view].astype(int) - after[view]).max() <= 2 for view in before)


def pictures_and_maps(world, observed, steps):
    """First pictures of every view, and random action maps of some steps."""
    images = [frames_to_video(observed.images[view][None], world.image_size)[:, 0] for view in world.views]
    size = (1, len(world.views), world.info.config.control_channels, 1 + world.causal.block_size)
    generator = torch.Generator().manual_seed(0)
    maps = [torch.randn(*size, *world.contract.grid_size, generator=generator) for _ in range(steps)]
    return torch.stack(images)[None], maps


def test_weights_in_bfloat16_predict_nearly_the_same(observed, causal, models):
    half = WorldLine.from_pretrained(models / "causal", weights="bfloat16")
    assert half.model.proj_in.weight.dtype == torch.bfloat16
    images, (maps,) = pictures_and_maps(causal, observed, 1)
    (expected,), (found,) = (line.session(images, [42]).step(maps) for line in (causal, half))
    for view, frames in expected.items():
        assert np.abs(found[view].astype(int) - frames).mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize("anchor_blocks", [1, None, 2])
def test_decoding_one_block_while_the_next_is_sampled_changes_nothing(observed, causal, anchor_blocks):
    images, maps = pictures_and_maps(causal, observed, 4)
    spec = causal.causal.model_copy(update={"anchor_blocks": anchor_blocks})

    def blocks(*, overlapped):
        sampler = BlockCausalSimulator(causal.model, spec, noise=Noise([42]), views=causal.views)
        session = Session(sampler, causal.tokenizer, images, device="cpu", bfloat16=False)
        return [clips[0] for clips in session.steps(maps, overlapped=overlapped)]

    for one, other in zip(blocks(overlapped=True), blocks(overlapped=False), strict=True):
        assert all(np.array_equal(one[view], other[view]) for view in causal.views)


def shifted(T, factor):
    return T * np.array([[1, 1, 1, factor]] * 3 + [[1] * 4])


SHEARED = np.eye(4) + np.eye(4, k=1) * 0.01
UNUSABLE = (np.full((3, 3), np.nan), np.zeros((3, 3)), np.diag([80.0, -80.0, 1.0]))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda K, T: (K, None), DataError, "camera without a pose.*head"),
        (lambda K, T: (K, np.eye(3)), DataError, "camera pose has a wrong shape"),
        (lambda K, T: (K, SHEARED), CalibrationError, "not a rigid transform"),
        (lambda K, T: (K, shifted(T, 1000.0)), CalibrationError, "too far from the robot.*head"),
        (lambda K, T: (K, shifted(T, 1e38)), CalibrationError, "too far from the robot.*head"),
        *((lambda K, T, of=of: (np.diag([of, of, 1.0]) @ K, T), CalibrationError, "another image size.*head") for of in (0.5, 2, 10 / 3)),
        *((lambda _, T, K=K: (K, T), CalibrationError, "camera matrix is not usable.*head") for K in UNUSABLE),
    ],
)  # fmt: skip
def test_a_camera_that_cannot_be_right_is_refused(observed, causal, change, error, message):
    head = observed.cameras["head"]
    cameras = observed.cameras | {"head": Camera(*change(head.K, head.T_base_camera))}
    with pytest.raises(error, match=f"(?s){message}"):
        causal.predict(observed.images, observed.controls, cameras, embodiment=ROBOT)


def test_what_does_not_fit_is_refused(observed, causal, models, tmp_path):
    images, controls = observed.images, observed.controls
    grippers = np.isin(np.arange(14), [6, 13])
    beyond = (
        np.degrees(controls), controls * 100, controls.astype(complex), np.where(grippers, 2.0, controls),
        np.ma.masked_less(controls, 0.0),
    )  # fmt: skip
    for changes, error, message in (
        ({"controls": controls[:16]}, DataError, r"1 \+ k \* 16 rows.*got: 16"),
        ({"controls": controls[:17, :7]}, DataError, r"where: controls, .*got: \(17, 7\)"),
        ({"images": {"left_wrist": images["left_wrist"]}}, DataError, "not trained on these views together"),
        ({"images": images | {"head": images["head"][:8]}}, DataError, "RGB and of one size"),
        ({"images": images | {"head": images["head"] / 255}}, DataError, "arrays of uint8"),
        (
            {"cameras": {}},
            DataError,
            "No camera of the view head, left_wrist, right_wrist: the model takes action maps",
        ),
        ({"embodiment": "ur55_pair"}, ConfigError, "Unknown embodiment"),
        *(({"controls": wrong}, DataError, "beyond its|array of numbers") for wrong in beyond),
        *(({"seed": seed}, DataError, "Not a seed") for seed in (1.5, True, "1", -1)),
    ):
        usual = {"images": images, "controls": controls, "cameras": observed.cameras, "embodiment": ROBOT}
        with pytest.raises(error, match=f"(?s){message}"):
            causal.predict(**usual | changes)
    with pytest.raises(CheckpointError, match="tokenizer is not here"):
        WorldLine.from_pretrained(models / "causal", tokenizer=tmp_path / "none")
    with pytest.raises(CheckpointError, match=r"(?s)wrong kind.*stage2 or causal.*base"):
        WorldLine.from_pretrained(models / "base")


def test_a_name_that_the_package_lacks_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'Simulator'"):
        __import__("worldline_core").Simulator  # noqa: B018


ARMS = load_embodiment(ROBOT)
GRIPPERS = [ARMS.gripper_column(arm) for arm in ARMS.arms]


def videos(simulation, controls):
    """All pictures of a simulation that is at its start, driven by ``(b, 1 + steps, j)``; row 0 belongs to the start."""
    pieces = [[{view: picture[None] for view, picture in clip.items()} for clip in simulation.pictures]]
    unit = simulation.frames_per_step
    pieces += [simulation.step(controls[:, begin : begin + unit]) for begin in range(1, controls.shape[1], unit)]
    return [
        {view: np.concatenate([piece[clip][view] for piece in pieces]) for view in simulation.views}
        for clip in range(len(simulation))
    ]


def equal(one, other, *, grey_levels=0):
    close = partial(np.allclose, rtol=0, atol=grey_levels)
    return list(one) == list(other) and all(close(one[view].astype(int), other[view]) for view in one)


def last(predicted):
    return {view: video[-1] for view, video in predicted.items()}


@pytest.mark.slow
def test_steps_give_the_bytes_of_a_prediction(causal, start):
    """With mounts that the file knows and ones solved at the start."""
    wrists = {view: Camera(start.cameras[view].K) for view in ("left_wrist", "right_wrist")}
    for given in (replace(start, cameras=start.cameras | wrists), start):
        predicted = causal.predict(given.images, start.controls, given.cameras, embodiment=ROBOT)
        simulation = given.begin(causal)
        assert equal(videos(simulation, start.controls[None])[0], predicted)
        assert (simulation.num_frames, simulation.frames_per_step, simulation.fps) == (33, 16, 8.0)
        assert equal(simulation.pictures[0], last(predicted))
    # Limits change nothing of commands within them.
    assert equal(videos(start.begin(causal, limits=True), start.controls[None])[0], predicted)


@pytest.mark.slow
def test_frames_that_are_decoded_when_they_are_read_are_the_same(causal, start, held_out):
    """In any order, by number, slice and list; each latent frame once; beyond the picture at which a clip begins anew."""
    two = [start, held_out[1]]
    rows = np.stack([one.controls for one in two])
    begun = lambda: causal.start(  # noqa: E731
        [one.images for one in two], [one.cameras for one in two], embodiment=ROBOT, state=rows[:, 0], seed=[0, 1]
    )
    whole, lazy = begun(), begun()
    decoded = []
    one_by_one = PatchDecoding.__call__
    for begin in (1, 17, 17):  # the last one is of another clip of the model: it begins anew
        frames, later = whole.step(rows[:, begin : begin + 16]), lazy.step_lazily(rows[:, begin : begin + 16])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                PatchDecoding, "__call__", lambda own, codes: decoded.append(len(codes)) or one_by_one(own, codes)
            )
            for own, other in zip(frames, later, strict=True):
                for view in causal.views:
                    assert len(other[view]) == 16
                    assert np.array_equal(other[view][-1], own[view][-1])
                    assert not decoded  # it was at hand
                    for index in (5, [9, 4, 4, 15], [], slice(0, 12, 5), slice(None)):
                        np.testing.assert_allclose(other[view][index].astype(int), own[view][index], atol=1)
                    assert len(decoded) == 3 and decoded.clear() is None  # those of 5, of 9, and of 0
                    assert np.array_equal(np.asarray(other[view]), other[view][:])
        assert equal(whole.pictures[0], lazy.pictures[0], grey_levels=1)


def test_joined_videos_share_what_is_decoded():
    video = np.arange(12, dtype=np.uint8).repeat(12).reshape(12, 2, 2, 3)
    asked = []

    def decode(latents):
        asked.append(latents[0, 0, :, 0, 0].tolist())
        return [np.concatenate([video[4 * int(number) :][:4] for number in asked[-1]])]

    undecoded = Undecoded(decode, torch.arange(2.0).reshape(1, 1, 2, 1, 1), 4)
    first = LazyFrames([undecoded, video[8:10]])
    joined = LazyFrames.joined(first, video[10:])
    assert (len(first), len(joined)) == (10, 12)
    assert np.array_equal(joined[[11, 6, 8]], video[[11, 6, 8]])
    assert asked == [[1.0]]
    assert np.array_equal(first[:], video[:10])
    assert np.array_equal(joined[:], video)
    assert asked == [[1.0], [0.0]]
    assert joined[[]].shape == (0, 2, 2, 3)


def test_a_simulation_begins_in_the_middle_of_a_recording(small_world, shipped):
    """The robot is where the earlier commands led it; wrist cameras, known at the first frame, have moved with their arms."""
    recordings = EpisodeSet.open(shipped / "recordings")
    recorded = RecordedStarts(recordings.root, view_sets=[VIEWS], fps=8.0, embodiment=ROBOT, splits=("test",))
    name = recorded.rows[1].episode_id
    position = recordings.position(name)
    commands = recordings.episode(position).action.astype(np.float64)
    frame = int(np.abs(np.diff(commands[:, GRIPPERS], axis=0)).max(axis=1).argmax()) + 1  # a gripper is moving
    start = recorded.at(name, frame)
    assert np.array_equal(start.images["head"], recordings.frames(position, "head", [frame])[0])
    begun = {"embodiment": ROBOT, "state": start.state, "earlier": [start.earlier]}
    simulation = small_world.start(start.images, start.cameras, **begun)
    followed = CommandedRobot(simulation._starts.kinematics, 8.0, commands[:1], limits=False)
    robot, _, states = followed.follow(commands[None, 1 : frame + 1])
    assert np.array_equal(simulation.state, states[:, -1])
    assert np.array_equal(simulation.commands[:, -1], robot.command)
    assert np.abs(simulation.state - robot.command)[:, GRIPPERS].max() > 0.05
    wrists = {view: Camera(camera.K) for view, camera in start.cameras.items() if view != "head"}
    mounted = small_world.start(start.images, start.cameras | wrists, **begun)
    bare = [arm.model_copy(update={"wrist_camera": None}) for arm in ARMS.arms]
    unknown = ArmKinematics(ARMS.model_copy(update={"arms": tuple(bare)}))
    solved = small_world.start(start.images, start.cameras, **begun | {"embodiment": unknown})
    for one in (simulation, solved):
        np.testing.assert_allclose(one.tracks[0].uv, mounted.tracks[0].uv, atol=0.2)
    driven = commands[np.minimum(np.arange(frame + 1, frame + 5), len(commands) - 1)]
    assert equal(simulation.step(driven)[0], mounted.step(driven)[0])
    earlier = {"earlier": [start.earlier[:0], start.earlier]}
    branch = small_world.start([start.images] * 2, [start.cameras] * 2, **begun | earlier)
    assert np.array_equal(branch.state, np.stack((start.state, states[0, -1])))
    for wrong, said in (
        ([start.earlier] * 2, "do not fit together"), ([start.earlier[:, 1:]], "wrong length"),
        ([np.full_like(start.earlier, 90.0)], "limit"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=said):
            small_world.start(start.images, start.cameras, **begun | {"earlier": wrong})


@pytest.mark.slow
def test_stage2_is_stepped_clip_by_clip(models, start):
    folder = models / "stage2"
    world = WorldLine.from_pretrained(folder, steps=1, clip_frames=17)
    predicted = world.predict(start.images, start.controls, start.cameras, embodiment=ROBOT)
    simulation = start.begin(world)
    simulation.step(start.controls[None, 1:17])
    branches = simulation.fork(2)
    simulation.step(start.controls[None, 17:])
    assert equal(simulation.pictures[0], last(predicted))
    branches.step(np.stack((start.controls[17:], start.controls[17:] + 0.05)))
    assert [equal(found, simulation.pictures[0]) for found in branches.pictures] == [True, False]
    assert start.begin(WorldLine.from_pretrained(folder, steps=1)).frames_per_step == 32


def test_clips_of_a_batch_are_those_of_single_simulations(causal, held_out):
    controls = np.stack([start.controls[:17] for start in held_out])
    images, cameras = ([getattr(start, name) for start in held_out] for name in ("images", "cameras"))
    batch = causal.start(images, cameras, embodiment=ROBOT, state=controls[:, 0], seed=[1, 2])
    together = videos(batch, controls)
    for clip, start in enumerate(held_out):
        alone = start.begin(causal, seed=clip + 1)
        assert equal(videos(alone, controls[clip : clip + 1])[0], together[clip])
        assert np.array_equal(batch.tool_poses[clip], alone.tool_poses[0])


@pytest.mark.slow
@pytest.mark.parametrize(("bfloat16", "grey_levels"), [(True, 0), (False, 1)])
def test_branches_share_their_history_and_equal_separate_rollouts(models, start, bfloat16, grey_levels):
    causal = WorldLine.from_pretrained(models / "causal", bfloat16=bfloat16)
    equally = partial(equal, grey_levels=grey_levels)
    shared, own = start.controls[None, 1:17], start.controls[17:33]
    ways = np.stack([own, own[:1] + 0 * own, own + 0.1 * np.linspace(0, 1, 16)[:, None]])
    simulation = start.begin(causal)
    simulation.step(shared)
    snapshot, branches = simulation.copy(), simulation.fork(3)
    cache = branches._session._sampler.cache
    assert {len(keys) for block in cache.window.blocks for keys, _ in block.layers.values()} == {1}
    forked = branches.step(ways)
    for clip, controls in enumerate(ways):
        separate = start.begin(causal)
        separate.step(shared)
        assert equally(separate.step(controls[None])[0], forked[clip])
    # What was forked and what was kept go on by themselves, and so do branches that are chosen.
    assert equally(simulation.step(ways[:1])[0], forked[0])
    assert equally(snapshot.step(ways[2:])[0], forked[2])
    chosen = branches.select([2, 0])
    assert equal(chosen.pictures[0], branches.pictures[2])
    assert np.array_equal(chosen.state, branches.state[[2, 0]])
    later = np.repeat(ways[[2, 0], -1:], 16, axis=1)
    assert equal(chosen.copy().step(later)[0], chosen.step(later)[0])
    seeded = [branches.fork(1, seeds=seeds).step(ways)[2] for seeds in ([7, 8, 9], [7, 8, 1])]
    assert not equal(*seeded)


def test_commands_are_held_within_the_robots_limits(causal, start):
    elbow, gripper = ARMS.joint_columns(ARMS.arms[0]).start + 2, GRIPPERS[0]
    wild, begun = start.held({elbow: 9.0, gripper: -0.5}), start.controls[0]
    simulation, free = start.begin(causal, limits=True), start.begin(causal)
    for one in (simulation, free):
        one.step(wild)
    # pi rad/s at 8 frames per second, up to the limit of pi rad; an opening of 0..1 within 0.4 s of closing.
    expected = wild.copy()
    expected[:, elbow] = np.minimum(begun[elbow] + np.pi / 8 * np.arange(1, 17), 3.14159)
    expected[:, gripper] = 0
    np.testing.assert_allclose(simulation.commands[0], expected)
    closing = np.maximum(begun[gripper] - 1 / (0.4 * 8) * np.arange(1, 17), 0)
    np.testing.assert_allclose(simulation.states[0, :, gripper], closing, atol=1e-12)
    tools = ArmKinematics(ARMS).tool_poses(simulation.commands[0, -1:])[0].numpy()
    np.testing.assert_allclose(simulation.tool_poses[0], tools, atol=1e-6)
    assert np.array_equal(free.commands[0], wild)
    assert not equal(free.pictures[0], simulation.pictures[0])
    assert simulation.tracks[0].num_frames == 16


def test_a_limit_never_moves_a_robot_that_began_beyond_it():
    begun = np.zeros((1, 6))
    begun[0, 1] = 9.0
    robot = CommandedRobot(ArmKinematics(load_embodiment("so101")), 8.0, begun, limits=True)
    after, executed, _ = robot.follow(begun[:, None] + 0)
    assert np.array_equal(executed[:, 0], begun) and np.array_equal(after.state, begun)


def test_maps_show_the_states_where_the_model_was_trained_on_them(inputs, start):
    world = WorldLine.from_pretrained(inputs["checkpoint"])
    world.contract = world.contract.model_copy(update={"controls": "state"})
    simulation = start.begin(world)
    simulation.step(start.held(dict.fromkeys(GRIPPERS, 0.0)))
    shown = simulation.tracks[0].gripper[:, 0]
    np.testing.assert_allclose(shown, simulation.states[0][:, GRIPPERS], atol=1e-6)
    assert shown[0].max() > 0.4  # the command is 0


def test_misuse_is_refused_and_changes_nothing(causal, start):
    simulation, rows = start.begin(causal), start.controls[None, 1:17]
    state, broken = start.controls[0], rows.copy()
    broken[0, 3, 2] = np.nan

    def begun(column, value):
        return {"state": np.where(np.arange(14) == column, value, state)}

    beyond = "beyond its|array of numbers"
    for controls, message in (
        (rows[:, :15], r"another shape.*frames 1 to 16.*\(1, 16, 14\).*got: \(1, 15, 14\)"),
        (rows[:, :, :13], r"another shape.*\(1, 16, 13\)"), (np.repeat(rows, 2, axis=0), r"another shape.*\(2, 16, 14\)"),
        (broken, "not finite.*clip 0, frame 3, left/elbow_joint"), (np.degrees(rows + 0.2), beyond), (rows * 100, beyond),
        (rows.astype(complex), beyond), (np.ma.masked_greater(rows, 0.0), beyond),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            simulation.step(controls)
    for clips, seeds, message in (
        ([1], None, r"No such clips.*0\.\.0"), ([], None, "No such clips"), ([0], [1, 2], "One seed for each clip"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            simulation.select(clips, seeds)
    for count, seeds, message in ((0, None, "No such clips"), (2, [1, False], "Not a seed")):
        with pytest.raises(DataError, match=message):
            simulation.fork(count, seeds=seeds)
    for given, message in (
        ({"seed": [1, 2]}, "do not fit together.*'seeds': 2"), ({"seed": 1.5}, r"Not a seed.*1\.5"),
        ({"seed": True}, "Not a seed"), ({"seed": [-1]}, "Not a seed"),
        ({"state": np.zeros(7)}, "wrong length for this embodiment"),
        (begun(0, 45.0), "beyond its limit.*state at the start.*left/.*got: 45;"),  # degrees
        (begun(GRIPPERS[1], 80.0), "gripper is far beyond.*row 0, arm right.*opening of 80"),
        (begun(GRIPPERS[0], 2.0), "opening of 2"), ({"state": state.astype(complex)}, "array of numbers"),
        ({"state": np.ma.masked_greater(state, 0.0)}, "masked values"),
        ({"state": [str(value) for value in state]}, "array of numbers"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            start.begin(causal, **given)
    assert (simulation.num_frames, simulation.states.shape) == (1, (1, 1, 14))
    small = {view: image[:104] for view, image in start.images.items()}
    with pytest.raises(DataError, match="same views at one size"):
        causal.start([start.images, small], start.cameras, embodiment=ROBOT, state=start.controls[0])
