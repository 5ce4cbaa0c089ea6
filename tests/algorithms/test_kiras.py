"""The learner on worlds that only count: every part can be left out, none mixes episodes."""

from __future__ import annotations

import copy
import math
import statistics

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.kiras import TASK
from kiras_rl.config import ConfigError
from kiras_rl.phases import FINETUNING, SKILL_LEARNING

IMITATION = 1  # reward group
PARTS = ("imitation", "multi_critic", "estimator", "skill_init")


def null(*parts):
    return [f"learner.{part}=null" for part in parts]


def networks(alg):
    """Return every trained tensor by name."""
    modules = {"actor": alg.actor, "critic": alg.critic}
    for part in alg.parts.values():
        modules |= part.networks()
    return {f"{m}.{k}": v for m, module in modules.items() for k, v in module.named_parameters()}


def collect(runner):
    """Let the learner act for one rollout, as the runner does."""
    obs = runner.env.get_observations()
    with torch.no_grad():
        for _ in range(runner.cfg["num_steps_per_env"]):
            obs, rewards, dones, extras = runner.env.step(runner.alg.act(obs))
            runner.alg.process_env_step(obs, rewards, dones, extras)
        runner.alg.compute_returns(obs)


def test_the_step_size_that_is_logged_is_the_optimizer_s(make_runner):
    runner = make_runner("learner.ppo.desired_kl=[[0,1.0e-12]]")  # any step is too far
    runner.learn(1)
    alg = runner.alg
    assert alg.learning_rate < runner.config.learner.ppo.learning_rate
    for _ in range(2):  # also after loading, which replaces what the optimizer holds
        assert all(group["lr"] is alg.learning_rate for group in alg.optimizer.param_groups)
        alg.load(copy.deepcopy(alg.save()))


@pytest.mark.parametrize(("kl", "rate"), [(1e9, 2e-3), (1e-12, 5e-4)])  # never too far, always
def test_the_estimator_takes_steps_in_proportion_to_those_of_the_actor(make_runner, kl, rate):
    runner = make_runner(
        f"learner.ppo.desired_kl=[[0,{kl}]]",
        "learner.ppo.learning_rate_range=[5.0e-4,2.0e-3]",
        "learner.estimator.relative_step=0.3",
        "learner.estimator.adaboot=off",
    )
    runner.learn(1)
    assert runner.alg.learning_rate == pytest.approx(rate)
    [group] = runner.alg.parts["estimator"].trainer.optimizer.param_groups
    assert group["lr"] == pytest.approx(0.3 * rate)


@pytest.mark.parametrize("without", [(), *[(part,) for part in PARTS], PARTS], ids="-".join)
def test_it_trains_whatever_is_left_out(make_runner, without):
    runner, seen = make_runner(*null(*without)), []
    before = {name: p.detach().clone() for name, p in networks(runner.alg).items()}
    runner.learn(2, on_iteration=lambda status: seen.append(status.scalars))
    for scalars in seen:
        assert all(math.isfinite(value) for value in scalars.values())
    assert [name for name, p in networks(runner.alg).items() if torch.equal(p, before[name])] == []
    has_two = not {"imitation", "multi_critic"} & set(without)
    assert len(runner.alg.critic.critics) == (2 if has_two else 1)
    assert ("Discriminator/loss" in seen[0]) == ("imitation" not in without)
    assert ("Estimator/velocity" in seen[0]) == ("estimator" not in without)
    assert ("Skill/probability_a" in seen[0]) == ("skill_init" not in without)


@pytest.mark.parametrize(
    "overrides", [(), null("estimator"), ["learner.estimator.adaboot=bootstrap_input"]], ids=str
)
def test_the_update_sees_the_actions_exactly_as_they_were_drawn(make_runner, overrides):
    frozen = ["learner.ppo.learning_rate=0", "learner.ppo.learning_rate_range=[0,0]"]
    runner, seen = make_runner(*frozen, *overrides), []
    runner.learn(2, on_iteration=lambda status: seen.append(status.scalars))
    for scalars in seen:
        assert scalars["Policy/kl"] == pytest.approx(0.0, abs=1e-7)
        # all ratios are 1, and normalised advantages average to zero
        assert scalars["Loss/surrogate"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("overrides", [(), null("estimator")], ids=str)
def test_the_exported_policy_is_the_mean_of_the_trained_one(make_runner, overrides):
    alg = make_runner(*overrides).alg
    obs = alg.storage.observations[0].clone()
    obs["proprio"].normal_(), obs["history"].normal_()
    with torch.no_grad():
        alg.act(obs)
    torch.testing.assert_close(alg.act_deterministic(obs), alg.actor.output_mean)


def test_the_log_tells_how_far_the_advantages_of_each_group_spread(make_runner):
    runner = make_runner()
    collect(runner)
    advantages = (runner.alg.storage.returns - runner.alg.storage.values).flatten(0, 1).clone()
    scalars = runner.alg.update()
    for index, group in ((TASK, "task"), (IMITATION, "imitation")):
        spread = statistics.stdev(advantages[:, index].tolist())
        assert scalars[f"Critic/{group}_advantage_std"] == pytest.approx(spread, rel=1e-4)


def test_no_pair_of_features_straddles_a_reset(make_runner):
    runner = make_runner()
    pairs = []
    hook = runner.alg.parts["imitation"].discriminator.register_forward_pre_hook(
        lambda _, args: pairs.append(args[0].clone())
    )
    collect(runner)
    hook.remove()
    before, after = torch.cat(pairs).chunk(2, dim=1)
    assert after[:, 0].max() > 0  # some episodes did end
    assert torch.equal(before[:, 0], after[:, 0])  # the episode
    assert torch.equal(before[:, 1] + 1, after[:, 1])  # the step in it
    assert torch.equal(before[:, 2], after[:, 2])  # the skill


def test_an_episode_cut_by_the_clock_goes_on_with_its_value(make_runner):
    runner = make_runner("learner.ppo.gamma=0.9", "learner.imitation.reward_weight=0")
    collect(runner)
    st = runner.alg.storage
    task = 0.5 - st.actions.square().sum(-1)
    cut = (st.dones.squeeze(-1) > 0) & ~runner.env.falls
    assert cut.any() and ((st.dones.squeeze(-1) > 0) & runner.env.falls).any()
    for group, reward in ((TASK, task), (IMITATION, torch.zeros_like(task))):
        bootstrapped = reward + torch.where(cut, 0.9 * st.values[..., group], 0.0)
        torch.testing.assert_close(st.rewards[..., group], bootstrapped)


def test_one_critic_learns_the_sum_of_both_rewards(make_runner):
    gamma = "learner.ppo.gamma=0"
    two, one = make_runner(gamma), make_runner(gamma, *null("multi_critic"))
    task = make_runner(gamma, "learner.imitation.reward_weight=0")
    for runner in (two, one, task):
        if runner is not two:  # the same networks act and judge
            runner.alg.actor.load_state_dict(two.alg.actor.state_dict())
            for name, part in runner.alg.parts.items():
                part.load_state_dict(copy.deepcopy(two.alg.parts[name].state_dict()))
        torch.manual_seed(2)
        runner.env.observe()
        collect(runner)
    rewards = two.alg.storage.rewards
    assert rewards[..., IMITATION].min() > 0
    torch.testing.assert_close(task.alg.storage.rewards[..., TASK], rewards[..., TASK])
    torch.testing.assert_close(one.alg.storage.rewards[..., 0], rewards.sum(-1))


def test_task_rewards_can_be_clipped_at_zero(make_runner):
    runner = make_runner("learner.ppo.only_positive_rewards=true", "learner.ppo.gamma=0")
    collect(runner)
    st = runner.alg.storage
    task = 0.5 - st.actions.square().sum(-1)
    assert task.min() < 0 < task.max()
    torch.testing.assert_close(st.rewards[..., TASK], task.clamp(min=0))


def test_the_action_noise_stays_below_its_cap(make_runner):
    runner = make_runner("learner.ppo.action_std=[[0,0.4],[1,0.1]]")
    stds = [0.4, 0.25, 0.1]
    for iteration, std in zip((0, 5, 10), stds, strict=True):
        runner.alg.load(copy.deepcopy(runner.alg.save()) | {"iteration": iteration})
        runner.alg.act(runner.env.get_observations())
        torch.testing.assert_close(runner.alg.actor.output_std, torch.full((16, 2), std))


def test_skills_are_drawn_by_their_task_values(make_runner):
    runner = make_runner("learner.skill_init.smoothing=0", "learner.skill_init.floor=0.01")
    runner.learn(1)
    probabilities = runner.env.probabilities
    assert probabilities.sum() == pytest.approx(1.0)
    task_critic = runner.alg.critic.critics[TASK]
    for parameter in task_critic.parameters():
        torch.nn.init.zeros_(parameter)
    task_critic.mlp[0].weight.data[0, 0] = 1.0  # V = the first critic number, where positive
    task_critic.mlp[-1].weight.data[0, 0] = 1.0
    keyframes = torch.zeros(2, 3, 5)
    keyframes[..., 0] = torch.tensor([[1.0, 1.0, 4.0], [5.0, 6.0, 7.0]])  # means 2 and 6
    runner.alg.choose_skills(keyframes)
    drawn = runner.alg.skill_probabilities
    torch.testing.assert_close(drawn, torch.tensor([1 - 2 / 8, 1 - 6 / 8]))


def test_bfloat16_changes_values_by_its_rounding_alone(make_runner):
    exact, rounded = (
        make_runner(f"learner.precision={precision}").alg.critic
        for precision in ("float32", "bfloat16")
    )
    rounded.load_state_dict(exact.state_dict())
    for critic in (exact, rounded):  # what a critic learns: values of about 100
        critic.critics[TASK].mlp[-1].bias.data.fill_(100.0)
    obs = {names.CRITIC: torch.randn(500, 5)}
    difference = (exact(obs) - rounded(obs)).abs()
    assert rounded(obs).dtype == torch.float32
    assert 0.0 < difference.max() < 0.02  # 100 itself would be rounded by up to 0.25


def test_an_unknown_precision_is_refused(make_runner):
    with pytest.raises(ConfigError, match="precision=half: allowed are auto, float32, bfloat16"):
        make_runner("learner.precision=half")


def test_a_saved_learner_goes_on(make_runner):
    runner, other = make_runner(), make_runner("seed=9")
    runner.learn(3)
    saved = copy.deepcopy(runner.alg.save())
    other.alg.load(saved)
    assert other.alg.iteration == 3
    obs = runner.env.get_observations()
    assert torch.equal(other.alg.act_deterministic(obs), runner.alg.act_deterministic(obs))
    again = other.alg.save()
    assert again.keys() == saved.keys()
    assert torch.equal(*(x["parts"]["skill_init"]["probabilities"] for x in (again, saved)))


@pytest.mark.parametrize("phase", [SKILL_LEARNING, FINETUNING])
def test_replayed_rollouts_and_updates_are_the_same(make_runner, taped, phase):
    plain, replayed = (make_runner("learner.estimator.epochs=3", phase=phase) for _ in range(2))
    recorded = [replayed.alg._rollout._act, replayed.alg._rollout._store]
    trained = [replayed.alg, *replayed.alg.parts.values()]
    recorded += [part.trainer._pass for part in trained if hasattr(part, "trainer")]
    for part in recorded:
        part.records = True
    for runner in (plain, replayed):
        torch.manual_seed(2)
        runner.learn(3)
    assert all(part._recording is not None for part in recorded)
    expected = networks(plain.alg)
    for name, weights in networks(replayed.alg).items():
        assert torch.equal(weights, expected[name]), name
