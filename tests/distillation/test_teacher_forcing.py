"""What blocks learn from: the recording, or the model's own blocks and Stage II's prediction; always as a rollout sees it."""

from functools import partial

import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation import causal_teacher_forcing
from worldline_core.distillation.causal_objective import maps_of, self_forced_rollout
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.pipeline.memory_estimate import Sources, Training, trainings

FPS = torch.tensor([8.0, 30.0])


def config_of(frames, **changes):
    values = {"clips": {"lengths": [1 + 4 * (frames - 1)]}, "block_size": 2, **changes}
    return DistillConfig.model_validate(values)


def batch_of(frames, steps=1):
    """A clip of the observed latent frame and blocks of two."""
    generator = torch.Generator().manual_seed(4)
    latents = torch.randn(2, 3, 4, frames, 4, 4, generator=generator)
    return TrajectoryBatch(
        clips=(), views=VIEWS, latents=latents, action_maps=torch.randn(2, 3, 9, frames, 4, 4, generator=generator),
        fps=FPS, nodes=torch.randn(2, steps + 1, 3, 4, frames - 1, 4, 4, generator=generator), history=latents,
        mask=torch.zeros(2, 3, frames, 4, 4),
    )  # fmt: skip


@torch.no_grad()
def blockwise(model, config, given):
    """The velocities of the same noisy blocks, as a rollout over the same clean history computes them."""
    noisy, clean, sigma, maps, _ = given
    cache = KVCache(config.spec.sink_blocks, config.spec.recent_blocks, FPS)
    found = [torch.zeros_like(noisy[..., :1, :, :])]
    for block, (start, stop) in enumerate(block_bounds(noisy.shape[3], 2)):
        own = maps[..., start:stop, :, :]
        if block:
            found.append(model.forward_block(noisy[..., start:stop, :, :], sigma[:, block - 1], cache, action_maps=own))
        model.write_block(clean[..., start:stop, :, :], cache, action_maps=own)
    return torch.cat(found, dim=3)


@pytest.mark.parametrize(
    "objective", [TeacherForcingObjective, partial(TrajectoryObjective, perceptual=None)], ids=["forcing", "regression"]
)
def test_an_objective_trains_on_what_a_rollout_sees(objective, make_model):
    """Six blocks, in a window of two."""
    config, model, seen = config_of(13, window={"sink_blocks": 1, "recent_blocks": 1}), make_model(0, fps=15.0), []

    def watched(*given, **named):
        velocity = WorldModel.forward_teacher_forcing(model, *given, **named)
        seen.append((*given, named["action_maps"], velocity))
        return velocity

    model.forward_teacher_forcing = watched
    objective(model, config).loss(batch_of(13, config.spec.steps), torch.Generator().manual_seed(0), 5)
    (given,) = seen
    torch.testing.assert_close(given[-1], blockwise(model, config, given), rtol=1e-5, atol=1e-5)


FRAMES = 7
ONE_STEP = {"sigmas": [1.0, 0.0], "trajectory_regression": {"trajectories": {"substeps": [1]}}}


@pytest.fixture
def shown(monkeypatch):
    """Makes the objective's loss of a batch, and returns what the loss is given."""
    given = {}

    def loss(model, latents, maps, **named):
        given.update(named, latents=latents)
        return latents.sum()

    def show(model, batch, *teacher, **forcing):
        objective = TeacherForcingObjective(model, config_of(FRAMES, **ONE_STEP, teacher_forcing=forcing), *teacher)
        objective.loss(batch, torch.Generator().manual_seed(5), 0)
        return given

    monkeypatch.setattr(causal_teacher_forcing, "teacher_forcing_loss", loss)
    return show


def noise_of(batch):
    return torch.randn(batch.latents.shape, generator=torch.Generator().manual_seed(5))


def test_a_block_sees_what_the_model_itself_makes_of_the_blocks_before(make_model, shown):
    model, batch = make_model(0, fps=15.0), batch_of(FRAMES)
    given = shown(model, batch, history="generated")
    maps, noise, history = (v[..., : FRAMES - 2, :, :] for v in (maps_of(batch), noise_of(batch), given["history"]))
    own = self_forced_rollout(
        model, batch.latents[..., :1, :, :], maps, noise, 0, views=VIEWS, spec=config_of(FRAMES, **ONE_STEP).spec,
        fps=FPS, with_gradient=False,
    )  # fmt: skip
    torch.testing.assert_close(history, own)
    assert not given["history"].requires_grad
    assert torch.equal(given["latents"], batch.latents)


def test_stage2_says_in_part_what_blocks_of_clips_it_knows_should_become(make_model, shown):
    model, teacher, batch = make_model(0, fps=15.0), make_model(1, fps=15.0), batch_of(FRAMES)
    first = batch.latents[..., :1, :, :]
    state = torch.cat((first, noise_of(batch)[..., 1:, :, :]), dim=3)
    velocity = teacher(state, torch.ones(2), action_maps=maps_of(batch), views=VIEWS, fps=FPS).velocity
    predicted = torch.cat((first, (state - velocity)[..., 1:, :, :]), dim=3).detach()
    for forcing, expected in (
        ({"teacher_share": 1.0}, predicted), ({"teacher_share": 0.25}, 0.75 * batch.latents + 0.25 * predicted),
        ({"teacher_share": 1.0, "teacher_frames": 4 * (FRAMES - 2) + 1}, batch.latents),
    ):  # fmt: skip
        torch.testing.assert_close(shown(model, batch, teacher, **forcing)["latents"], expected)
    assert not any(parameter.requires_grad for parameter in teacher.parameters())


def test_the_teacher_is_in_the_memory_sheet(make_model, monkeypatch):
    monkeypatch.setattr(Training, "activations", lambda *_args, **_named: 100)
    source = Sources(None, None, (32, 32), (4, 4))

    def planned(**forcing):
        config = config_of(FRAMES, **ONE_STEP, teacher_forcing=forcing)
        return trainings(config, make_model(0).config, source)[0].estimate(1)

    alone, taught = planned(), planned(teacher_share=0.5)
    assert "frozen scores" not in alone.parts
    assert taught.parts["frozen scores"] == 4 * taught.parameters


def test_a_rollout_begins_anew_no_later_than_the_longest_trained_clip_ends():
    settings = {"clips": {"lengths": [33, 65]}, "window": {"anchor_blocks": 4}}
    assert DistillConfig.model_validate(settings).spec.anchor_blocks == 4
