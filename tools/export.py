"""kiras-export: write the policy of a run or checkpoint as one ONNX file."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata
from kiras_rl.tools.shared import policy_files
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.outputs import OutputError, check_output

_DESCRIPTION = """\
Write the policy of a training run as one ONNX file with everything a robot needs: network, joint
order, gains, default pose, action scale, observation terms, skills. The file is compared with torch
on 1,000 random inputs before it is written.

  RUN          a run folder: checkpoints/best.pt, else checkpoints/latest.pt -> RUN/policy.onnx
  CHECKPOINT   a .pt file of a run -> the same name with .onnx beside it
  ONNX         a policy file -> --out, the same with the block `onboard` of today's robot.yaml: what
               kiras-robot checks, which a file of before lacks
"""

_EXAMPLES = """\
examples:
  kiras-export runs/solo8/2026-01-01_12-00-00
  kiras-export runs/solo8/2026-01-01_12-00-00/checkpoints/latest.pt --out policy.onnx
  kiras-export old.onnx --out new.onnx      after a change of robots/<robot>/robot.yaml: onboard

then, on the robot (numpy and onnxruntime are all it needs):
  policy = kiras_rl.deploy.policy.OnboardPolicy("policy.onnx")
"""

_TIMED_STEPS = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(
        prog="kiras-export",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=Path, metavar="RUN|CHECKPOINT|ONNX", help="as above")
    parser.add_argument("--out", type=Path, metavar="FILE", help="file to write")
    options = parser.parse_args(arguments)
    return finish(lambda: _export(options.source, options.out))


def _export(source: Path, out: Path | None) -> None:
    if out:
        _check_place(out)
    if out and source.is_file() and source.suffix == ".onnx":
        _complete(source, out)
        return
    checkpoint = policy_files.find_checkpoint(source)
    beside = source / "policy.onnx" if source.is_dir() else source.with_suffix(".onnx")
    report = policy_files.export_checkpoint(checkpoint, out or beside)
    policy = OnboardPolicy(report.path)
    median, slowest = 1e3 * np.quantile(_step_times(policy), (0.5, 0.99))
    table = Table(show_header=False, box=None)
    table.add_row("checkpoint", str(checkpoint))
    table.add_row("policy", str(report.path))
    table.add_row("size", f"{report.size / 1000:.0f} kB")
    table.add_row(
        "against torch", f"{report.max_difference:.1e} at most, {report.checked} random inputs"
    )
    table.add_row("latency", f"{median:.3f} ms median, {slowest:.3f} ms p99, one thread")
    for name, text in _describe(policy.metadata):
        table.add_row(name, text)
    make_console().print(table)


def _complete(source: Path, out: Path) -> None:
    """Write a policy file with the numbers of kiras-robot that robot.yaml has today."""
    from kiras_rl.export import describe_again  # torch takes seconds

    before = OnboardPolicy(source).metadata
    after = policy_files.with_todays_profile(before)
    if after.onboard is None:
        raise PolicyError(
            f"robots/{before.base_robot}/robot.yaml has no block onboard (docs/extending.md)"
        )
    describe_again(source, after, out)
    print(f"wrote {out}")


def _check_place(path: Path) -> None:
    """Refuse the place of anything but a policy file.

    Raises:
        OutputError: There is something else.
    """
    try:
        if path.is_file():
            OnboardPolicy(path)
        else:
            check_output(path, "kiras-export")
    except PolicyError:
        raise OutputError(
            f"{path} is there and is no policy file: name another file, or remove it"
        ) from None


def _step_times(policy: OnboardPolicy) -> np.ndarray:
    """Return how long single control steps take on this machine, s."""
    joints = np.array(policy.metadata.default_joint_pos)
    rest = np.zeros(3)
    times = np.zeros(_TIMED_STEPS)
    for index in range(_TIMED_STEPS):
        start = time.perf_counter()
        policy.step(joints, 0 * joints, (1, 0, 0, 0), rest, rest, 0)
        times[index] = time.perf_counter() - start
    return times


def _describe(metadata: PolicyMetadata) -> list[tuple[str, str]]:
    terms = ", ".join(f"{term.name} {term.size}" for term in metadata.observation)
    ranges = metadata.command_range
    return [
        ("robot", f"{metadata.robot}, {metadata.num_joints} joints, {metadata.control_rate:g} Hz"),
        ("skills", ", ".join(metadata.skills)),
        ("frame", f"{metadata.frame_size}: {terms}"),
        ("history", f"{metadata.history_length} past frames"),
        ("v_x", f"{ranges.lin_vel_x[0]:g} to {ranges.lin_vel_x[1]:g} m/s"),
        ("v_y", f"{ranges.lin_vel_y[0]:g} to {ranges.lin_vel_y[1]:g} m/s"),
        ("yaw rate", f"{ranges.ang_vel_z[0]:g} to {ranges.ang_vel_z[1]:g} rad/s"),
        ("kiras-robot", "its numbers are in" if metadata.onboard else "robot.yaml has no onboard"),
        ("version", metadata.version),
    ]


if __name__ == "__main__":
    sys.exit(main())
