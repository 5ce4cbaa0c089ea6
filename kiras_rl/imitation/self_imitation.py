"""Self-imitation learning: the discriminator, its reward and the premium trajectories."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import nn

from kiras_rl import distributed
from kiras_rl import interfaces as names
from kiras_rl.algorithms.losses import discriminator_loss, gradient_penalty, weights_of
from kiras_rl.algorithms.part import Iteration, Outcome, Part, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.algorithms.trainer import Trainer
from kiras_rl.imitation.premium import PremiumSelector
from kiras_rl.interfaces import SkillEnv
from kiras_rl.models.discriminator import Discriminator, imitation_reward
from kiras_rl.recorded import Slot
from kiras_rl.schedules import piecewise_linear
from kiras_rl.schema import ImitationConfig
from kiras_rl.shards import Batch, apply


class SelfImitation(Part):
    """What the learner owns to imitate keyframes and its own best motions.

    Letters: T steps, N worlds, B pairs of a batch, D features, S skills.
    """

    reward_group = "imitation"

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
        """Build discriminator, trainer, selector and the rollout's pairs.

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
        self._noise = feature_noise.repeat(2)
        self._smooth = ~skill_code.repeat(2)
        self._noise_factor = torch.ones((), device=device)
        self._whole_from = torch.zeros((), device=device)
        dims = config.discriminator.hidden_dims
        self.discriminator = Discriminator(features, dims, bfloat16).to(device)
        self.selector = PremiumSelector(config.premium, keyframe_features, num_envs, num_steps)
        self._pairs = torch.zeros(num_steps, num_envs, 2 * features, device=device)
        self._valid = torch.zeros(num_steps, num_envs, dtype=torch.bool, device=device)
        self._earned = torch.zeros(num_steps, num_envs, device=device)
        self._skill = torch.zeros(num_steps * num_envs, dtype=torch.int64, device=device)
        self._rewards = torch.zeros(num_steps, num_envs, device=device)
        self.trainer = Trainer(
            self.discriminator.parameters(),
            self._loss,
            config.discriminator.learning_rate,
            device,
            self._batches,
            carried=self._carried,
        )

    def _carried(self) -> list[Slot]:
        """Return what a training step reads and others replace; see `Recorded`."""
        expert = [(self.selector, name) for name in ("scores", "trajectories")]
        return [*expert, (self, "_skill")]

    @classmethod
    def build(cls, config: ImitationConfig, setting: Setting) -> SelfImitation:
        """Build for the keyframes of an environment.

        Raises:
            ConfigError: Unknown rule, or a window shorter than a rollout.
        """
        env, device = setting.env, setting.device
        return cls(
            config,
            env.keyframe_features.to(device),
            env.feature_noise.to(device),
            _skill_code(env).to(device),
            env.skills,
            env.num_envs,
            setting.config.ppo.num_steps,
            setting.bfloat16,
        )

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """Keep the pair of a step, and let the selector see it.

        Phi after the step is that before a reset: a pair is of one episode.
        """
        before, after = step.seen, step.extras[names.EXTRA_IMITATION]
        valid, dones = step.extras[names.EXTRA_VALID], step.dones.bool()
        rollout.write_row(self._pairs, torch.cat([before[names.IMITATION], after], dim=-1))
        rollout.write_row(self._valid, valid)
        failed = dones & ~step.extras[names.EXTRA_TIME_OUTS]
        command, velocity = before[names.COMMAND][:, :2], before[names.VELOCITY][:, :2]
        speed = torch.linalg.vector_norm(command, dim=-1)
        progress = (velocity * command).sum(dim=-1) / speed.clamp(min=1e-6)
        rollout.write_row(self._earned, self._share_earned(speed, progress))
        self.selector.record(
            features=after,
            skill=before[names.SKILL].argmax(dim=-1),
            reward=step.rewards,
            speed=speed,
            progress=progress,
            done=dones,
            valid=valid & ~failed,
        )
        return {}

    def _share_earned(self, speed: torch.Tensor, progress: torch.Tensor) -> torch.Tensor:
        """Return the share of the imitation reward that robots get for how they follow, (N,).

        Args:
            speed: Commanded, (N,), m/s.
            progress: Velocity along the command, (N,), m/s.
        """
        whole = self._whole_from * speed
        share = (progress / whole.clamp(min=1e-6)).clamp(0.0, 1.0)
        moves = (speed >= self.config.premium.min_command) & (whole > 0.0)
        return torch.where(moves, share, 1.0)

    def set_progress(self, progress: float) -> None:
        """Set what changes over the phase to its value at this share of it."""
        self._whole_from.fill_(piecewise_linear(self.config.whole_from, progress))
        self._noise_factor.fill_(piecewise_linear(self.config.discriminator.noise, progress))

    @torch.no_grad()
    def rewards(self) -> torch.Tensor:
        """Return the imitation reward of every step of the rollout, (T, N)."""
        score = apply(lambda pairs: self.discriminator(pairs), {"pairs": self._pairs.flatten(0, 1)})
        score = score.view_as(self._valid)
        earned = self._valid * self._earned
        self._rewards = self.config.reward_weight * imitation_reward(score) * earned
        return self._rewards

    def update(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        """Renew the premium buffer, train the discriminator; return scalars for the log."""
        one_hot = rollout.observations[names.SKILL]
        scalars = self._describe_rewards(one_hot)
        self.selector.select(iteration.number)
        self._skill = one_hot.flatten(0, 1).argmax(dim=-1)
        loss, expert, policy = self.trainer.train(self.config.discriminator.updates).tolist()
        scalars |= {
            "Discriminator/loss": loss,
            "Discriminator/expert": expert,
            "Discriminator/policy": policy,
        }
        return scalars | self._describe_buffer(iteration.number)

    def _batches(self) -> Iterator[Batch]:
        """Draw the one batch of an update.

        Experts show the same skills as the policy's pairs: other proportions would reward a skill
        for being frequent, as its code is an input.
        """
        pairs, valid = self._pairs.flatten(0, 1), self._valid.flatten()
        size = self.config.discriminator.batch_size
        drawn = torch.randint(len(pairs), (size,), device=pairs.device)
        expert = self._with_noise(self.selector.sample(self._skill[drawn]))
        policy = self._with_noise(pairs[drawn])
        blend = torch.rand(size, 1, device=pairs.device)
        yield {
            "expert": expert,
            "policy": policy,
            "weight": weights_of(valid[drawn]),
            "between": blend * expert + (1.0 - blend) * policy,
        }

    def _with_noise(self, pairs: torch.Tensor) -> torch.Tensor:
        return pairs + self._noise_factor * self._noise * torch.randn_like(pairs)

    def _loss(
        self,
        expert: torch.Tensor,
        policy: torch.Tensor,
        weight: torch.Tensor,
        between: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss on pairs (B, 2 D), and (loss, mean scores of experts, of policy), (3,).

        Args:
            expert: Pairs of experts.
            policy: Pairs of the policy.
            weight: Of the latter, (B,).
            between: Random points on the way from the one to the other.
        """
        expert_score, policy_score = self.discriminator(torch.cat([expert, policy])).chunk(2)
        loss = discriminator_loss(expert_score, policy_score, weight)
        steepness = self.config.discriminator.gradient_penalty
        if steepness > 0:
            loss = loss + steepness * gradient_penalty(self.discriminator, between, self._smooth)
        return loss, torch.stack([loss, expert_score.mean(), policy_score.mean()])

    def _describe_rewards(self, one_hot: torch.Tensor) -> dict[str, float]:
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

    def networks(self) -> dict[str, nn.Module]:
        """Return the discriminator."""
        return {"discriminator": self.discriminator}

    def state_dict(self) -> dict:
        """Return networks, optimizer and buffers."""
        return {
            "discriminator": self.discriminator.state_dict(),
            "optimizer": self.trainer.state_dict(),
            "selector": self.selector.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
        self.discriminator.load_state_dict(state["discriminator"])
        self.trainer.load_state_dict(state["optimizer"])
        self.selector.load_state_dict(state["selector"])

    def world_state(self) -> dict:
        """Return the windows that are being recorded."""
        return self.selector.world_state()

    def load_world_state(self, state: dict) -> None:
        """Take the windows that were being recorded."""
        self.selector.load_state_dict(state)


def _skill_code(env: SkillEnv) -> torch.Tensor:
    """Return which features of Phi are the code of the skill, (D,) bool."""
    parts = [torch.full((size,), name == names.SKILL) for name, size, _ in env.imitation_terms]
    return torch.cat(parts)


def _by_skill(tag: str, skills: tuple[str, ...], values: torch.Tensor) -> dict[str, float]:
    return {f"{tag}_{name}": value for name, value in zip(skills, values.tolist(), strict=True)}
