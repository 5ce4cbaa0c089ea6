"""KirasPPO: PPO with a critic for each reward group, and parts that shape what it learns."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from itertools import chain

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import nn

from kiras_rl import distributed
from kiras_rl import interfaces as names
from kiras_rl.algorithms import losses, returns
from kiras_rl.algorithms.part import Iteration
from kiras_rl.algorithms.parts import Learner, build_learner, reward_groups
from kiras_rl.algorithms.rollout import Rollout
from kiras_rl.algorithms.storage import GroupRolloutStorage, mini_batches
from kiras_rl.algorithms.trainer import Trainer
from kiras_rl.interfaces import SkillEnv
from kiras_rl.models.actor import Actor
from kiras_rl.models.critics import GroupCritic
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.schedules import advantage_weights, piecewise_linear
from kiras_rl.schema import LearnerConfig
from kiras_rl.shards import Batch, apply

TASK = 0  # reward group; those of the parts follow


class KirasPPO(PPO):
    """The learner: actor, critics, and the parts that the configuration lists.

    Letters: T steps, N worlds, G reward groups (task, imitation), S skills.

    Attributes:
        parts: By name, in the order in which they are asked; see kiras_rl.algorithms.part.
    """

    actor: Actor
    critic: GroupCritic
    storage: GroupRolloutStorage

    def __init__(
        self, learner: Learner, config: LearnerConfig, iterations: int, device: str
    ) -> None:
        """Take what was built; `iterations` is the length of the phase."""
        ppo = config.ppo
        super().__init__(
            learner.actor,
            learner.critic,  # pyright: ignore[reportArgumentType], it has what rsl-rl asks for
            learner.storage,
            num_learning_epochs=ppo.num_epochs,
            num_mini_batches=ppo.num_mini_batches,
            clip_param=ppo.clip_param,
            gamma=ppo.gamma,
            lam=ppo.lam,
            value_loss_coef=ppo.value_loss_coef,
            entropy_coef=0.0,  # the noise is scheduled: its entropy has no gradient
            learning_rate=ppo.learning_rate,
            max_grad_norm=ppo.max_grad_norm,
            device=device,
        )
        self.desired_kl = torch.zeros((), device=device)
        self._data: dict[str, torch.Tensor] = {}
        self.trainer = Trainer(
            [*learner.actor.mlp.parameters(), *learner.critic.parameters()],
            self._loss,
            ppo.learning_rate,
            device,
            self._batches,
            adjust=self._adapt_and_clip,
        )
        self.optimizer = self.trainer.optimizer  # rsl-rl saves it
        # On the device, as the KL divergence that it follows: no step of the update waits for it
        self.learning_rate = self.trainer.rate
        self._rollout = Rollout(learner, device)
        self.config = config
        self.iterations = iterations
        self.iteration = 0
        self.parts, self._policy = learner.parts, learner.policy
        self._earning = reward_groups(self.parts)
        self._apply_schedules()

    @property
    def progress(self) -> float:
        """How much of this phase is done, t / T1 or t / T2."""
        return self.iteration / self.iterations

    # --- rollout --------------------------------------------------------------------------------

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions (N, J).

        Values are not needed before the rollout is over: `compute_returns` asks the critics once.
        """
        return self._rollout.act(obs)

    def act_deterministic(self, obs: TensorDict) -> torch.Tensor:
        """Return mean actions (N, J) as the exported policy computes them."""
        with torch.inference_mode():
            return self.policy()(obs[names.PROPRIO], obs[names.HISTORY])[0]

    def policy(self) -> ExportedPolicy:
        """Return actor and estimator as the module that is exported."""
        return self._policy

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict
    ) -> None:
        """Store one environment step.

        Args:
            obs: Observation after the step; not used, what counts is in extras.
            rewards: Task reward, (N,).
            dones: Ended episodes, (N,).
            extras: See kiras_rl.interfaces.
        """
        self._rollout.store(rewards, dones, extras)

    @torch.no_grad()
    def compute_returns(self, obs: TensorDict) -> None:
        """Judge the rollout: values, imitation rewards, returns and one mixed advantage.

        Args:
            obs: Observation after the last step.
        """
        st = self.storage
        st.values = self._values(st.observations[names.CRITIC])
        # rsl-rl's convention: an episode cut by the clock goes on with the value where it began
        st.rewards = self._group_rewards() + self.gamma * st.values * st.time_outs
        advantages = returns.generalized_advantages(
            st.rewards, st.values, self._values(obs[names.CRITIC]), st.dones, self.gamma, self.lam
        )
        st.returns = advantages + st.values
        st.advantages = returns.mix_advantages(advantages, self._weights(), self._std_floor())

    def _values(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the values of critic observations (..., C) in every group, (..., G)."""
        flat = {names.CRITIC: observations.flatten(0, -2)}
        values = apply(lambda **batch: self.critic(batch), flat)
        return values.unflatten(0, observations.shape[:-1])

    def _group_rewards(self) -> torch.Tensor:
        """Return the rewards of task and parts, (T, N, G); summed where there is one critic."""
        task = self.storage.task_rewards
        task = task.clamp(min=0.0) if self.config.ppo.only_positive_rewards else task
        others = [part.rewards().unsqueeze(-1) for part in self._earning]
        if self.config.multi_critic:
            return torch.cat([task, *others], dim=-1)
        return sum(others, start=task)

    def _weights(self) -> tuple[float, ...]:
        """Return omega_1 of the task's advantages, and omega_2 of those of each part."""
        mix = self.config.multi_critic
        if mix is None or not self._earning:
            return (1.0,)
        task, other = advantage_weights(self.progress, mix.sigma, mix.omega2_floor)
        return (task, *(other for _ in self._earning))

    def _std_floor(self) -> float:
        mix = self.config.multi_critic
        return mix.std_floor if mix else 1e-8

    # --- update ---------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Train every part on the rollout; return scalars for the log, by their full names."""
        scalars = self._describe_rollout()
        scalars |= self._update_policy()
        now = Iteration(self.iteration, self.num_mini_batches, self.learning_rate)
        for part in self.parts.values():
            scalars |= part.update(self.storage, now)
        self.storage.clear()
        self.iteration += 1
        self._apply_schedules()
        return scalars

    def _update_policy(self) -> dict[str, float]:
        st = self.storage
        tensors = {
            "actor_obs": self.actor.get_latent(st.observations),
            "critic_obs": st.observations[names.CRITIC],
            "actions": st.actions,
            "old_log_prob": st.actions_log_prob,
            "advantages": st.advantages,
            "returns": st.returns,
            "mean": st.action_mean,
            "std": st.action_std,
        }
        for part in self.parts.values():
            tensors |= {key: st.observations[key] for key in part.learns_from}
        st.shuffle_into(self._data, **tensors)
        surrogate, value, kl = self.trainer.train(self.num_learning_epochs).tolist()
        return {
            "Loss/surrogate": surrogate,
            "Loss/value": value,
            "Policy/kl": kl,
            "Policy/learning_rate": self.learning_rate.item(),
            "Policy/action_std": self.actor.distribution.std_param.mean().item(),
        }

    def _batches(self) -> Iterator[Batch]:
        for batch in mini_batches(self._data, self.num_mini_batches):
            for part in self.parts.values():
                batch |= part.prepare(batch)
            yield batch

    def _loss(
        self,
        actor_obs: torch.Tensor,
        critic_obs: torch.Tensor,
        actions: torch.Tensor,
        old_log_prob: torch.Tensor,
        advantages: torch.Tensor,
        returns: torch.Tensor,
        mean: torch.Tensor,
        std: torch.Tensor,
        **of_parts: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss on rows of the rollout and (surrogate, value, KL), (3,)."""
        distribution = copy.copy(self.actor.distribution)  # it remembers what it was updated with
        distribution.update(self.actor.mlp(actor_obs))
        surrogate = losses.surrogate_loss(
            distribution.log_prob(actions), old_log_prob.squeeze(1), advantages.squeeze(1),
            self.clip_param,
        )  # fmt: skip
        value = losses.value_loss(self.critic({names.CRITIC: critic_obs}), returns)
        loss = surrogate + self.value_loss_coef * value
        for part in self.parts.values():
            loss = loss + part.policy_loss(distribution.mean, of_parts)
        with torch.no_grad():
            kl = distribution.kl_divergence((mean, std), distribution.params).mean()
        return loss, torch.stack([surrogate, value, kl])

    def _adapt_and_clip(self, numbers: torch.Tensor) -> torch.Tensor:
        """Adapt the step size to the mean KL divergence of all ranks, and clip the gradients.

        Args:
            numbers: What `_loss` returns on this rank, (3,).
        """
        kl = distributed.mean(numbers[2])
        limits = self.config.ppo.learning_rate_range
        adapted = losses.adapt_learning_rate(self.learning_rate, kl, self.desired_kl, limits)
        self.learning_rate.copy_(adapted)  # in place: the optimizer reads this tensor
        for network in (self.actor, *self.critic.critics):
            nn.utils.clip_grad_norm_(network.parameters(), self.max_grad_norm)
        return torch.stack([*numbers[:2], kl])

    def _apply_schedules(self) -> None:
        """Set the action noise, the KL divergence and the imitation of the next iteration."""
        self.actor.distribution.std_param.fill_(
            piecewise_linear(self.config.ppo.action_std, self.progress)
        )
        self.desired_kl.fill_(piecewise_linear(self.config.ppo.desired_kl, self.progress))
        for part in self.parts.values():
            part.set_progress(self.progress)

    # --- skills ---------------------------------------------------------------------------------

    def choose_skills(self, keyframe_observations: torch.Tensor) -> None:
        """Let the parts choose what is practised next, by the values of the task critic.

        Args:
            keyframe_observations: Critic observations at the keyframes, (S, commands, C).
        """
        with torch.no_grad():
            values = self.critic({names.CRITIC: keyframe_observations.flatten(0, 1)})[:, TASK]
        values = values.unflatten(0, keyframe_observations.shape[:2]).mean(dim=1)
        values, practised = distributed.mean(values), distributed.total(self._practised)
        for part in self.parts.values():
            part.choose_skills(values, practised)

    @property
    def skill_probabilities(self) -> torch.Tensor | None:
        """How likely the environment shall draw each skill, (S,); None where no part says so."""
        wanted = (part.probabilities for part in self.parts.values())
        return next((chosen for chosen in wanted if chosen is not None), None)

    def _describe_rollout(self) -> dict[str, float]:
        st = self.storage
        one_hot = st.observations[names.SKILL].flatten(0, 1)  # (T N, S)
        self._practised = one_hot.sum(dim=0)
        scalars = {"Policy/advantage_weight_task": self._weights()[TASK]}
        groups = ["task", *(part.reward_group for part in self._earning)]
        for g, group in enumerate(groups[: st.rewards.shape[-1]]):
            kinds = {"reward": st.rewards, "return": st.returns, "value": st.values}
            scalars |= {f"Critic/{group}_{k}": x[..., g].mean().item() for k, x in kinds.items()}
            spread = (st.returns - st.values)[..., g].std()
            scalars[f"Critic/{group}_advantage_std"] = spread.item()
        for part in self.parts.values():
            scalars |= part.describe(st)
        return scalars

    # --- construction, modes, state -------------------------------------------------------------

    @classmethod
    def construct_algorithm(
        cls, obs: TensorDict, env: SkillEnv, cfg: dict, device: str
    ) -> KirasPPO:
        """Build the learner of a phase; see `build_learner` for the arguments."""
        learner = build_learner(obs, env, cfg, device)
        return cls(learner, cfg["learner"], cfg["iterations"], device)

    def networks(self) -> dict:
        """Return copies of all weights that go on into the next phase."""
        lasting: dict[str, nn.Module] = {"actor": self.actor, "critic": self.critic.critics[TASK]}
        for part in self.parts.values():
            lasting |= part.lasting()
        return {name: copy.deepcopy(network.state_dict()) for name, network in lasting.items()}

    def begin_from(self, networks: dict, learner: dict) -> None:
        """Begin a phase where the one before ended.

        Args:
            networks: What `networks` returned there.
            learner: What `save` returned there: step size and what parts keep go on.
        """
        self.actor.load_state_dict(networks["actor"])
        self.critic.critics[TASK].load_state_dict(networks["critic"])
        limits = self.config.ppo.learning_rate_range
        self.learning_rate.fill_(learner["learning_rate"]).clamp_(*limits)
        for name, part in self.parts.items():
            part.begin_from(networks, learner["parts"].get(name, {}))
        self._apply_schedules()

    def train_mode(self) -> None:
        """Do nothing: no network here behaves differently in training."""

    def eval_mode(self) -> None:
        """Do nothing, for the same reason."""

    def save(self) -> dict:
        """Return every network, optimizer and statistic."""
        saved = super().save()
        saved["iteration"] = self.iteration
        saved["learning_rate"] = self.learning_rate.item()
        saved["parts"] = {name: part.state_dict() for name, part in self.parts.items()}
        return saved

    def load(self, loaded_dict: dict, load_cfg: dict | None = None, strict: bool = True) -> bool:
        """Load what `save` returned."""
        super().load(loaded_dict, load_cfg or {"actor": True, "critic": True}, strict)
        self.trainer.load_state_dict(loaded_dict["optimizer_state_dict"])
        self._rollout.forget()
        self.iteration = loaded_dict["iteration"]
        self.learning_rate.fill_(loaded_dict["learning_rate"])
        for name, part in self.parts.items():
            part.load_state_dict(loaded_dict["parts"][name])
        self._apply_schedules()
        return True

    def world_state(self) -> dict:
        """Return what of the statistics belongs to the worlds of this rank; `save` has it, too."""
        return {name: part.world_state() for name, part in self.parts.items()}

    def load_world_state(self, state: dict) -> None:
        """Load what `world_state` returned, or some of it."""
        for name, values in state.items():
            self.parts[name].load_world_state(values)
        self._rollout.forget()

    def broadcast_parameters(self) -> None:
        """Take the networks of rank 0."""
        of_parts = (part.networks().values() for part in self.parts.values())
        for network in (self.actor, self.critic, *chain.from_iterable(of_parts)):
            distributed.broadcast_module(network)
