"""The documentation against the code: links, commands, options, keys, metrics, configurations."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import io
import re
import shlex
import tomllib
from pathlib import Path

import mujoco
import pytest
import yaml

from kiras_rl.config import list_configs, load_config
from kiras_rl.envs import rewards
from kiras_rl.envs.state import Step
from kiras_rl.phases import FINETUNING, phase_of
from kiras_rl.robots.onboard import KEYS, read_onboard
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.training.curves import read_scalars
from kiras_rl.tools.training.sweep import load_sweep

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path: path.read_text(encoding="utf-8") for path in PAGES}
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]

PARTS = ("kiras_rl", "envs", "robots", "cfg", "tools")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def prose(text: str) -> str:
    """Return a page without its blocks of code."""
    return FENCE.sub("", text)


def blocks(text: str, language: str) -> list[str]:
    return [code for name, code in FENCE.findall(text) if name == language]


def anchor(heading: str) -> str:
    """Return the address that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def command_lines() -> list[str]:
    """List every kiras-* command line of a shell block, and of a code span with arguments."""
    found = []
    for text in TEXTS.values():
        lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
        lines += re.findall(r"`([^`\n]+)`", prose(text))
        found += [line for line in lines if re.match(r"(\.venv/bin/)?kiras-\w", line)]
    return sorted({line.removeprefix(".venv/bin/").partition(" #")[0].strip() for line in found})


@functools.cache
def help_of(command: str) -> str:
    """Return what a command prints for --help."""
    module, _, function = SCRIPTS[command].partition(":")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        getattr(importlib.import_module(module), function)(["--help"])
    return printed.getvalue()


# --- links ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_relative_link_leads_somewhere(page):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(TEXTS[page])):
        if re.match(r"\w+:", target):
            continue
        name, _, section = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if not path.exists():
            broken.append(target)
        elif section:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            broken += [] if section in map(anchor, headings) else [target]
    assert not broken


def test_every_page_is_in_the_index():
    missing = [p.name for p in PAGES[1:] if f"({p.name})" not in TEXTS[ROOT / "docs" / "index.md"]]
    assert missing == ["index.md"]


def test_every_file_that_is_named_exists():
    """Code spans such as `envs/rewards.py` or `cfg/base.yaml`."""
    missing = [
        f"{page.name}: {file}"
        for page, text in TEXTS.items()
        for file in re.findall(r"`([\w./]+/[\w.]+\.(?:py|yaml|xml|md))\b[^`]*`", prose(text))
        if not any((ROOT / folder / file).exists() for folder in ("", "kiras_rl"))
    ]
    assert not missing


def test_every_name_behind_a_file_exists():
    """Code spans such as `envs/commands.py: TaskSampler.advance`."""
    sources = [path for part in PARTS for path in (ROOT / part).rglob("*.py")]
    missing = []
    for page, text in TEXTS.items():
        for file, name in re.findall(r"`([\w/]+\.py): ([\w.]+)`", text):
            definition = rf"^\s*(def|class) {name.split('.')[-1]}\b|self\.{name.split('.')[-1]} = "
            where = [path for path in sources if path.as_posix().endswith(f"/{file}")]
            if not any(re.search(definition, p.read_text("utf-8"), re.MULTILINE) for p in where):
                missing.append(f"{page.name}: {file}: {name}")
    assert not missing


# --- commands ------------------------------------------------------------------------------------


def test_there_are_commands_to_check():
    assert {line.split()[0] for line in command_lines()} == set(SCRIPTS)


@pytest.mark.parametrize("line", command_lines())
def test_every_command_and_option_exists(line):
    command, *words = shlex.split(line)
    assert command in SCRIPTS
    options = {word.partition("=")[0] for word in words if word.startswith("-")}
    assert options <= set(re.findall(r"--?[\w-]+", help_of(command)))


@pytest.mark.parametrize(
    "line", [line for line in command_lines() if re.match("kiras-(train|bench)", line)]
)
def test_every_override_and_configuration_exists(line):
    _, *words = shlex.split(line)
    given = words[words.index("--cfg") + 1] if "--cfg" in words else "base"
    name = given if given in list_configs() else "solo8"
    made_by_an_example = f"+++ b/cfg/{given}.yaml" in TEXTS[ROOT / "docs" / "extending.md"]
    assert given == name or given.endswith(".yaml") or made_by_an_example
    load_config(name, [word for word in words if re.match(r"[\w.]+=", word)])


def test_every_make_target_exists():
    targets = re.findall(r"^(\w+):.*##", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    named = {
        target
        for text in TEXTS.values()
        for target in re.findall(r"^make (\w+)|`make (\w+)", text, re.MULTILINE)
        for target in target
        if target
    }
    assert named <= set(targets)
    assert {"train", "test"} <= named


# --- configurations and metrics ------------------------------------------------------------------


def test_every_shipped_configuration_is_described():
    text = TEXTS[ROOT / "docs" / "configuration.md"]
    assert [name for name in list_configs() if f"| `{name}` |" not in text] == []


def test_the_example_configurations_load(tmp_path):
    examples = blocks(TEXTS[ROOT / "docs" / "configuration.md"], "yaml")
    configs = {}
    for example in examples:
        path = tmp_path / re.match(r"# (\w+\.yaml)", example)[1]
        path.write_text(example)
        load = functools.partial(load_sweep, overrides=[], runs=tmp_path)
        configs[path.stem] = (load if "\nseeds:" in example else load_config)(str(path))
    mine, steeper, compare = (configs.pop(name) for name in ("mine", "steeper", "compare"))
    assert not configs
    assert [run.name for run in compare[:4]] == [
        *("kiras/seed_1", "uniform/seed_1", "steep/seed_1", "kiras/seed_2")
    ]
    assert mine.env.rewards.terms["lin_vel_y"] is None
    assert mine.learner.skill_init is None
    assert phase_of(steeper, FINETUNING).config.env.terrain.scale == 1.5
    assert phase_of(steeper, FINETUNING).config.iterations == 4000


@pytest.fixture(scope="module")
def tags(smoke_run) -> set[str]:
    """Return the tags that a run of `smoke` wrote, skills and terms as the page spells them."""
    skills = "|".join(sorted(load_robot("solo8").skills, key=len, reverse=True))
    types = "|".join(phase_of(load_config("smoke"), FINETUNING).config.env.terrain.types)
    patterns = (
        (rf"_({skills})(?=/|$)", "_<skill>"),
        (rf"_({types})$", "_<type>"),
        (r"_level_\d+$", "_level_<k>"),
        (r"^Reward/.*", "Reward/<term>"),
        (r"^Episode/ended_by_.*", "Episode/ended_by_<reason>"),
    )
    found = set()
    for tag in read_scalars(smoke_run):
        for pattern, name in patterns:
            tag = re.sub(pattern, name, tag)
        found.add(tag)
    return found


def described_tags() -> set[str]:
    text = TEXTS[ROOT / "docs" / "metrics.md"]
    rows = re.findall(r"^\| (`[A-Z]\w*(?:_<skill>)?/[^|]*) \|", text, re.MULTILINE)
    return {tag for row in rows for tag in re.findall(r"`([^`]+)`", row)}


def test_the_metrics_page_describes_what_a_run_writes_and_nothing_else(tags):
    assert described_tags() == tags


def test_every_reward_term_is_described():
    terms = {
        name
        for name, function in inspect.getmembers(rewards, inspect.isfunction)
        if next(iter(inspect.signature(function).parameters.values())).annotation == Step.__name__
        and not name.startswith("_")
    }
    text = TEXTS[ROOT / "docs" / "metrics.md"].partition("## Reward terms")[2]
    assert set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`[^|]+) \|", text, re.M)))) == terms


# --- code ----------------------------------------------------------------------------------------


class SimulatedRobot:
    """The driver that the snippets call `robot`: Solo-8 in C MuJoCo, for one second."""

    def __init__(self):
        self.model = load_robot("solo8").spec(visuals=False).compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2:] = load_robot("solo8").keyframe("walk").qpos[2:]
        self.data.ctrl[:] = self.data.qpos[7:]
        self.steps = 0

    def is_on(self):
        return self.steps < 50

    def joint_pos(self):
        return self.data.qpos[7:]

    def joint_vel(self):
        return self.data.qvel[6:]

    def imu_quat(self):
        return self.data.qpos[3:7]

    def gyro(self):
        return self.data.qvel[3:6]

    def send(self, target, kp, kd):
        assert len(kp) == len(kd) == 8
        self.data.ctrl[:] = target
        mujoco.mj_step(self.model, self.data, 4)
        self.steps += 1


def test_the_block_onboard_is_whole():
    texts = blocks(TEXTS[ROOT / "docs" / "extending.md"], "yaml")
    (block,) = [text for text in texts if text.startswith("onboard:")]
    assert set(read_onboard(yaml.safe_load(block)["onboard"], "extending.md")) == set(KEYS)


@pytest.mark.parametrize("page", ["README.md", "docs/deploy.md"])
def test_the_onboard_snippet_runs(page, still_file, monkeypatch, tmp_path):
    (snippet,) = blocks(TEXTS[ROOT / page], "python")
    (tmp_path / "policy.onnx").write_bytes(still_file.read_bytes())
    monkeypatch.chdir(tmp_path)
    robot = SimulatedRobot()
    exec(compile(snippet, page, "exec"), {"robot": robot})
    assert robot.steps == 50
    # the policy asks for the default pose, 2 * 0.16 cos 0.8 + 0.016 = 0.239 m high; gains give way
    assert 0.21 < robot.data.qpos[2] < 0.239
