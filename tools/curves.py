"""Learning curves of a run as one picture, read back from its TensorBoard log."""

from __future__ import annotations

from pathlib import Path

PANELS = (
    ("height, deterministic [m]", "Eval_{}/height"),
    ("pitch, deterministic [rad]", "Eval_{}/pitch"),
    ("v_x at 0.3 m/s, deterministic [m/s]", "Eval_{}/velocity"),
    ("foot lifts a second, deterministic", "Eval_{}/lifts"),
    ("imitation reward", "Imitation/reward_{}"),
    ("skill probability", "Skill/probability_{}"),
)


def draw_curves(run_dir: Path) -> Path:
    """Write run_dir/curves.png and return its path."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    series = read_scalars(run_dir)
    tags = [tag for tag in series if tag.startswith("Eval_") and tag.endswith("/height")]
    skills = [tag.removeprefix("Eval_").removesuffix("/height") for tag in tags]
    figure, axes = plt.subplots(2, 4, figsize=(18, 7.5), layout="constrained")
    for axis, (title, pattern) in zip(axes.flat, PANELS, strict=False):
        for skill in skills:
            if pattern.format(skill) in series:
                axis.plot(*series[pattern.format(skill)], label=skill)
        axis.set_title(title)
    for axis, title, prefixes in (
        (axes.flat[6], "discriminator", ("Discriminator/expert", "Discriminator/policy")),
        (axes.flat[7], "rewards a step", ("Critic/task_reward", "Critic/imitation_reward")),
    ):
        for tag in filter(series.__contains__, prefixes):
            axis.plot(*series[tag], label=tag.split("/")[1])
        axis.set_title(title)
    for axis in axes.flat[[0, 6, 7]]:
        if axis.lines:
            axis.legend()
    for axis in axes.flat:
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.3)
    path = run_dir / "curves.png"
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def read_scalars(run_dir: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Return tag -> (iterations, values) of a run's log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    log.Reload()
    return {
        tag: ([e.step for e in log.Scalars(tag)], [e.value for e in log.Scalars(tag)])
        for tag in log.Tags()["scalars"]
    }
