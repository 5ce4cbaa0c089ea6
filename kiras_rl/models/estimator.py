"""Estimators: what a robot works out of the frames that it has seen.

Letters: H past frames, P numbers a frame, F numbers of all frames that are read, Z latent numbers,
S skills.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from kiras_rl import interfaces as names

VELOCITY_DIM = 3
_LOG_VAR_RANGE = (-8.0, 4.0)


class Estimator(nn.Module):
    """What the robot takes along: frames -> context, whose first three numbers are a velocity.

    A subclass says what `context` is, and keeps the arguments of its constructor in `_shape`.
    """

    _shape: dict

    def __init__(self, context_dim: int) -> None:
        """Remember the length of the context."""
        super().__init__()
        self.context_dim = context_dim

    def shape(self) -> dict:
        """Return the name of the class and the constructor's arguments, as plain values."""
        kind = type(self)
        return {"class_name": f"{kind.__module__}:{kind.__qualname__}", **self._shape}

    def frames(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return what the encoder reads of `proprio` and `history`, (N, F): the past frames."""
        return obs[names.HISTORY]

    def context(self, frames: torch.Tensor) -> torch.Tensor:
        """Return what the actor sees, (N, context_dim), for frames (N, F).

        It begins with the base velocity in the base frame, m/s.
        """
        raise NotImplementedError


class VariationalEstimator(Estimator):
    """A variational auto-encoder: encoder E(frames) -> velocity, q(z | frames).

    A subclass has the decoder.
    """

    def __init__(self, frames_dim: int, latent_dim: int, encoder_dims: list[int]) -> None:
        """Build the encoder.

        Args:
            frames_dim: F.
            latent_dim: Z.
            encoder_dims: Widths.
        """
        super().__init__(VELOCITY_DIM + latent_dim)
        self.latent_dim = latent_dim
        self.encoder = mlp(frames_dim, encoder_dims, VELOCITY_DIM + 2 * latent_dim)

    def forward(self, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Encode frames (N, F).

        Returns:
            velocity: Base velocity in the base frame, (N, 3), m/s.
            mean: Of q(z | frames), (N, Z).
            log_var: Of q(z | frames), (N, Z).
        """
        sizes = [VELOCITY_DIM, self.latent_dim, self.latent_dim]
        velocity, mean, log_var = self.encoder(frames).split(sizes, dim=-1)
        return velocity, mean, log_var.clamp(*_LOG_VAR_RANGE)

    def context(self, frames: torch.Tensor) -> torch.Tensor:
        """Return what the actor sees: velocity and the latent mean, (N, 3 + Z)."""
        velocity, mean, _ = self(frames)
        return torch.cat([velocity, mean], dim=-1)

    def decode(
        self, velocity: torch.Tensor, latent: torch.Tensor, skill: torch.Tensor
    ) -> torch.Tensor:
        """Predict the next proprioception, (N, P).

        Args:
            velocity: What the encoder says of it, (N, 3), m/s.
            latent: Drawn from q(z | frames), (N, Z).
            skill: One-hot codes, (N, S).
        """
        raise NotImplementedError

    def prior_of(self, skill: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance, (N, Z), of the prior for one-hot skills (N, S): N(0, I)."""
        zero = skill.new_zeros(len(skill), self.latent_dim)
        return zero, zero


class ContextEstimator(VariationalEstimator):
    """The environment context estimator (ECE): a skill-conditioned CVAE on the history.

    Encoder E(o_{t-H..t-1}) -> velocity, z; decoder (z, skill) -> o_{t+1}; prior p(z | skill).
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
        super().__init__(history_length * proprio_dim, latent_dim, encoder_dims)
        self._shape = {
            "proprio_dim": proprio_dim,
            "history_length": history_length,
            "num_skills": num_skills,
            "latent_dim": latent_dim,
            "encoder_dims": list(encoder_dims),
            "decoder_dims": list(decoder_dims),
        }
        self.decoder = mlp(latent_dim + num_skills, decoder_dims, proprio_dim)
        self.prior = nn.Embedding(num_skills, 2 * latent_dim)
        nn.init.zeros_(self.prior.weight)

    def decode(
        self, velocity: torch.Tensor, latent: torch.Tensor, skill: torch.Tensor
    ) -> torch.Tensor:
        """Predict the next proprioception from latents (N, Z) and one-hot skills (N, S)."""
        return self.decoder(torch.cat([latent, skill], dim=-1))

    def prior_of(self, skill: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance of p(z | skill) for one-hot skills (N, S)."""
        mean, log_var = (skill @ self.prior.weight).chunk(2, dim=-1)
        return mean, log_var.clamp(*_LOG_VAR_RANGE)


def mlp(inputs: int, hidden_dims: list[int], outputs: int) -> nn.Sequential:
    """Return a network with ELU between its layers."""
    layers: list[nn.Module] = []
    for hidden in hidden_dims:
        layers += [nn.Linear(inputs, hidden), nn.ELU()]
        inputs = hidden
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))
