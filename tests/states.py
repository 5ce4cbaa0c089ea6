"""Nested states of tensors, compared bit by bit."""

from __future__ import annotations

import torch


def differences(a, b, path=""):
    """List where two nested states differ."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        return [d for key in a for d in differences(a[key], b[key], f"{path}/{key}")]
    if isinstance(a, list | tuple):
        assert len(a) == len(b), path
        return [d for i, pair in enumerate(zip(a, b, strict=True))
                for d in differences(*pair, f"{path}/{i}")]  # fmt: skip
    if isinstance(a, torch.Tensor):
        same = a.dtype == b.dtype and torch.equal(torch.nan_to_num(a), torch.nan_to_num(b))
        return [] if same else [path]
    return [] if a == b else [path]
