"""The vectorised legged environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kiras_rl.config import ConfigError
from kiras_rl.robots.robot import load_robot
from kiras_rl.schema import Config

if TYPE_CHECKING:
    import torch

    from kiras_rl.envs.quadruped import QuadrupedEnv
    from kiras_rl.robots.robot import Robot

BACKENDS = ("auto", "native", "warp")


def make_env(
    config: Config,
    device: torch.device | str = "cpu",
    num_envs: int | None = None,
    robot: Robot | None = None,
    progress: float = 1.0,
) -> QuadrupedEnv:
    """Build the environment of a configuration.

    Args:
        config: The run.
        device: Where the tensors live; `auto` takes the native backend on a CPU, else warp.
        num_envs: Worlds, if not the configuration's.
        robot: The robot, if not the configuration's: one with other keyframes, say.
        progress: How much of a phase is done; what changes over it has the value of then.

    Raises:
        ConfigError: Unknown backend, or the native backend on a GPU.
        RobotError: Unknown robot or a keyframe that cannot be.
    """
    # imported here: terrains and scenes are made without torch, which takes seconds
    import torch

    from kiras_rl.envs.quadruped import QuadrupedEnv

    device = torch.device(device)
    return QuadrupedEnv(
        config.env,
        config.sim,
        robot or load_robot(config.robot),
        config.num_envs if num_envs is None else num_envs,
        resolve_backend(config.sim.backend, device),
        device,
        config.seed,
        progress,
    )


def resolve_backend(name: str, device: torch.device) -> str:
    """Return "native" or "warp".

    Raises:
        ConfigError: Unknown name, or a native backend asked for on a GPU.
    """
    if name not in BACKENDS:
        raise ConfigError(f"sim.backend={name}: allowed are {', '.join(BACKENDS)}")
    if name == "auto":
        return "native" if device.type == "cpu" else "warp"
    if name == "native" and device.type != "cpu":
        raise ConfigError("sim.backend=native runs on the CPU: set device=cpu or sim.backend=auto")
    return name
