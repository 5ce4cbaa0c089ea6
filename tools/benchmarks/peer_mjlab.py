"""Times mjlab's Go1 on flat ground, in an environment of its own: mjlab needs an older MuJoCo.

Run by the interpreter of that environment, not by ours: it imports nothing of this project.
Standard output carries one line of JSON when the environment stands, {"versions": ...}, and after
each line on standard input the seconds of `steps` control steps under zero actions.

    python peer_mjlab.py DEVICE WORLDS STEPS
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib import metadata

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "torch")


def main(device: str, worlds: int, steps: int) -> None:
    """Answer every line of standard input until it ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    env, step = _build(device, worlds)
    _steps(env, step, steps)  # compiles and warms up
    versions = {name: metadata.version(name) for name in PACKAGES}
    print(json.dumps({"versions": versions, "task": TASK}), file=answers, flush=True)
    for _ in sys.stdin:
        print(json.dumps(_steps(env, step, steps)), file=answers, flush=True)
    env.close()


def _build(device: str, worlds: int):  # noqa: ANN202, its types are not installed here
    import mjlab.tasks  # pyright: ignore[reportMissingImports], registers them
    import torch
    from mjlab.envs import ManagerBasedRlEnv  # pyright: ignore[reportMissingImports]

    config = mjlab.tasks.registry.load_env_cfg(TASK)
    config.scene.num_envs = worlds
    env = ManagerBasedRlEnv(cfg=config, device=device)
    env.reset()
    action = torch.zeros(worlds, env.action_manager.total_action_dim, device=device)
    return env, lambda: env.step(action)


def _steps(env, step, count: int) -> float:  # noqa: ANN001
    import torch

    def wait() -> None:
        if str(env.device).startswith("cuda"):
            torch.cuda.synchronize()

    wait()
    begin = time.perf_counter()
    for _ in range(count):
        step()
    wait()
    return time.perf_counter() - begin


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
