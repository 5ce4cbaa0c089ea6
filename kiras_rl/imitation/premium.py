"""The premium trajectory selector: the policy's own best motions become its expert data."""

from __future__ import annotations

import torch

from kiras_rl import distributed
from kiras_rl.config import ConfigError
from kiras_rl.schema import PremiumConfig

RULES = ("topk", "record")
RUNNING = ("_age", "_reward", "_distance", "_speed", "_progress")
"""What is added up over a window."""


def trajectory_scores(
    reward_sum: torch.Tensor, distance_sum: torch.Tensor, length: int, distance_weight: float
) -> torch.Tensor:
    """Return J = mean reward - lambda * mean distance to the keyframe.

    The paper adds the DTW distance to the return, which would prefer motions far from the
    keyframe; both signs and scales are mended here. DTW against a constant keyframe of the same
    length is the sum of the frames' distances: each frame is matched at least once, and a path
    that matches each exactly once exists.
    """
    return (reward_sum - distance_weight * distance_sum) / length


class PremiumSelector:
    """Records windows of motion, scores them, keeps the best of each skill.

    Letters: N worlds, L frames kept, W frames of a window, D features, S skills, K capacity.
    """

    def __init__(
        self,
        config: PremiumConfig,
        keyframe_features: torch.Tensor,
        num_envs: int,
        num_steps: int,
    ) -> None:
        """Allocate the recorder and the buffer.

        Args:
            config: See cfg/base.yaml.
            keyframe_features: Phi of each keyframe, (S, D).
            num_envs: N.
            num_steps: Steps of a rollout, after which `select` is called.

        Raises:
            ConfigError: Unknown rule.
        """
        if config.rule not in RULES:
            raise ConfigError(
                f"learner.imitation.premium.rule={config.rule}: allowed are {', '.join(RULES)}"
            )
        if config.window < num_steps:
            raise ConfigError(
                f"learner.imitation.premium.window={config.window}: at least the "
                f"{num_steps} steps of a rollout (learner.ppo.num_steps)"
            )
        self._config = config
        self._keyframes = keyframe_features
        skills, features = keyframe_features.shape
        device = keyframe_features.device
        # A window that ends early in a rollout must survive until the end of that rollout.
        self._frames = torch.zeros(num_envs, config.window + num_steps, features, device=device)
        self._position = torch.zeros((), dtype=torch.int64, device=device)

        def per_world(value: float, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.full((num_envs,), value, dtype=dtype, device=device)

        self._age, self._skill = per_world(0, torch.int64), per_world(-1, torch.int64)
        self._reward, self._distance = per_world(0), per_world(0)
        self._speed, self._progress = per_world(0), per_world(0)
        self._completed_at = per_world(0, torch.int64)
        self._completed_score = per_world(-torch.inf)
        self._completed_skill = per_world(0, torch.int64)
        size = (skills, config.capacity)
        self.scores = torch.full(size, -torch.inf, device=device)
        self.born = torch.zeros(size, dtype=torch.int64, device=device)
        self.trajectories = torch.zeros(*size, config.window, features, device=device)

    def record(
        self,
        features: torch.Tensor,
        skill: torch.Tensor,
        reward: torch.Tensor,
        speed: torch.Tensor,
        progress: torch.Tensor,
        done: torch.Tensor,
        valid: torch.Tensor,
    ) -> None:
        """Add one step of every world; in place, as a recorded step has to.

        A window holds one skill of one undisturbed episode; a change of skill begins a new one.

        Args:
            features: Phi after the step, before a reset, (N, D).
            skill: Commanded skill, (N,).
            reward: Task reward, unclipped, (N,).
            speed: Commanded speed, (N,), m/s.
            progress: Speed of the base in the direction of the command, (N,), m/s.
            done: Episodes that ended with this step, (N,) bool.
            valid: Whether the step counts; a failure does not, (N,) bool.
        """
        frames, window = self._frames, self._config.window
        place = (self._position % frames.shape[1]).view(1)
        frames.index_copy_(1, place, features.unsqueeze(1))
        self._restart(skill != self._skill)
        self._skill.copy_(skill)
        self._age += 1
        self._reward += reward
        self._distance += torch.linalg.vector_norm(features - self._keyframes[skill], dim=-1)
        self._speed += speed
        self._progress += progress
        full = (self._age == window) & valid
        self._complete(full)
        self._restart(full | done | ~valid)
        self._position += 1

    def _complete(self, full: torch.Tensor) -> None:
        config = self._config
        moving = self._speed / config.window >= config.min_command
        moving &= self._progress >= config.min_progress * self._speed
        near = self._distance / config.window <= config.max_distance
        score = trajectory_scores(
            self._reward, self._distance, config.window, config.distance_weight
        )
        eligible = full & moving & near
        for completed, value in (
            (self._completed_score, score),
            (self._completed_skill, self._skill),
            (self._completed_at, self._position),
        ):
            completed.copy_(torch.where(eligible, value, completed))

    def _restart(self, mask: torch.Tensor) -> None:
        for name in RUNNING:
            getattr(self, name).masked_fill_(mask, 0)

    def select(self, iteration: int) -> None:
        """Move the best windows of the last rollout, of all ranks, into the buffer of each."""
        config, skills = self._config, len(self._keyframes)
        of_skill = self._completed_skill[None] == torch.arange(
            skills, device=self.scores.device
        ).unsqueeze(1)
        scores = torch.where(of_skill, self._completed_score[None], -torch.inf)
        scores = distributed.gather(scores, dim=1)  # (S, N of all ranks)
        if config.rule == "record":
            scores = torch.where(scores > self.scores[:, :1], scores, -torch.inf)
        else:
            expired = iteration - self.born > config.max_age
            self.scores = torch.where(expired, -torch.inf, self.scores)
        count = min(config.per_iteration, scores.shape[1])
        best, worlds = scores.topk(count, dim=1)
        self._insert(best, self._windows(worlds), iteration)
        self._completed_score.fill_(-torch.inf)

    def _windows(self, worlds: torch.Tensor) -> torch.Tensor:
        """Return the completed windows of the given worlds (S, k) of all ranks, (S, k, W, D)."""
        num_worlds, length = self._frames.shape[:2]
        mine = worlds // num_worlds == distributed.rank()
        worlds = worlds % num_worlds
        back = torch.arange(self._config.window - 1, -1, -1, device=worlds.device)
        positions = (self._completed_at[worlds].unsqueeze(-1) - back) % length
        windows = self._frames[worlds.unsqueeze(-1), positions]
        return distributed.total(torch.where(mine[..., None, None], windows, 0.0))

    def _insert(self, scores: torch.Tensor, windows: torch.Tensor, iteration: int) -> None:
        born = torch.full_like(scores, iteration, dtype=torch.int64)
        all_scores = torch.cat([self.scores, scores], dim=1)
        self.scores, order = all_scores.topk(self._config.capacity, dim=1)
        self.born = torch.cat([self.born, born], dim=1).gather(1, order)
        rows = torch.arange(len(order), device=order.device).unsqueeze(1)
        self.trajectories = torch.cat([self.trajectories, windows], dim=1)[rows, order]

    @property
    def counts(self) -> torch.Tensor:
        """Trajectories of each skill, (S,)."""
        return self.scores.isfinite().sum(dim=1)

    def sample(self, skill: torch.Tensor) -> torch.Tensor:
        """Draw expert pairs (Phi_{t-1}, Phi_t) of the given skills.

        A share of them rests in the keyframe; so do all of a skill without trajectories.

        Args:
            skill: (B,) int64.

        Returns:
            (B, 2 D).
        """
        uniform = torch.rand(3, len(skill), device=skill.device)
        count = self.counts[skill]
        rank = (uniform[1] * count).long()  # finite scores come first
        time = (uniform[2] * (self._config.window - 1)).long()
        before = self.trajectories[skill, rank, time]
        after = self.trajectories[skill, rank, time + 1]
        rests = (uniform[0] < self._config.keyframe_share) | (count == 0)
        keyframe = self._keyframes[skill]
        pair = torch.cat([before, after], dim=-1)
        return torch.where(rests[:, None], torch.cat([keyframe, keyframe], dim=-1), pair)

    def state_dict(self) -> dict:
        """Return recorder and buffer."""
        return {k: v for k, v in vars(self).items() if isinstance(v, torch.Tensor)}

    def world_state(self) -> dict:
        """Return the recorder, which belongs to the worlds of this rank."""
        return {k: v for k, v in self.state_dict().items() if k.startswith("_")}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state, or from that of the recorder alone."""
        for name, value in state.items():
            setattr(self, name, torch.as_tensor(value, device=self.scores.device))
