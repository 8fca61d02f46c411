"""Teacher forcing and teacher trajectories, and regression on them: blocks learn from what a rollout sees."""

import itertools
from functools import partial

import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation import causal_teacher_forcing
from worldline_core.distillation.causal_objective import block_sigmas, frame_sigmas, maps_of, self_forced_rollout
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.trajectory_regression import (
    TrajectoryBatch,
    TrajectoryObjective,
    draw_nodes,
    euler_nodes,
    node_of_each_block,
    substep_sigmas,
    teacher_trajectories,
)
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CAUSAL_SIGMAS as NODES
from worldline_core.pipeline import memory_estimate
from worldline_core.pipeline.memory_estimate import Sources, trainings
from worldline_core.pipeline.memory_trace import Held
from worldline_core.training.training_config import SigmaSampling

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
    window, disturbed = {"sink_blocks": 1, "recent_blocks": 1}, {"history_noise": 0.1}
    config, model, seen = config_of(13, window=window, teacher_forcing=disturbed), make_model(0, fps=15.0), []

    def watched(*given, **named):
        velocity = WorldModel.forward_teacher_forcing(model, *given, **named)
        seen.append((*given, named["action_maps"], velocity))
        return velocity

    model.forward_teacher_forcing = watched
    batch = batch_of(13, config.spec.steps)
    objective(model, config).loss(batch, torch.Generator().manual_seed(0), 5)
    (given,) = seen
    assert torch.equal(given[1], batch.latents) is (objective is not TeacherForcingObjective)
    torch.testing.assert_close(given[-1], blockwise(model, config, given), rtol=1e-5, atol=1e-5)


FRAMES = 7
ONE_STEP = {"sigmas": [1.0, 0.0], "trajectory_regression": {"trajectories": {"substeps": [1]}}}


@pytest.fixture
def shown(monkeypatch):
    """Makes the objective's loss of a batch, and returns the latents that it asks for and the history that the model is shown."""
    given = {}

    def forward(model, noisy, history, sigma, **named):
        given["history"] = history
        return noisy

    def loss(velocity, latents, *rest, **named):
        given["latents"] = latents
        return latents.sum()

    def show(model, batch, *teacher, **forcing):
        objective = TeacherForcingObjective(model, config_of(FRAMES, **ONE_STEP, teacher_forcing=forcing), *teacher)
        objective.loss(batch, torch.Generator().manual_seed(5), 0)
        return given

    monkeypatch.setattr(WorldModel, "forward_teacher_forcing", forward)
    monkeypatch.setattr(causal_teacher_forcing, "flow_matching_loss", loss)
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
    monkeypatch.setattr(memory_estimate, "traced", lambda *_: Held(100, 0))
    source = Sources(None, None, (32, 32), (4, 4))

    def planned(**forcing):
        config = config_of(FRAMES, **ONE_STEP, teacher_forcing=forcing | {"trainer": {"steps": 1, "precision": "bf16"}})
        return trainings(config, make_model(0).config, source)[0].estimate(1)

    alone, taught = planned(), planned(teacher_share=0.5)
    assert "frozen scores" not in alone.parts
    # Matrices in bfloat16, the rest in float32.
    assert 2 * taught.parameters < taught.parts["frozen scores"] < 4 * taught.parameters


@pytest.mark.slow
def test_scores_that_share_their_weights_are_planned_once(make_model, monkeypatch):
    monkeypatch.setattr(memory_estimate, "traced", lambda *_: Held(100, 0))
    source = Sources(None, None, (32, 32), (4, 4))

    def planned(**adapters):
        matching = {"trainer": {"steps": 1, "precision": "bf16"}}
        config = config_of(FRAMES, **ONE_STEP, distribution_matching=matching, **adapters)
        return trainings(config, make_model(0).config, source)[-1].estimate(1)

    full, lora = planned(), planned(lora={"rank": 1})
    assert lora.parts["weights"] < 0.6 * full.parts["weights"]  # the student's in bfloat16, and adapters
    assert lora.parts["frozen scores"] == full.parts["frozen scores"]


def test_a_rollout_begins_anew_no_later_than_the_longest_trained_clip_ends():
    settings = {"clips": {"lengths": [33, 65]}, "window": {"anchor_blocks": 4}}
    assert DistillConfig.model_validate(settings).spec.anchor_blocks == 4


@pytest.mark.parametrize("substeps", [(1, 1, 1, 1), (2, 2, 3, 9)])
def test_euler_is_exact_on_a_straight_field(substeps):
    generator = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    states = euler_nodes(lambda state, sigma: noise - clean, noise, substeps, NODES)
    assert len(states) == len(NODES)
    for sigma, state in zip(NODES, states, strict=True):
        torch.testing.assert_close(state, (1 - sigma) * clean + sigma * noise)


def test_finer_substeps_come_closer_to_the_true_flow():
    # dx/dsigma = x has the solution x(sigma) = x(1) exp(sigma - 1).
    noise = torch.ones(1, dtype=torch.float64)
    exact = torch.exp(torch.tensor(-1.0, dtype=torch.float64))
    found = [euler_nodes(lambda state, sigma: state, noise, (count,) * 4, NODES)[-1] for count in (1, 4, 16)]
    errors = [abs(end - exact).item() for end in found]
    assert errors[0] > 3 * errors[1] > 9 * errors[2] > 0


def test_substeps_end_on_the_nodes_and_descend():
    levels = substep_sigmas(5 / 8, 0.0, 5)
    assert (levels[0], levels[-1], len(levels)) == (5 / 8, 0.0, 6)
    assert all(a > b for a, b in itertools.pairwise(levels))
    # Two sub-steps of the whole range meet in the middle of the unshifted schedule: 5 / 6 at one half.
    assert substep_sigmas(1.0, 0.0, 2)[1] == pytest.approx(5 / 6)


def test_a_node_is_picked_for_each_block():
    nodes = torch.arange(5.0).reshape(1, 5, 1, 1, 1, 1, 1).expand(1, 5, 3, 4, 4, 2, 2)
    picked = node_of_each_block(nodes, torch.tensor([[3, 1]]), block_size=2)
    assert picked.shape == (1, 3, 4, 4, 2, 2)
    assert picked[0, 0, 0, :, 0, 0].tolist() == [3, 3, 1, 1]


def trajectories(model, clip, *, latents=None, maps=None):
    return teacher_trajectories(
        model, clip.latents if latents is None else latents, clip.maps if maps is None else maps, clip.noise,
        views=clip.views, spec=clip.spec, substeps=(1, 1, 1, 2),
    )  # fmt: skip


def test_trajectories_start_at_the_noise_and_see_the_recorded_history_alone(make_model, clip):
    model = make_model(0)
    nodes = trajectories(model, clip)
    assert nodes.shape == (2, 5, 3, 4, 4, 4, 4)
    assert torch.equal(nodes[:, 0], clip.noise[..., 1:, :, :])
    for name, begins in (("latents", 1), ("maps", 3)):
        other = getattr(clip, name).clone()
        other[..., begins : begins + 2, :, :] += 1.0
        changed = trajectories(model, clip, **{name: other})
        assert torch.equal(nodes[..., :2, :, :], changed[..., :2, :, :])  # nothing later reaches a block
        assert not torch.allclose(nodes[:, -1, ..., 2:, :, :], changed[:, -1, ..., 2:, :, :])
    # The first step is that of a teacher-forcing pass.
    noisy = torch.cat((clip.latents[..., :1, :, :], clip.noise[..., 1:, :, :]), dim=3)
    with torch.no_grad():
        velocity = model.forward_teacher_forcing(
            noisy, clip.latents, torch.ones(2, 2), action_maps=clip.maps, spec=clip.spec, views=clip.views
        )
    first = noisy + (NODES[1] - NODES[0]) * velocity
    torch.testing.assert_close(nodes[:, 1], first[..., 1:, :, :], rtol=1e-4, atol=1e-5)


class StraightStudent:
    """A student that knows the straight path between `clean` and `noise`."""

    def __init__(self, clean, noise):
        self.answer = noise - clean

    def forward_teacher_forcing(self, noisy, clean, sigma, *, action_maps, spec, views, fps):
        velocity = self.answer.clone()
        velocity[..., :1, :, :] = 0
        return velocity


def straight_nodes(clean, noise):
    return torch.stack([((1 - s) * clean + s * noise)[..., 1:, :, :] for s in NODES], dim=1)


def loss_of(student, nodes, clip, index, **options):
    values = {"clips": {"lengths": [17]}, "block_size": 2, "trajectory_regression": options}
    config = DistillConfig.model_validate(values)
    batch = TrajectoryBatch((), clip.views, clip.latents, clip.maps, nodes=nodes, history=clip.latents, mask=clip.mask)
    return TrajectoryObjective(student, config, None).regression(batch, index)


@pytest.mark.parametrize("node", range(4))
def test_a_perfect_student_has_no_loss_and_parts_are_weighted(clip, node):
    nodes = straight_nodes(clip.latents, clip.noise)
    index = torch.full((2, 2), node)
    total, _ = loss_of(StraightStudent(clip.latents, clip.noise), nodes, clip, index)
    assert total.item() == pytest.approx(0.0, abs=1e-6)
    _, wrong = loss_of(StraightStudent(clip.latents, clip.noise + 0.1), nodes, clip, index)
    sigma, step = NODES[node], NODES[node] - NODES[node + 1]
    assert wrong["next"].item() == pytest.approx(4 * (0.1 * step) ** 2, rel=1e-3)
    assert wrong["terminal"].item() == pytest.approx((0.1 * sigma) ** 2, rel=1e-3)
    nothing = dict.fromkeys(("anchor", "boundary", "lpips", "robot", "robot_motion"), 0)
    options = {"next_weight": 3.0, "terminal_weight": 7.0, "auxiliary": nothing}
    total, terms = loss_of(StraightStudent(clip.latents, clip.noise + 0.1), nodes, clip, index, **options)
    assert set(terms) == {"next", "terminal"}
    assert total.item() == pytest.approx((3 * terms["next"] + 7 * terms["terminal"]).item())


def test_every_node_is_drawn_and_every_block_has_its_noise_level():
    index = draw_nodes(64, 2, 4, torch.Generator().manual_seed(0))
    assert set(index.flatten().tolist()) == {0, 1, 2, 3}
    sigma = block_sigmas(SigmaSampling(), 8, 9, 4, torch.Generator().manual_seed(0))
    levels = frame_sigmas(sigma, 4)
    assert (sigma.shape, levels.shape) == ((8, 2), (8, 9))
    assert not torch.allclose(sigma[:, 0], sigma[:, 1])
    assert not levels[:, 0].any() and torch.equal(levels[:, 1:5], sigma[:, :1].expand(8, 4))
