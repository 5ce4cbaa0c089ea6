"""DreamWaQ: the actor is told a velocity and a latent that five frames say.

Nahrendra et al., ICRA 2023, arXiv 2301.10602. The loss of its context-aided estimator network
(CENet) is

    L = MSE(v~, v) + MSE(o~_{t+1}, o_{t+1}) + beta KL(q(z | o_{t-H..t}) || N(0, I)),

and AdaBoot tells the actor of a world v~ with probability 1 - tanh(CV(R)), R the returns of all
worlds, else v. docs/paper.md says what differs from what was published.

Letters: H past frames, P numbers a frame, N worlds, Z latent numbers, S skills.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.estimation import Estimation
from kiras_rl.algorithms.part import Setting
from kiras_rl.limits import LARGEST, limited
from kiras_rl.models.estimator import VELOCITY_DIM, VariationalEstimator, mlp
from kiras_rl.schema import EstimatorConfig


@dataclass
class CENetConfig:
    """Keys of the part.

    Attributes:
        latent_dim: Z.
        encoder_dims: Widths.
        decoder_dims: Widths.
        relative_step: Adam's step size, of the actor's.
        epochs: Passes over a rollout.
        kl_weight: beta.
    """

    latent_dim: int = field(metadata=limited(0, 100_000))
    encoder_dims: list[int] = field(metadata=limited(0, 100_000, above=True))
    decoder_dims: list[int] = field(metadata=limited(0, 100_000, above=True))
    relative_step: float = field(metadata=limited(0, LARGEST))
    epochs: int = field(metadata=limited(1, 1000))
    kl_weight: float = field(metadata=limited(0, LARGEST))


class CENet(VariationalEstimator):
    """Encoder E(o_{t-H..t}) -> velocity, z; decoder (velocity, z) -> o_{t+1}; prior N(0, I)."""

    def __init__(
        self,
        proprio_dim: int,
        history_length: int,
        latent_dim: int,
        encoder_dims: list[int],
        decoder_dims: list[int],
    ) -> None:
        """Build encoder and decoder."""
        super().__init__((history_length + 1) * proprio_dim, latent_dim, encoder_dims)
        self._shape = {
            "proprio_dim": proprio_dim,
            "history_length": history_length,
            "latent_dim": latent_dim,
            "encoder_dims": list(encoder_dims),
            "decoder_dims": list(decoder_dims),
        }
        self.decoder = mlp(VELOCITY_DIM + latent_dim, decoder_dims, proprio_dim)

    def frames(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the past frames and the current one, oldest first, (N, (H + 1) * P)."""
        return torch.cat([obs[names.HISTORY], obs[names.PROPRIO]], dim=-1)

    def decode(
        self, velocity: torch.Tensor, latent: torch.Tensor, skill: torch.Tensor
    ) -> torch.Tensor:
        """Predict the next proprioception from velocities (N, 3) and latents (N, Z)."""
        return self.decoder(torch.cat([velocity, latent], dim=-1))


class ContextAidedEstimation(Estimation):
    """CENet, its trainer, and AdaBoot on what the actor is told."""

    settings = CENetConfig

    @classmethod
    def build(cls, config: CENetConfig, setting: Setting) -> ContextAidedEstimation:
        """Build for the observations of an environment."""
        proprio, history = (setting.obs[key].shape[1] for key in (names.PROPRIO, names.HISTORY))
        network = CENet(
            proprio,
            history // proprio,
            config.latent_dim,
            config.encoder_dims,
            config.decoder_dims,
        )
        training = EstimatorConfig(
            **asdict(config), prior_weight=0.0, adaboot="bootstrap_input", adaboot_floor=0.0
        )
        return cls(training, network, len(setting.obs), setting.device)
