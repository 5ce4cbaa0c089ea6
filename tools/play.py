"""kiras-play: drive one simulated robot with a policy, live or by a script."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from kiras_rl.deploy.policy import PolicyError
from kiras_rl.tools.driving import replay, summary
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.ground import FLAT, terrain_of
from kiras_rl.tools.driving.script import (
    Segment,
    Trace,
    default_script,
    parse_command,
    parse_script,
    record,
)
from kiras_rl.tools.driving.viewer import DEFAULT_PORT, LOOPBACK
from kiras_rl.tools.driving.viewer.choices import title_of
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.playback import Playback
from kiras_rl.tools.shared import policy_files
from kiras_rl.tools.shared.arguments import PICTURES, file_of
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.outputs import check_output, save_arrays

_DESCRIPTION = """\
Drive one simulated robot with a trained policy, through the same code that runs on a real robot, on
flat or rough ground: live in a browser page (what happens without options) or with the keys of a
terminal, or by a script, which ends in a table of every skill's errors or in pictures.

The policy is one of
  RUN          a run folder: its policy.onnx, else checkpoints/best.pt, else checkpoints/latest.pt
  CHECKPOINT   a .pt file of a run
  ONNX         a policy file written by kiras-train or kiras-export
  (nothing)    the policy that comes with the robot

Live, the page and --terminal show their keys. With --table, --trace, --frames or --video, or with
--script or --command alone, a script is driven: without --script the robot stands for one second
and then shows every skill for four. A robot that falls is put back into the posture of its skill.

--terrain stairs_up:4:1 is variant 1 of level 4 of stairs that lead up; level and variant are 0
where they are left out. The tiles are those of the policy's run, or else of its robot's
configuration; odd variants of slopes lead down. At the end of its tile the robot starts again in
the middle.

--log shows a black box of kiras-robot in place of a simulation, beside the keyframe of its skill:
in the page or with --terminal. POLICY is then the one that ran, whose keyframes are meant.
Exit status: 0, also after Ctrl-C, or 2 if something was wrong with what was given.
"""

_EXAMPLES = """\
examples:
  kiras-play                                        the shipped policy, in a browser page
  kiras-play runs/solo8/2026-01-01_12-00-00         the policy of a run
  kiras-play --host 0.0.0.0 --port 9000             let other machines see the page, and drive
  kiras-play --terminal                             drive with keys where there is no browser
  kiras-play runs/solo8/2026-01-01_12-00-00 --follow    watch a training: newest checkpoint
  kiras-play --terrain stairs_up:4                     on stairs, live; or with what follows
  kiras-play --table                                every skill's errors
  kiras-play --trace trace.png                      posture, speed, contacts, torques over time
  kiras-play --frames strip.png --video walk.mp4    pictures and a film
  kiras-play --command 0.5,0,0.3                    every skill, turning left at 0.3 rad/s
  kiras-play --log robot_logs/2026-01-31_12-00-00/blackbox_1    what a robot did before a fault
  kiras-play --script walk:4:0.3,crawl:4:0.3        skill:seconds:v_x[:v_y[:yaw_rate]], ...
"""

TRACE = "kiras-play --trace"
_COMMAND = "0.3"  # m/s, of a script that is not given
_SCREENSHOT_SPEED = 0.3  # m/s

_OUTPUTS = {
    "--trace": ((*PICTURES, ".npz"), "everything over time, drawn or as arrays"),
    "--frames": (PICTURES, "a strip of pictures for every skill"),
    "--video": ((".mp4",), "a film; needs kiras-rl[video]"),
    "--screenshot": ((".png", ".jpg"), "the page, drawn by a headless Chromium"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    options = _parser().parse_args(arguments)

    def work() -> None:
        _check_outputs(options)
        _check_log(options)
        with suppress(KeyboardInterrupt):  # Ctrl-C is how a drive ends
            _drive(options) if _is_live(options) else _play(options)

    return finish(work)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kiras-play",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("policy", nargs="?", type=Path, metavar="POLICY", help="RUN, CHECKPOINT or ONNX, as above")
    add("--robot", metavar="NAME", help="whose shipped policy to take (solo8)")
    tasks = parser.add_mutually_exclusive_group()
    tasks.add_argument(
        "--script", metavar="TEXT", help="what to do: skill:seconds:v_x[:v_y[:yaw_rate]], ..."
    )
    tasks.add_argument(
        "--command",
        metavar="V_X[,V_Y[,YAW]]",
        help="command for every skill, m/s and rad/s (0.3)",
    )
    tasks.add_argument("--log", type=Path, metavar="FOLDER", help="show a black box of kiras-robot")
    add("--terrain", metavar="TYPE[:LEVEL[:VARIANT]]", help="ground to drive on, as above (flat)")
    add("--table", action="store_true", help="print every skill's errors")
    for name, (endings, text) in _OUTPUTS.items():
        add(name, type=file_of(endings), metavar="FILE", help=f"{text} ({' '.join(endings)})")
    _add_live_options(parser.add_argument_group("live"))
    return parser


def _add_live_options(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--terminal", action="store_true", help="drive with keys, without a browser")
    add("--follow", action="store_true", help="load a run's newest checkpoint as it appears")
    add("--host", default=LOOPBACK, help=f"address that the page listens on ({LOOPBACK})")
    add("--port", type=int, default=DEFAULT_PORT, help=f"its port, 0: any ({DEFAULT_PORT})")
    add("--no-browser", action="store_true", help="only print the page's address")


def _check_outputs(options: argparse.Namespace) -> None:
    for option in _OUTPUTS:
        path = getattr(options, option[2:])
        if path:
            check_output(path, f"kiras-play {option}")


def _check_log(options: argparse.Namespace) -> None:
    """Refuse what a log cannot be combined with.

    Raises:
        PolicyError: If there is something of that.
    """
    others = ("terrain", "follow", "table", "trace", "frames", "video", "screenshot")
    given = [f"--{name}" for name in others if getattr(options, name)]
    if options.log and given:
        raise PolicyError(f"--log is only shown, in the page or with --terminal: no {given[0]}")


def _is_live(options: argparse.Namespace) -> bool:
    scripted = options.script or options.command or options.table
    return not (scripted or options.trace or options.frames or options.video)


def _drive(options: argparse.Namespace) -> None:
    """Let a person drive, or take a picture of what they would see."""
    from kiras_rl.tools.driving.viewer import live  # mujoco.studio: what a script does not need

    cockpit = _playback(options) if options.log else _cockpit(options)
    follow = options.policy if options.follow else None
    if options.screenshot:
        live.save_screenshot(cockpit, options.screenshot, speed=_SCREENSHOT_SPEED)
        print(f"wrote {options.screenshot}")
    elif options.terminal:
        live.drive_terminal(cockpit, follow)
    else:
        live.drive_page(cockpit, options.host, options.port, not options.no_browser, follow)


def _cockpit(options: argparse.Namespace) -> Cockpit:
    from kiras_rl.tools.driving.viewer import live

    source = options.policy
    if options.follow:
        if source is None:
            raise PolicyError("--follow needs a run: kiras-play runs/solo8/<time> --follow")
        policy = policy_files.load_policy(live.wait_for_checkpoint(source), options.robot)
    else:
        policy = policy_files.load_policy(source, options.robot)
    shipped = source or policy_files.shipped_policy(policy.metadata.robot)
    tile = terrain_of(policy.metadata).parse(options.terrain) if options.terrain else FLAT
    return Cockpit(policy, title_of(shipped), tile=tile)


def _playback(options: argparse.Namespace) -> Playback:
    log = replay.load_log(options.log)
    policy = replay.policy_of(log, options.policy)
    return Playback(policy, log, f"{log.robot}: {options.log.resolve().name}")


def _play(options: argparse.Namespace) -> None:
    """Drive a script, and show how it went."""
    driver = Driver(policy_files.load_policy(options.policy, options.robot))
    if options.terrain:
        tile = driver.terrain.parse(options.terrain)
        driver.show(tile.kind, tile.level, tile.variant)
    trace = record(driver, _script(options, driver))
    if options.table or not (options.trace or options.frames or options.video):
        rows = summary.summarize(trace, driver.metadata)
        make_console().print(summary.table(rows, trace.title))
    if options.trace:
        _save_trace(trace, driver, options.trace)
    if options.frames or options.video:
        _save_pictures(trace, driver, options)


def _script(options: argparse.Namespace, driver: Driver) -> list[Segment]:
    if options.script is not None:
        return parse_script(options.script, driver.metadata)
    return default_script(driver.metadata, parse_command(options.command or _COMMAND))


def _save_trace(trace: Trace, driver: Driver, path: Path) -> None:
    if path.suffix == ".npz":
        save_arrays(trace.arrays(), path, TRACE)
    else:
        from kiras_rl.tools.driving.trace_figure import (
            save_trace_figure,  # matplotlib takes a second
        )

        save_trace_figure(trace, driver.metadata, path)
    print(f"wrote {path}")


def _save_pictures(trace: Trace, driver: Driver, options: argparse.Namespace) -> None:
    from kiras_rl.tools.driving.film import save_strips, save_video

    tallest = max(posture.base_height for posture in driver.metadata.keyframes.values())
    for path, save in ((options.frames, save_strips), (options.video, save_video)):
        if path:
            save(trace, driver.model, tallest, path)
            print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
