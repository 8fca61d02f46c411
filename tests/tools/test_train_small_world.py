"""The tool that trains the shipped models: its plans, its files, its batches, runs that go on, and their table."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import asdict, replace
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from safetensors.numpy import save_file
from torch import Tensor

from tools import small_world_causal, small_world_steps
from tools.small_world_data import NATIVE_SIZE, VIEWS, Fact, Recorded, plan_files, record_file
from tools.small_world_measures import Measuring, Predictor, Shown, gradient_energy, judged
from tools.small_world_memory import GIVEN, Episodes, Gathered, KnownSimilarities, Memory, videos
from tools.small_world_runs import ForcingSettings, MeasureSettings, Plan
from tools.small_world_steps import Start, controls_of, object_weights
from tools.small_world_table import Spread, compared, markdown, table
from tools.train_small_world import MODELS, Training, main
from worldline_core.config import CONFIG_ROOT, load_config
from worldline_core.distillation import causal_teacher_forcing
from worldline_core.distillation.causal_objective import CausalObjective, maps_of
from worldline_core.errors import ConfigError, DataError, StoppedError
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.recorder.bodies import BODIES
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.relational import TeacherSimilarities
from worldline_core.training.training_config import RelationalConfig
from worldline_core.training.video_teacher import load_teacher

SHIPPED = CONFIG_ROOT / "shipped"
FACT = Fact("ur5e_slate-train-s1-00000", "ur5e_slate", "train", "success", "lift", "lift the red block", "", False)


def episodes(count: int, frames: int, *, long: bool) -> Episodes:
    """Episodes that say where they come from: latents 100 n + t, singly coded frames + 0.5; maps 100 n + f / 4 + 0.25."""

    def filled(channels: int, offset: float, step: float = 1.0) -> Tensor:
        value = 100.0 * torch.arange(count)[:, None] + torch.arange(0, frames - 1 + step, step)
        return (value + offset)[:, None, None, :, None, None].expand(-1, 3, channels, -1, 2, 2).half()

    return Episodes(
        facts=[FACT] * count,
        latents=filled(4, 0.0),
        maps=filled(9, 0.25, step=0.25),
        things=filled(2, 0.0),
        robot=filled(1, 0.75)[:, :, 0],
        native=torch.zeros(count, 32, frames),
        singles=filled(4, 0.5) if long else None,
    )


def test_weights_of_things_have_mean_one_and_are_larger_where_the_moved_thing_is_or_was() -> None:
    things = torch.zeros(2, 3, 2, 9, 8, 12)
    things[0, 0, 0, 0, 1, 1] = 1.0  # the moved thing, at the start
    things[0, 0, 0, 5, 6, 7] = 0.25  # the moved thing, later
    things[0, 0, 1, 5, 2, 2] = 1.0  # another thing
    weights = object_weights(things, 3.0, 0.5)
    assert weights.shape == (2, 3, 1, 9, 8, 12)
    torch.testing.assert_close(weights[:, :, :, 1:].mean(dim=(1, 2, 3, 4, 5)), torch.ones(2))
    first = weights[0, 0, 0] / weights[0, 0, 0, 5, 0, 0]
    torch.testing.assert_close(first[5, 6, 7], torch.tensor(1 + 3.0 * 0.5))
    torch.testing.assert_close(first[5, 2, 2], torch.tensor(1.5))
    torch.testing.assert_close(first[:, 1, 1], torch.full((9,), 4.0))
    assert (weights[1] == 1).all()


def test_cuts_begin_with_the_frame_that_was_coded_alone_and_hold_its_maps() -> None:
    long = episodes(3, 33, long=True)
    latents, maps, robot, things = long.cuts(torch.tensor([2, 0]), torch.tensor([16, 3]), blocks=4)
    assert latents.shape == (2, 3, 4, 17, 2, 2)
    assert maps.shape == (2, 3, 9, 17, 2, 2)
    for row, start in ((0, 216.0), (1, 3.0)):
        assert (latents[row, :, :, 0] == start + 0.5).all()
        assert latents[row, 1, 2, 1:, 0, 1].tolist() == [start + step for step in range(1, 17)]
        assert maps[row, 1, 8, :, 0, 1].tolist() == [start + step + 0.25 for step in range(17)]
        assert things[row, 1, 1, :, 0, 1].tolist() == [start + step for step in range(17)]
        assert robot[row, 1, :, 0, 1].tolist() == [start + step + 0.75 for step in range(17)]


def test_a_latent_frame_takes_the_maps_of_its_own_frame_or_of_its_whole_interval() -> None:
    short, rows = episodes(2, 9, long=False), torch.tensor([1])
    own = [100.25 + step for step in range(9)]
    assert short.clips(rows)[1][0, 2, 8, :, 0, 1].tolist() == own
    every = short.clips(rows, 4)[1]
    assert every.shape == (1, 3, 36, 9, 2, 2)
    for back in range(4):
        # Before the first frame nothing happened: its maps again.
        before = [max(100.25, value - back / 4) for value in own]
        assert every[0, 1, 9 * back, :, 1, 0].tolist() == before
    cut = episodes(2, 33, long=True).cuts(rows, torch.tensor([3]), blocks=1, per_latent_frame=4)[1]
    assert cut.shape == (1, 3, 36, 5, 2, 2)
    assert cut[0, 0, 27, :, 0, 0].tolist() == [103.25, 103.5, 104.5, 105.5, 106.5]


def test_short_recordings_are_not_cut() -> None:
    with pytest.raises(DataError, match="Short recordings are not cut"):
        episodes(1, 9, long=False).cuts(torch.tensor([0]), torch.tensor([0]), blocks=1)


def test_what_comes_later_follows_what_is_there() -> None:
    gathered = Gathered(3)
    for part in (episodes(1, 9, long=False), episodes(2, 9, long=False)):
        gathered.add(part.facts, {name: getattr(part, name) for name in ("latents", *GIVEN)})
    both = gathered.episodes()
    assert len(both) == 3
    assert both.singles is None
    assert both.latents[:, 0, 0, 0, 0, 0].tolist() == [0.0, 0.0, 100.0]


def test_a_file_keeps_its_number_when_it_is_recorded_alone() -> None:
    everything = plan_files(Path(), 3000, None)
    long = plan_files(Path(), 3000, ["small_world_long"])
    first = plan_files(Path(), 3001, ["small_world"])
    second = plan_files(Path(), 3001, ["small_world"], first_seed=3001)
    assert [task.path.name for task in everything] == [f"{number:05d}.safetensors" for number in range(len(everything))]
    assert long == [task for task in everything if task.num_frames == 129]
    assert second == [task for task in first if task.jobs[0].episode_id.split("-")[2] == "s3001"]
    assert 2 * len(second) == len(first)
    assert all(task.with_masks for task in long)
    assert all(len({(job.embodiment, job.split, job.held_out_camera) for job in task.jobs}) == 1 for task in everything)
    assert {job.embodiment for task in everything for job in task.jobs} == set(BODIES) - {"xarm7_single"}
    assert len({job.episode_id for task in everything for job in task.jobs}) == sum(len(t.jobs) for t in everything)


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
def test_the_shipped_model_predicts_what_the_tool_records(tmp_path: Path) -> None:
    task = plan_files(tmp_path, 3000, ["small_world_test"])[0]
    record_file(replace(task, jobs=task.jobs[:2]))
    memory = Memory(tmp_path, [task.path.name], PatchTokenizer.load(MODELS / "tokenizer"), None)
    file = Recorded.read(task.path)
    latents, model = memory.encode(videos(file.frames, "cpu")), Predictor.open(MODELS / "stage2", "cpu")
    controls = model.controls(torch.from_numpy(file.maps), torch.from_numpy(file.native))
    error, copying = ((model(latents, controls) - latents) ** 2).mean(), ((latents[:, :, :, :1] - latents) ** 2).mean()
    assert error < 0.5 * copying, (float(error), float(copying))


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            {"stage2": {"steps": 1, "thigns": [3, 0.5]}},
            r"runs\.one\.stage2\.thigns: unknown key; did you mean 'things'",
        ),
        (
            {"teacher_forcing": {"steps": 1, "histroy_noise": 0.2}},
            r"histroy_noise: unknown key; did you mean 'history_noise'",
        ),
        ({"stage2": {"steps": 1, "seconds": 1}}, r"runs\.one\.stage2: .*give seconds or steps"),
        (
            {"teacher_forcing": {"steps": 1, "history": "generated", "history_noise": 0.2}},
            r"runs\.one\.teacher_forcing: .*with history: generated it is 0",
        ),
        ({"stage2": {"steps": 1, "views": ["left_wrist"]}}, r"runs\.one\.stage2: .*the head view among them"),
        ({"stage2": {"steps": 1, "native_size": 32, "action_frames": 4}}, r"runs\.one\.stage2: .*leave it out"),
    ],
)
def test_a_wrong_key_of_the_plan_is_refused_by_its_name(
    tmp_path: Path, section: dict[str, object], message: str
) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump({"runs": {"one": section}}))
    with pytest.raises(ConfigError, match=message):
        load_config(Plan, path=path)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("small_world*.yaml")), ids=lambda path: path.stem)
def test_the_plans_are_ones_that_the_tool_reads(path: Path) -> None:
    plan = load_config(Plan, path=path)
    assert plan.runs
    assert all(run.steps() for run in plan.runs.values())


@pytest.mark.parametrize(("seed", "message"), [("7", "no such seed"), ("0", "No recordings")])
def test_what_cannot_be_done_is_said_without_a_traceback(
    seed: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = SHIPPED / "small_world_directions_cpu.yaml"
    given = ["tool", "train", str(tmp_path), str(tmp_path / "out"), "--plan", str(plan), "--seeds", seed]
    monkeypatch.setattr("sys.argv", given)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_some_seeds_of_a_plan_are_made_alone() -> None:
    plan = Plan(seeds=(0, 1, 2))
    assert plan.of_seeds(None) == plan
    assert plan.of_seeds([2, 0]).seeds == (2, 0)
    with pytest.raises(ConfigError, match=r"(?s)no such seed.*\(0, 1, 2\).*\[7\]"):
        plan.of_seeds([1, 7])


def test_the_moved_thing_is_found_and_the_judge_scores_both_kinds_of_views() -> None:
    pixels = np.full((3, 33, 64, 96, 3), 120, np.uint8)
    thing = np.zeros((33, 64, 96), bool)
    for frame in range(33):
        thing[frame, 40 - frame : 50 - frame, 30:40] = True
    pixels[0][thing] = (220, 20, 20)
    shown = Shown("lift the red block", VIEWS, pixels, np.zeros_like(thing), thing)
    found = judged(shown)
    assert found["object_iou"] == pytest.approx(1.0)
    assert found["area"] is not None
    assert found["area_head"] is not None
    copied = replace(shown, pixels=pixels[:, :1].repeat(33, axis=1))
    assert judged(copied)["object_iou"] == pytest.approx(0.1, abs=0.1)
    still = replace(shown, thing=thing[:1].repeat(33, axis=0))
    assert judged(still)["object_iou"] is None


def test_gradient_energy_is_the_step_to_the_next_pixel() -> None:
    video = torch.zeros(1, 3, 2, 4, 5)
    video[..., 2, 3] = 1.0
    energy = gradient_energy(video)
    assert energy.shape == (1, 2, 4, 5)
    assert energy[0, 0].nonzero().tolist() == [[1, 3], [2, 2], [2, 3]]
    assert energy[0, 0, 2, 3] == 2.0


def test_intervals_over_seeds_are_those_of_students_t() -> None:
    spread = Spread.of([1.0, 2.0, 3.0])
    assert spread.mean == 2.0
    assert spread.high == pytest.approx(2.0 + 4.302653 / 3**0.5, abs=1e-5)
    assert Spread.of([1.0]) == Spread(1.0, None, None, 1)


def test_a_comparison_is_made_seed_by_seed_and_its_sign_is_that_of_better() -> None:
    measured = {
        "full": {seed: {"robot_iou": 0.8 + 0.1 * seed, "error_head": 0.2, "area": 0.9} for seed in range(3)},
        "other": {
            seed: {"robot_iou": 0.7 + 0.1 * seed + 0.001 * seed, "error_head": 0.1 + 0.001 * seed} for seed in range(3)
        },
        "native_film": {0: {"robot_iou": 0.5, "unseen_robot_iou": 0.4}},
    }
    measured["full"][0]["unseen_robot_iou"] = 0.6
    found = {(one.run, one.figure): one for one in compared(measured, "full")}
    assert found["other", "robot_iou"].verdict == "holds"
    assert found["other", "robot_iou"].difference.mean == pytest.approx(0.099)
    assert found["other", "error_head"].verdict == "opposite"
    assert found["native_film", "robot_iou"].verdict == "open"
    assert ("other", "area") not in found
    text = markdown(measured, "full")
    assert "| native_film | +0.300: open |" in text
    assert "| +0.200: open | +0.198 | +0.157 |" in text
    assert json.loads(json.dumps(table(measured, "full")))["seeds"]["native_film"] == {"0": measured["native_film"][0]}


def recording(
    split: str, outcomes: list[str], seed: int, frames: int = 33
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Made-up episodes of a red square that moves, with all that a file holds."""
    count, latent = len(outcomes), (frames + 3) // 4
    random = np.random.default_rng(seed)
    pixels = np.repeat(random.integers(60, 160, (count, 3, 1, 64, 96, 3), np.uint8), frames, axis=2)
    masks = np.zeros((count, 3, 2, frames, 64, 96), np.uint8)
    for row, outcome in enumerate(outcomes):
        for frame in range(frames):
            top = 40 - (frame % 33 if outcome == "success" else frame % 8)
            pixels[row, :, frame, top : top + 10, 30:40] = (220, 20, 20)
            masks[row, :, 1, frame, top : top + 10, 30:40] = 1
            masks[row, :, 0, frame, :8] = 1
    arrays = {
        "frames": pixels,
        "masks": masks,
        "maps": random.standard_normal((count, 3, 9, frames, 8, 12)).astype(np.float16),
        "native": random.standard_normal((count, NATIVE_SIZE, latent)).astype(np.float32),
        "robot": np.ones((count, 3, latent, 8, 12), np.uint8),
        "things": random.random((count, 3, 2, latent, 8, 12)).astype(np.float16),
    }
    facts = [
        asdict(replace(FACT, id=f"{split}-{seed}-{row}", split=split, outcome=outcome))
        for row, outcome in enumerate(outcomes)
    ]
    return arrays, {"facts": json.dumps(facts)}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    ends = ["success", "failure", "success", "failure"]
    for number, (split, outcomes, frames) in enumerate(
        [("train", ends, 33), ("test", ends[:2], 33), ("train", ends[:2], 129), ("test", ends[:1], 129)]
    ):
        arrays, header = recording(split, outcomes, number, frames)
        save_file(arrays, folder / f"{number:05d}.safetensors", metadata=header)
    return folder


@pytest.fixture(scope="module")
def measuring(recordings: Path) -> Iterator[Measuring]:
    names = sorted(path.name for path in recordings.iterdir())
    teacher = load_teacher(MODELS / "teacher", device="cpu")
    memory = Memory(recordings, names, PatchTokenizer.load(MODELS / "tokenizer"), teacher)
    with ThreadPool(1) as judges:
        yield Measuring(memory, judges, LearnedSegmenter.load(MODELS / "segmenter"))


TINY = {
    "hidden_size": 32,
    "num_layers": 2,
    "num_heads": 1,
    "head_dim": 32,
    "rope_sections": [6, 5, 5],
    "intermediate_size": 32,
    "prediction": "first_frame_residual",
    "first_frame_std": 0.75,
}
BASE = {"steps": 2, "batch": 2}
STAGE2 = {"steps": 3, "batch": 2, "things": [3, 0.5]}


def plan_of(**runs: object) -> Plan:
    return Plan.model_validate({"model": TINY, "measure": {"splits": {"test": 4}}, "runs": runs})


@pytest.mark.slow
def test_runs_share_what_they_have_in_common_and_are_measured(measuring: Measuring, tmp_path: Path) -> None:
    with_base = {"base": BASE, "stage2": STAGE2}
    plan = plan_of(
        full={"base": BASE, "stage2": {**STAGE2, "relational": True}},
        no_regularization=with_base,
        success_only={"base": BASE, "stage2": {**STAGE2, "outcomes": ["success"]}},
        native_film={"base": BASE, "stage2": {**STAGE2, "native_size": 32}},
        head_only={"base": BASE, "stage2": {**STAGE2, "views": ["head"]}},
        no_action_free={"stage2": STAGE2},
        every_control={"base": BASE, "stage2": {**STAGE2, "action_frames": 4}},
    )
    plan = plan.model_copy(update={"seeds": (0, 1)})
    Training(measuring.memory, plan, tmp_path, measuring).all()
    runs = json.loads((tmp_path / "runs.json").read_text())
    assert len(runs) == 14
    assert len({folders["base"] for name, folders in runs.items() if "base" in folders}) == 2
    assert len({folders["stage2"] for folders in runs.values()}) == 14
    for name, kept in (("native_film", {"native_size": 32}), ("head_only", {}), ("full", {}), ("every_control", {})):
        info = read_checkpoint_info(tmp_path / runs[f"{name}, seed 1"]["stage2"])
        assert info.config.action_frames == (4 if name == "every_control" else 1)
        assert info.config.native_size == kept.get("native_size")
        assert info.views == (("head",) if name == "head_only" else VIEWS)
    table = json.loads((tmp_path / "table.json").read_text())
    assert set(table["runs"]) == set(plan.runs)
    assert table["runs"]["full"]["robot_iou"]["count"] == 2
    assert {one["run"] for one in table["compared"]} == set(plan.runs) - {"full"}
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*")}
    Training(measuring.memory, plan, tmp_path, measuring).all()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*")} == before


def test_the_table_shows_the_plans_first_split_and_sampler_whatever_the_order_of_the_file(
    measuring: Measuring, tmp_path: Path
) -> None:
    wanted = {"splits": {"test": 4, "ood_test": 2}, "samplers": [[4, 5.0], [1, 1.0]]}
    plan = plan_of(one={"stage2": STAGE2}).model_copy(update={"measure": MeasureSettings.model_validate(wanted)})
    training = Training(measuring.memory, plan, tmp_path, measuring)
    figures = {
        f"{steps} steps, shift {shift}": {"test": steps, "ood_test": 10 * steps} for steps, shift in ((1, 1), (4, 5))
    }
    stored = {
        sampler: {split: {"robot_iou": value, "episodes": 1} for split, value in splits.items()}
        for sampler, splits in figures.items()
    }
    folder = MODELS / "stage2"
    training.measured = lambda _: dict(sorted((k, dict(sorted(v.items()))) for k, v in stored.items()))  # type: ignore
    assert training.figures(folder) == {"robot_iou": 4, "unseen_robot_iou": 40}


def test_successes_alone_are_drawn_where_a_run_asks_for_them(measuring: Measuring) -> None:
    train = measuring.memory.episodes()
    assert train.ended(("success",)).tolist() == [0, 2]
    assert train.ended(None).tolist() == [0, 1, 2, 3]
    with pytest.raises(DataError, match="No recording ended so"):
        train.ended(("unknown",))


def test_controls_are_maps_of_the_views_or_vectors(measuring: Measuring) -> None:
    train = measuring.memory.episodes()
    config = plan_of().model
    maps = controls_of(train.maps, train.native, ("head", "right_wrist"), config)
    torch.testing.assert_close(maps, train.maps[:, [0, 2], :, ::4].float())
    film = config.model_copy(update={"action_conditioning": "native_film", "action_channels": 16})
    vectors = controls_of(train.maps, train.native, ("head", "right_wrist"), film)
    assert vectors.shape == (4, 2, 16, 9, 1, 1)
    torch.testing.assert_close(vectors[:, 1, :, :, 0, 0], train.native[:, :16])


def test_relations_in_memory_are_the_teachers(measuring: Measuring, recordings: Path) -> None:
    memory = measuring.memory
    assert memory.teacher is not None
    taught = TeacherSimilarities.__new__(TeacherSimilarities)
    taught.teacher, taught.config, taught._cache = memory.teacher, RelationalConfig(cached_clips=0), {}  # type: ignore
    clips = tuple(Clip(fact.id, 0, 33, 1) for fact in memory.episodes().facts[2:4])
    frames = torch.from_numpy(recording("train", ["success", "failure"] * 2, 0)[0]["frames"][2:4])
    for views in (VIEWS, ("head", "right_wrist"), ("head",)):
        found = KnownSimilarities(memory.episodes()).similarities(clips, views, (9, 4, 6))
        expected = taught.similarities(clips, views, (9, 4, 6), frames[:, [VIEWS.index(view) for view in views]])
        assert found.shape == expected.shape
        torch.testing.assert_close(found.intra, expected.intra, atol=2e-3, rtol=0)
        torch.testing.assert_close(found.cross, expected.cross, atol=2e-3, rtol=0)


CAUSAL = {
    "teacher_forcing": {"steps": 5, "batch": 3, "history_noise": 0.2, "long_every": 2},
    "trajectory_regression": {"steps": 2, "batch": 2, "batches": 2, "clips": 3, "long_every": 2},
    "distribution_matching": {"steps": 4, "batch": 2},
}


def test_a_block_sees_what_the_model_itself_makes_of_the_blocks_before(
    measuring: Measuring, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}

    def loss(model: WorldModel, latents: Tensor, maps: Tensor, **given: Any) -> Tensor:
        seen.update(given)
        return latents.sum()

    monkeypatch.setattr(causal_teacher_forcing, "teacher_forcing_loss", loss)
    settings = ForcingSettings(steps=1, batch=3, sigmas=(1.0, 0.0), history="generated", long_every=1)
    start = Start(measuring.memory, 0, plan_of().model, MODELS / "causal", None)
    step = small_world_causal.forcing_step(start, settings)
    batch = step.load(0)
    assert isinstance(batch, Batch)
    step.objective.loss(batch, torch.Generator().manual_seed(5), 0)
    assert step.saved["causal"].sigmas == (1.0, 0.0)
    shown, recorded = seen["history"], batch.latents
    assert shown.shape == recorded.shape == (1, 3, 32, 17, 8, 12)
    assert not shown.requires_grad
    # The first two blocks are those of a rollout of them alone.
    noise = torch.randn(recorded.shape, generator=torch.Generator().manual_seed(5))
    alone = Batch(batch.clips, batch.views, recorded[:, :, :, :9])
    maps = maps_of(batch)[:, :, :, :9]
    assert isinstance(step.objective, CausalObjective)
    rolled = step.objective.rollout(alone, maps, noise[:, :, :, :9], 0, with_gradient=False)
    torch.testing.assert_close(shown[:, :, :, :9], rolled)
    assert (shown[:, :, :, 9:13] - recorded[:, :, :, 9:13]).abs().mean() > 0.01


def test_a_teacher_says_in_part_what_blocks_of_short_clips_should_become(
    measuring: Measuring, monkeypatch: pytest.MonkeyPatch
) -> None:
    def target(share: float | None, long_every: int = 0) -> tuple[Tensor, Batch]:
        """What the blocks of the first batch should become."""
        targets: list[Tensor] = []
        monkeypatch.setattr(
            causal_teacher_forcing,
            "teacher_forcing_loss",
            lambda model, latents, maps, **given: targets.append(latents) or latents.sum(),
        )
        teacher: dict[str, Any] = {} if share is None else {"teacher": MODELS / "stage2", "teacher_share": share}
        settings = ForcingSettings(steps=1, batch=3, history_noise=0.2, long_every=long_every, **teacher)
        step = small_world_causal.forcing_step(
            Start(measuring.memory, 0, plan_of().model, MODELS / "causal", None), settings
        )
        batch = step.load(0)
        assert isinstance(batch, Batch)
        step.objective.loss(batch, torch.Generator().manual_seed(5), 0)
        return targets[0], batch

    recorded, batch = target(None)
    assert torch.equal(recorded, batch.latents)
    predicted, _ = target(1.0)
    noise = torch.randn(recorded.shape, generator=torch.Generator().manual_seed(5))
    noise[:, :, :, :1] = recorded[:, :, :, :1]
    stage2 = load_checkpoint(MODELS / "stage2")[0].eval()
    with torch.no_grad():
        velocity = stage2(noise, torch.ones(3), action_maps=maps_of(batch), views=VIEWS).velocity
    torch.testing.assert_close(predicted, noise - velocity)
    torch.testing.assert_close(target(0.25)[0], 0.75 * recorded + 0.25 * predicted)
    long, batch = target(1.0, long_every=1)
    assert torch.equal(long, batch.latents)


def test_rollouts_of_validation_recordings_are_measured_while_a_model_trains(
    measuring: Measuring, tmp_path: Path
) -> None:
    for number, (split, count) in enumerate((("train", 2), ("validation", 4))):
        arrays, header = recording(split, ["success"] * count, number, 33)
        save_file(arrays, tmp_path / f"{number:05d}.safetensors", metadata=header)
    memory = Memory(tmp_path, ["00000.safetensors", "00001.safetensors"], measuring.memory.tokenizer)
    settings = ForcingSettings(
        steps=3, batch=3, lr=1e-3, warmup=0, long_every=0, sigmas=(1.0, 0.0), validate_every=2, ema=0.5
    )
    training = Training(memory, plan_of(), tmp_path / "output", measuring)
    folder = training.step("teacher_forcing", settings, Start(memory, 0, plan_of().model, MODELS / "causal", None), 0)
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    measured = {row["step"]: row for row in rows if "validation/rollout_error" in row}
    assert list(measured) == [2, 3]
    latents = memory.episodes("validation").latents.float()
    copied = (latents[:, :, :, :1] - latents)[:, :, :, 1:].square().mean()
    assert measured[3]["validation/rollout_error_copy"] == pytest.approx(float(copied), rel=1e-5)
    assert measured[2]["validation/rollout_error"] != measured[3]["validation/rollout_error"]


@pytest.mark.slow
def test_a_run_that_was_stopped_ends_with_the_same_bits(
    measuring: Measuring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of(all={"stage2": {**STAGE2, "relational": True, "action_frames": 4}, **CAUSAL})
    Training(measuring.memory, plan, tmp_path / "whole", measuring).all()
    drawn, calls = small_world_steps.drawn, 0

    def stopping(count: int, size: int, draws: torch.Generator) -> Tensor:
        nonlocal calls
        calls += 1
        if calls % 4 == 0:
            signal.raise_signal(signal.SIGTERM)
        return drawn(count, size, draws)

    for module in (small_world_steps, small_world_causal):
        monkeypatch.setattr(module, "drawn", stopping)
    # A signal outside the loop must not end this process.
    before = signal.signal(signal.SIGTERM, lambda number, frame: None)
    stops = 0
    try:
        while True:
            try:
                Training(measuring.memory, plan, tmp_path / "stopped", measuring).all()
                break
            except StoppedError:
                stops += 1
    finally:
        signal.signal(signal.SIGTERM, before)
    assert stops >= 3
    whole = json.loads((tmp_path / "whole" / "runs.json").read_text())
    assert whole == json.loads((tmp_path / "stopped" / "runs.json").read_text())
    for folder in whole["all, seed 0"].values():
        for name in ("model.safetensors", "checkpoint.json", "metrics.jsonl"):
            assert (tmp_path / "whole" / folder / name).read_bytes() == (
                tmp_path / "stopped" / folder / name
            ).read_bytes()
    assert (tmp_path / "whole" / "table.md").read_text() == (tmp_path / "stopped" / "table.md").read_text()
    last = load_checkpoint(tmp_path / "whole" / whole["all, seed 0"]["distribution_matching"], expect_kind="causal")[1]
    assert last.metadata["run"]["steps"] == 6


@pytest.mark.slow
def test_seconds_become_the_same_number_of_steps_for_every_seed(measuring: Measuring, tmp_path: Path) -> None:
    plan = plan_of(one={"stage2": {"seconds": 0.2, "batch": 1}}).model_copy(update={"seeds": (0, 1)})
    Training(measuring.memory, plan, tmp_path, measuring).all()
    (pace,) = json.loads((tmp_path / "pace.json").read_text()).values()
    taken = [read_checkpoint_info(path.parent).metadata["run"] for path in tmp_path.glob("stage2-*/checkpoint.json")]
    assert [run["steps"] for run in taken] == [max(1, round(0.2 / pace))] * 2


def test_recordings_without_the_maps_of_every_frame_are_refused(tmp_path: Path) -> None:
    arrays, header = recording("train", ["success"], 0)
    save_file(arrays | {"maps": arrays["maps"][:, :, :, ::4].copy()}, tmp_path / "old.safetensors", metadata=header)
    with pytest.raises(DataError, match=r"(?s)maps of frames between.*old\.safetensors.*expected: 33 frames.*got: 9"):
        Recorded.read(tmp_path / "old.safetensors")


def test_missing_recordings_are_told_by_name(recordings: Path) -> None:
    with pytest.raises(DataError, match=r"(?s)Recordings are missing.*09999\.safetensors"):
        Memory(recordings, ["00000.safetensors", "09999.safetensors"], PatchTokenizer.load(MODELS / "tokenizer"))


def test_video_values_lie_between_minus_one_and_one() -> None:
    frames = np.array([0, 255], np.uint8)[:, None, None, None, None, None] * np.ones((1, 3, 5, 2, 2, 3), np.uint8)
    assert videos(frames, "cpu").unique().tolist() == [-1.0, 1.0]
