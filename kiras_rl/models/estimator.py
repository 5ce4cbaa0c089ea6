"""The environment context estimator (ECE): a skill-conditioned CVAE on the history."""

from __future__ import annotations

import torch
from torch import nn

VELOCITY_DIM = 3
_LOG_VAR_RANGE = (-8.0, 4.0)


class ContextEstimator(nn.Module):
    """Encoder E(o_{t-H..t-1}) -> velocity, z; decoder (z, skill) -> o_{t+1}; prior p(z | skill).

    Letters: H frames, P numbers a frame, Z latent numbers, S skills.
    """

    def __init__(
        self,
        proprio_dim: int,
        history_length: int,
        num_skills: int,
        latent_dim: int,
        encoder_dims: list[int],
        decoder_dims: list[int],
    ) -> None:
        """Build encoder, decoder and prior; the prior starts as N(0, I)."""
        super().__init__()
        self._shape = {
            "proprio_dim": proprio_dim,
            "history_length": history_length,
            "num_skills": num_skills,
            "latent_dim": latent_dim,
            "encoder_dims": list(encoder_dims),
            "decoder_dims": list(decoder_dims),
        }
        self.latent_dim = latent_dim
        self.context_dim = VELOCITY_DIM + latent_dim
        encoder_out = VELOCITY_DIM + 2 * latent_dim
        self.encoder = _mlp(history_length * proprio_dim, encoder_dims, encoder_out)
        self.decoder = _mlp(latent_dim + num_skills, decoder_dims, proprio_dim)
        self.prior = nn.Embedding(num_skills, 2 * latent_dim)
        nn.init.zeros_(self.prior.weight)

    def shape(self) -> dict:
        """Return the constructor's arguments."""
        return dict(self._shape)

    def forward(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Encode histories (N, H * P).

        Returns:
            velocity: Base velocity in the base frame, (N, 3), m/s.
            mean: Of q(z | history), (N, Z).
            log_var: Of q(z | history), (N, Z).
        """
        sizes = [VELOCITY_DIM, self.latent_dim, self.latent_dim]
        velocity, mean, log_var = self.encoder(history).split(sizes, dim=-1)
        return velocity, mean, log_var.clamp(*_LOG_VAR_RANGE)

    def context(self, history: torch.Tensor) -> torch.Tensor:
        """Return what the actor sees: velocity and the latent mean, (N, 3 + Z)."""
        velocity, mean, _ = self(history)
        return torch.cat([velocity, mean], dim=-1)

    def decode(self, latent: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        """Predict the next proprioception from latents (N, Z) and one-hot skills (N, S)."""
        return self.decoder(torch.cat([latent, skill], dim=-1))

    def prior_of(self, skill: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance of p(z | skill) for one-hot skills (N, S)."""
        mean, log_var = (skill @ self.prior.weight).chunk(2, dim=-1)
        return mean, log_var.clamp(*_LOG_VAR_RANGE)


def _mlp(inputs: int, hidden_dims: list[int], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for hidden in hidden_dims:
        layers += [nn.Linear(inputs, hidden), nn.ELU()]
        inputs = hidden
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))
