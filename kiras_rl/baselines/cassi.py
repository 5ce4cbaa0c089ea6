"""Cassi: skills that are told apart without labels, in the style of unlabelled motions.

Li et al., Versatile Skill Control via Self-supervised Adversarial Imitation of Unlabeled Mixed
Motions, ICRA 2023, arXiv 2209.07899. Of D, a discriminator of pairs of frames, and of M classifiers
q_m(z | window), with p their mean, a step earns

    style         max(1 - (D - 1)^2 / 4, 0),
    skill         max(log p(z) + log S, 0),
    disagreement  H(p) - mean_m H(q_m).

The latent z is the skill that the environment draws; which one it became is matched afterwards.

Letters: T steps, N worlds, B rows of a batch, D features, W frames of a window, M classifiers,
S skills.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
import torch
from torch import nn

from kiras_rl import distributed
from kiras_rl import interfaces as names
from kiras_rl.algorithms.losses import discriminator_loss, gradient_penalty, weights_of
from kiras_rl.algorithms.part import Iteration, Outcome, Part, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.algorithms.trainer import Trainer
from kiras_rl.config import ConfigError
from kiras_rl.imitation.motions import Motions, load_motions
from kiras_rl.limits import LARGEST, limited
from kiras_rl.models.discriminator import Discriminator, imitation_reward
from kiras_rl.shards import Batch, apply


@dataclass
class CassiConfig:
    """Keys of the part.

    Attributes:
        dataset: Folder that kiras-collect wrote, or the name of one in kiras_rl.imitation.motions.
        style_weight: Of the discriminator's reward.
        skill_weight: Of the classifiers' reward.
        disagreement_weight: Of the reward for what the classifiers do not agree on.
        window: W.
        members: M.
        discriminator_dims: Widths.
        classifier_dims: Widths.
        discriminator_rate: Adam's step size.
        classifier_rate: Adam's step size.
        gradient_penalty: Weight of E |dD/dx|^2 at the experts.
        updates: Gradient steps of an iteration, of discriminator and of classifiers.
        batch_size: Rows of a step, of each class together.
    """

    dataset: str
    style_weight: float = field(metadata=limited(0, LARGEST))
    skill_weight: float = field(metadata=limited(0, LARGEST))
    disagreement_weight: float = field(metadata=limited(0, LARGEST))
    window: int = field(metadata=limited(2, 1000))
    members: int = field(metadata=limited(1, 100))
    discriminator_dims: list[int] = field(metadata=limited(0, 100_000, above=True))
    classifier_dims: list[int] = field(metadata=limited(0, 100_000, above=True))
    discriminator_rate: float = field(metadata=limited(0, 10))
    classifier_rate: float = field(metadata=limited(0, 10))
    gradient_penalty: float = field(metadata=limited(0, LARGEST))
    updates: int = field(metadata=limited(1, 100_000))
    batch_size: int = field(metadata=limited(1, 10**9))


class Ensemble(nn.Module):
    """Classifiers of windows of motion."""

    def __init__(self, inputs: int, hidden_dims: list[int], members: int, skills: int) -> None:
        """Build M networks with ReLU from W * D numbers to S logits."""
        super().__init__()
        self.members = nn.ModuleList(
            _classifier(inputs, hidden_dims, skills) for _ in range(members)
        )

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        """Return the logits of every member, (B, M, S), for windows (B, W * D)."""
        return torch.stack([member(windows) for member in self.members], dim=1)

    def each(self, windows: torch.Tensor) -> torch.Tensor:
        """Return the logits, (B, M, S), of every member for windows of its own, (B, M, W * D)."""
        logits = [member(windows[:, m]) for m, member in enumerate(self.members)]
        return torch.stack(logits, dim=1)


def skill_reward(probabilities: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
    """Return max(log p(z) - log 1/S, 0), (B,), which guessing does not earn.

    Args:
        probabilities: Of each member, (B, M, S).
        skill: One-hot codes of z, (B, S).
    """
    right = (probabilities.mean(dim=1) * skill).sum(dim=-1)
    return (right.clamp(min=1e-8).log() + np.log(skill.shape[-1])).clamp(min=0.0)


def disagreement(probabilities: torch.Tensor) -> torch.Tensor:
    """Return H(mean_m q_m) - mean_m H(q_m), (B,), nats, for probabilities (B, M, S)."""
    return _entropy(probabilities.mean(dim=1)) - _entropy(probabilities).mean(dim=1)


def match(cost: np.ndarray) -> tuple[int, ...]:
    """Return the column of each row of a square cost, (S, S), such that their sum is least.

    All S! assignments are tried, which is nothing for a handful of skills.
    """
    rows = np.arange(len(cost))
    return min(permutations(range(len(cost))), key=lambda columns: cost[rows, columns].sum())


class Windows:
    """The last W frames of each world's motion, and those of a rollout.

    Attributes:
        windows: Of the rollout, oldest frame first, (T, N, W * D).
        lengths: How many of their frames, from the last one back, are of one motion, (T, N).
    """

    def __init__(self, steps: int, worlds: int, size: int, features: int, device: str) -> None:
        """Begin without motion."""
        self._last = torch.zeros(worlds, size, features, device=device)
        self._length = torch.zeros(worlds, dtype=torch.int64, device=device)
        self._skill = torch.zeros(worlds, dtype=torch.int64, device=device)
        self.windows = torch.zeros(steps, worlds, size * features, device=device)
        self.lengths = torch.zeros(steps, worlds, dtype=torch.int64, device=device)

    def record(
        self,
        rollout: GroupRolloutStorage,
        before: torch.Tensor,
        after: torch.Tensor,
        skill: torch.Tensor,
        valid: torch.Tensor,
        ends: torch.Tensor,
    ) -> None:
        """Add a step; in place, as in any graph.

        With the end of an episode, or where the skill changes, another motion begins.

        Args:
            rollout: Whose current row it is.
            before: Features before the step, (N, D).
            after: Features after it and before a reset, (N, D).
            skill: Which was asked for, (N,).
            valid: Whether both are of one motion, (N,) bool.
            ends: Whether the motion ends with the step, (N,) bool.
        """
        size = self._last.shape[1]
        self._last.copy_(torch.cat([self._last[:, 1:], after[:, None]], dim=1))
        self._last[:, -2] = before
        before_it = torch.where(skill == self._skill, self._length, 0)
        length = torch.where(valid, (before_it.clamp(min=1) + 1).clamp(max=size), 1)
        rollout.write_row(self.windows, self._last.flatten(1))
        rollout.write_row(self.lengths, length)
        self._length.copy_(torch.where(ends, 0, length))
        self._skill.copy_(skill)

    def state_dict(self) -> dict:
        """Return the motions that go on."""
        return {"last": self._last, "length": self._length, "skill": self._skill}

    def load_state_dict(self, state: dict) -> None:
        """Go on with saved motions."""
        for name, value in state.items():
            getattr(self, f"_{name}").copy_(value)


class Cassi(Part):
    """Discriminator, classifiers and what they are trained on."""

    settings = CassiConfig
    reward_group = "imitation"

    def __init__(self, config: CassiConfig, motions: Motions, setting: Setting) -> None:
        """Build the networks and what they are trained with."""
        env, device = setting.env, setting.device
        steps, skills = setting.config.ppo.num_steps, len(env.skills)
        self.config, self._skills, self._device = config, env.skills, device
        self.motions, self._reward_scale = motions, setting.reward_scale
        features = motions.frames.shape[1]
        self._keyframes = motions.normalize(env.keyframe_features.to(device))
        self.motion = Windows(steps, env.num_envs, config.window, features, device)
        self._skill = torch.zeros(steps, env.num_envs, skills, device=device)
        dims, size = config.discriminator_dims, config.window * features
        self.discriminator = Discriminator(features, dims, setting.bfloat16).to(device)
        dims = config.classifier_dims
        self.ensemble = Ensemble(size, dims, config.members, skills).to(device)
        self._smooth = torch.ones(2 * features, dtype=torch.bool, device=device)
        self._of_style = Trainer(
            self.discriminator.parameters(),
            self._style_loss,
            config.discriminator_rate,
            device,
            self._style_batches,
        )
        self._of_skill = Trainer(
            self.ensemble.parameters(),
            self._skill_loss,
            config.classifier_rate,
            device,
            self._skill_batches,
        )

    @classmethod
    def build(cls, config: CassiConfig, setting: Setting) -> Cassi:
        """Build for the features that an environment gives.

        Raises:
            ConfigError: Motions that cannot be read, or lack a feature.
        """
        return cls(config, load_motions(config.dataset, setting.env, setting.device), setting)

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """Keep the window that ends with a step."""
        self.motion.record(
            rollout,
            self.motions.normalize(step.seen[names.IMITATION]),
            self.motions.normalize(step.extras[names.EXTRA_IMITATION]),
            step.seen[names.SKILL].argmax(dim=-1),
            step.extras[names.EXTRA_VALID],
            step.dones > 0,
        )
        rollout.write_row(self._skill, step.seen[names.SKILL])
        return {}

    @torch.no_grad()
    def rewards(self) -> torch.Tensor:
        """Return the reward of every step of the rollout, (T, N)."""
        rows = {"windows": self._rows(), "skill": self._skill.flatten(0, 1)}
        style, skill, novelty = apply(self._judge, rows).unbind(dim=-1)
        length = self.motion.lengths.flatten()
        whole = length >= self.config.window
        terms = (
            self.config.style_weight * style * (length >= 2),
            self.config.skill_weight * skill * whole,
            self.config.disagreement_weight * novelty * whole,
        )
        self._earned = self._reward_scale * torch.stack(terms)
        return self._earned.sum(dim=0).view_as(self.motion.lengths)

    def _rows(self) -> torch.Tensor:
        return self.motion.windows.flatten(0, 1)

    def _judge(self, windows: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        """Return style, skill and disagreement, (B, 3), of windows (B, W * D)."""
        score = self.discriminator(windows[:, -len(self._smooth) :])
        probabilities = self.ensemble(windows).softmax(dim=-1)
        rewards = (
            imitation_reward(score),
            skill_reward(probabilities, skill),
            disagreement(probabilities),
        )
        return torch.stack(rewards, dim=-1)

    # --- update ---------------------------------------------------------------------------------

    def update(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        """Train discriminator and classifiers; return scalars for the log."""
        style, skill, disagree = self._earned.mean(dim=1).tolist()
        scalars = {
            "Cassi/style_reward": style,
            "Cassi/skill_reward": skill,
            "Cassi/disagreement_reward": disagree,
        }
        scalars |= self._describe_match()
        loss, expert, policy = self._of_style.train(self.config.updates).tolist()
        (entropy,) = self._of_skill.train(self.config.updates).tolist()
        return scalars | {
            "Cassi/classifier_loss": entropy,
            "Discriminator/loss": loss,
            "Discriminator/expert": expert,
            "Discriminator/policy": policy,
        }

    def _style_batches(self) -> Iterator[Batch]:
        rows, size = self._rows(), self.config.batch_size
        drawn = torch.randint(len(rows), (size,), device=self._device)
        counts = self.motion.lengths.flatten()[drawn] >= 2
        yield {
            "expert": self.motions.draw_pairs(size),
            "policy": rows[drawn, -len(self._smooth) :],
            "weight": weights_of(counts),
        }

    def _style_loss(
        self, expert: torch.Tensor, policy: torch.Tensor, weight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss on pairs (B, 2 D), and (loss, scores of experts, of policy), (3,)."""
        expert_score, policy_score = self.discriminator(torch.cat([expert, policy])).chunk(2)
        loss = 0.5 * discriminator_loss(expert_score, policy_score, weight)
        steepness = gradient_penalty(self.discriminator, expert, self._smooth)
        loss = loss + self.config.gradient_penalty * steepness
        return loss, torch.stack([loss, expert_score.mean(), policy_score.mean()])

    def _skill_batches(self) -> Iterator[Batch]:
        """Draw for each member on its own; every class weighs the same, however rare it is."""
        rows, skill = self._rows(), self._skill.flatten(0, 1)
        shape = (self.config.batch_size, self.config.members)
        drawn = torch.randint(len(rows), shape, device=self._device)
        whole = (self.motion.lengths.flatten() >= self.config.window).float()
        share = (skill * whole[:, None]).mean(dim=0).clamp(min=1e-8)  # of the rows, by class
        weight = whole * (skill / share).sum(dim=-1) / len(self._skills)
        yield {"windows": rows[drawn], "skill": skill[drawn], "weight": weight[drawn]}

    def _skill_loss(
        self, windows: torch.Tensor, skill: torch.Tensor, weight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the cross entropy, and the same as a vector of one number.

        Args:
            windows: Of each member, (B, M, W * D).
            skill: One-hot codes, (B, M, S).
            weight: (B, M).
        """
        log_probability = self.ensemble.each(windows).log_softmax(dim=-1)
        loss = -(weight * (log_probability * skill).sum(dim=-1)).mean()
        return loss, loss.view(1)

    def _describe_match(self) -> dict[str, float]:
        """Return which keyframe each z is nearest to, all told, by its mean frame."""
        skill = self._skill.flatten(0, 1)
        frames = self._rows()[:, -self._keyframes.shape[1] :]
        count = distributed.total(skill.sum(dim=0)).clamp(min=1.0)
        means = distributed.total(skill.T @ frames) / count[:, None]
        cost = torch.cdist(means, self._keyframes).cpu().numpy()
        matched = match(cost)
        of_z = {f"Cassi/keyframe_of_{z}": float(k) for z, k in enumerate(matched)}
        return of_z | {"Cassi/distance": float(cost[range(len(cost)), matched].mean())}

    # --- state ----------------------------------------------------------------------------------

    def networks(self) -> dict[str, nn.Module]:
        """Return discriminator and classifiers."""
        return {"discriminator": self.discriminator, "ensemble": self.ensemble}

    def lasting(self) -> dict[str, nn.Module]:
        """Return both: terrain is learned in the same style."""
        return self.networks()

    def state_dict(self) -> dict:
        """Return networks, optimizers and the motions that go on."""
        return {
            "discriminator": self.discriminator.state_dict(),
            "ensemble": self.ensemble.state_dict(),
            "of_style": self._of_style.state_dict(),
            "of_skill": self._of_skill.state_dict(),
            "motion": self.motion.state_dict(),
            "experts": self.motions.mean,
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state.

        Raises:
            ConfigError: The dataset is another one by now.
        """
        if not torch.allclose(state["experts"].cpu(), self.motions.mean.cpu(), atol=1e-4):
            raise ConfigError(
                f"dataset={self.config.dataset}: not the motions that this run began with; put "
                "those back, or start a new run"
            )
        self.discriminator.load_state_dict(state["discriminator"])
        self.ensemble.load_state_dict(state["ensemble"])
        self._of_style.load_state_dict(state["of_style"])
        self._of_skill.load_state_dict(state["of_skill"])
        self.load_world_state(state)

    def world_state(self) -> dict:
        """Return the motions that go on."""
        return {"motion": self.motion.state_dict()}

    def load_world_state(self, state: dict) -> None:
        """Go on with the motions of this rank's worlds."""
        self.motion.load_state_dict(state["motion"])


def _classifier(inputs: int, hidden_dims: list[int], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for hidden in hidden_dims:
        layers += [nn.Linear(inputs, hidden), nn.ReLU()]
        inputs = hidden
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def _entropy(probabilities: torch.Tensor) -> torch.Tensor:
    return -torch.xlogy(probabilities, probabilities).sum(dim=-1)
