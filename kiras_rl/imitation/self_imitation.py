"""Self-imitation learning: the discriminator, its reward and the premium trajectories."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict

from kiras_rl import distributed
from kiras_rl import interfaces as names
from kiras_rl.algorithms.adam import load_adam, make_adam
from kiras_rl.algorithms.losses import discriminator_loss, gradient_penalty
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.imitation.premium import PremiumSelector
from kiras_rl.interfaces import SkillEnv
from kiras_rl.models.discriminator import Discriminator, imitation_reward
from kiras_rl.recorded import Recorded
from kiras_rl.schedules import piecewise_linear
from kiras_rl.schema import ImitationConfig


class SelfImitation:
    """What the learner owns to imitate keyframes and its own best motions.

    Letters: T steps, N worlds, B pairs of a batch, D features, S skills.
    """

    def __init__(
        self,
        config: ImitationConfig,
        keyframe_features: torch.Tensor,
        feature_noise: torch.Tensor,
        skill_code: torch.Tensor,
        skills: tuple[str, ...],
        num_envs: int,
        num_steps: int,
        bfloat16: bool,
    ) -> None:
        """Build discriminator, optimizer, selector and the rollout's pairs.

        Args:
            config: See cfg/base.yaml.
            keyframe_features: Phi of each keyframe, (S, D).
            feature_noise: Standard deviation of one unit of instance noise, (D,).
            skill_code: Which features are the one-hot code of the skill, (D,) bool: there D may be
                as steep as it likes.
            skills: Names, for the log.
            num_envs: N.
            num_steps: T.
            bfloat16: Multiply the hidden layers of the discriminator in it.
        """
        device = keyframe_features.device
        features = keyframe_features.shape[1]
        self.config = config
        self._skills = skills
        self._device = device
        self._noise = feature_noise.repeat(2)
        self._smooth = ~skill_code.repeat(2)
        self._noise_factor = torch.ones((), device=device)
        dims = config.discriminator.hidden_dims
        self.discriminator = Discriminator(features, dims, bfloat16).to(device)
        rate = config.discriminator.learning_rate
        self.optimizer = make_adam(self.discriminator.parameters(), rate, device)
        self.selector = PremiumSelector(config.premium, keyframe_features, num_envs, num_steps)
        self._pairs = torch.zeros(num_steps, num_envs, 2 * features, device=device)
        self._valid = torch.zeros(num_steps, num_envs, dtype=torch.bool, device=device)
        self._skill = torch.zeros(num_steps * num_envs, dtype=torch.int64, device=device)
        self._rewards = torch.zeros(num_steps, num_envs, device=device)
        self._train = Recorded(
            self._train_step, device, carried=self._carried, enabled=distributed.size() == 1
        )

    def _carried(self) -> list[tuple[object, str]]:
        """Return what a training step reads and others replace; see `Recorded`."""
        expert = [(self.selector, name) for name in ("scores", "trajectories")]
        return [*expert, (self, "_skill")]

    @classmethod
    def build(
        cls,
        config: ImitationConfig | None,
        obs: TensorDict,
        env: SkillEnv,
        num_steps: int,
        bfloat16: bool,
        device: str,
    ) -> SelfImitation | None:
        """Build for an environment, or return None where the configuration has no imitation."""
        if config is None:
            return None
        return cls(
            config,
            env.keyframe_features.to(device),
            env.feature_noise.to(device),
            _skill_code(env).to(device),
            env.skills,
            len(obs),
            num_steps,
            bfloat16,
        )

    def record(
        self,
        storage: GroupRolloutStorage,
        before: Mapping[str, torch.Tensor],
        after: torch.Tensor,
        valid: torch.Tensor,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        time_outs: torch.Tensor,
    ) -> None:
        """Store a step; in place, as a recorded step has to.

        Args:
            storage: Knows which row of the rollout this is.
            before: Observations before the step.
            after: Phi after it and before a reset, (N, D): a pair is of one episode.
            valid: Whether that is one undisturbed motion, (N,) bool.
            rewards: Task reward, (N,).
            dones: Ended episodes, (N,).
            time_outs: Those that the clock ended, (N,) bool.
        """
        storage.write_row(self._pairs, torch.cat([before[names.IMITATION], after], dim=-1))
        storage.write_row(self._valid, valid)
        failed = dones.bool() & ~time_outs
        command, velocity = before[names.COMMAND][:, :2], before[names.VELOCITY][:, :2]
        speed = torch.linalg.vector_norm(command, dim=-1)
        self.selector.record(
            features=after,
            skill=before[names.SKILL].argmax(dim=-1),
            reward=rewards,
            speed=speed,
            progress=(velocity * command).sum(dim=-1) / speed.clamp(min=1e-6),
            done=dones.bool(),
            valid=valid & ~failed,
        )

    @torch.no_grad()
    def rewards(self) -> torch.Tensor:
        """Return the imitation reward of every step of the rollout, (T, N)."""
        score = self.discriminator(self._pairs)
        self._rewards = self.config.reward_weight * imitation_reward(score) * self._valid
        return self._rewards

    def update(
        self, storage: GroupRolloutStorage, iteration: int, progress: float
    ) -> dict[str, float]:
        """Renew the premium buffer, train the discriminator; return scalars for the log."""
        one_hot = storage.observations[names.SKILL]
        scalars = self._describe(one_hot)
        self.selector.select(iteration)
        self._skill = one_hot.flatten(0, 1).argmax(dim=-1)
        self._noise_factor.fill_(piecewise_linear(self.config.discriminator.noise, progress))
        for _ in range(self.config.discriminator.updates):
            loss, expert, policy = self._train()
        scalars |= {
            "Discriminator/loss": loss.item(),
            "Discriminator/expert": expert.mean().item(),
            "Discriminator/policy": policy.mean().item(),
        }
        return scalars | self._describe_buffer(iteration)

    def _train_step(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Take one step on a batch; experts show the same skills as the policy's pairs.

        Other proportions would reward a skill for being frequent: its code is an input.
        """
        pairs, valid = self._pairs.flatten(0, 1), self._valid.flatten()
        size = self.config.discriminator.batch_size
        drawn = torch.randint(len(pairs), (size,), device=pairs.device)
        expert = self.selector.sample(self._skill[drawn])
        both = torch.cat([expert, pairs[drawn]])
        both = both + self._noise_factor * self._noise * torch.randn_like(both)
        expert_score, policy_score = self.discriminator(both).chunk(2)
        loss = discriminator_loss(expert_score, policy_score, valid[drawn])
        weight = self.config.discriminator.gradient_penalty
        if weight > 0:
            loss = loss + weight * gradient_penalty(
                self.discriminator, *both.chunk(2), features=self._smooth
            )
        self.optimizer.zero_grad()
        loss.backward()
        distributed.average_gradients(self.discriminator.parameters())
        self.optimizer.step()
        return loss.detach(), expert_score.detach(), policy_score.detach()

    def _describe(self, one_hot: torch.Tensor) -> dict[str, float]:
        """Return the mean imitation reward of each skill over the rollout."""
        count = distributed.total(one_hot.sum(dim=(0, 1))).clamp(min=1.0)
        sums = distributed.total((self._rewards.unsqueeze(-1) * one_hot).sum(dim=(0, 1)))
        means = sums / count
        return _by_skill("Imitation/reward", self._skills, means)

    def _describe_buffer(self, iteration: int) -> dict[str, float]:
        selector = self.selector
        known = selector.scores.isfinite()
        count = selector.counts
        age = ((iteration - selector.born) * known).sum(dim=1) / count.clamp(min=1)
        best = torch.where(count > 0, selector.scores[:, 0], 0.0)
        return {
            **_by_skill("Premium/best_score", self._skills, best),
            **_by_skill("Premium/age", self._skills, age),
            **_by_skill("Premium/count", self._skills, count),
        }

    def state_dict(self) -> dict:
        """Return networks, optimizer and buffers."""
        return {
            "discriminator": self.discriminator.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "selector": self.selector.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
        self.discriminator.load_state_dict(state["discriminator"])
        load_adam(self.optimizer, state["optimizer"], self._device)
        self._train.forget()
        self.selector.load_state_dict(state["selector"])


def _skill_code(env: SkillEnv) -> torch.Tensor:
    """Return which features of Phi are the code of the skill, (D,) bool."""
    parts = [torch.full((size,), name == names.SKILL) for name, size, _ in env.imitation_terms]
    return torch.cat(parts)


def _by_skill(tag: str, skills: tuple[str, ...], values: torch.Tensor) -> dict[str, float]:
    return {f"{tag}_{name}": value for name, value in zip(skills, values.tolist(), strict=True)}
