"""Dynamic time warping: how far motions are from a keyframe, or from other motions.

The distance of two motions is the sum of the frame distances, Euclidean, along the cheapest path
that matches every frame of the one with frames of the other, in order.

Letters: N motions, T frames, D features, M clips.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch

from kiras_rl.config import ConfigError


def frame_distances(motions: torch.Tensor, keyframe: torch.Tensor) -> torch.Tensor:
    """Return the distance of each frame (..., D) to a keyframe (D,) or keyframes (..., D).

    Their sum over the frames is the distance by dynamic time warping to the keyframe, held as
    long: every frame is matched at least once, and a path that matches each once exists.
    """
    return torch.linalg.vector_norm(motions - keyframe, dim=-1)


def dtw(first: torch.Tensor, second: torch.Tensor) -> float:
    """Return the distance of two motions, (T, D) and (T', D).

    Raises:
        ConfigError: The extra `evaluation` is not installed.
    """
    try:
        from dtaidistance import dtw_ndim
    except ImportError:
        raise ConfigError(
            "dynamic time warping needs one more package: pip install 'kiras-rl[evaluation]'"
        ) from None
    one, other = (x.double().cpu().contiguous().numpy() for x in (first, second))
    return dtw_ndim.distance_fast(one, other, inner_dist="euclidean")


def dtw_to_clips(
    motions: torch.Tensor, clips: Iterable[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distances of motions to reference clips.

    Args:
        motions: (N, T, D).
        clips: M of any length, (T', D) each: another policy's motions, or a data set.

    Returns:
        To the nearest clip, (N,), and the mean over all of them, (N,).

    Raises:
        ConfigError: As `dtw`.
    """
    clips = list(clips)
    distances = torch.tensor([[dtw(motion, clip) for clip in clips] for motion in motions])
    return distances.amin(dim=1), distances.mean(dim=1)
