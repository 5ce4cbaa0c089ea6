"""Steps replayed from a CUDA graph are those of the environment; see `taped` for the CPU."""

import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.envs import make_env
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_of
from kiras_rl.recorded import Recorded

TERMS = (
    "env.commands.terms.clock={frequency: [1.0, 3.0]}",
    "env.constraints.joint_speed={most: 1.0}",
    "env.randomization.terms={armature: {factor: [0.5, 2.0]}}",
)
"""Terms that no configuration has, of kinds that a step reads, keeps or writes."""


def build(cfg, phase, device, *overrides):
    small = ("num_envs=6", "env.terminations.episode_length=0.3", "sim.backend=warp")
    terrain = "finetuning.env.terrain={levels: 2, variants: 1}"
    config = load_config(cfg, [*small, terrain, f"device={device}", *overrides])
    return make_env(phase_of(config, phase).config, device)


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value.nan_to_num(9.0), other[name].nan_to_num(9.0)), name
        elif isinstance(value, dict):
            assert_same(value, other[name])


def drive(env):
    """Step, with all that may happen between two steps, and return what was seen."""
    generator, n = torch.Generator().manual_seed(3), env.num_envs

    def steps(count):
        seen = []
        for _ in range(count):
            actions = 2 * torch.rand(n, env.num_actions, generator=generator) - 1
            obs, rewards, dones, extras = env.step(actions.to(env.device))
            extras.pop("physics_time")
            seen.append(obs.to_dict() | {"rewards": rewards, "dones": dones} | extras)
            seen.append(vars(env.measure()))
        return seen

    seen = steps(20)
    env.episode_length_buf = torch.arange(n)
    env.set_skill_probabilities(torch.tensor([0.0, 0.5, 0.5, 0.0, 0.0]))
    seen += [env.get_observations().to_dict(), *steps(20)]
    saved = env.state_dict()
    seen += [env.reset().to_dict(), *steps(4)]
    env.load_state_dict(saved)
    skill = torch.arange(n, device=env.device) % 5
    command = torch.full((n, 3), 0.1, device=env.device)
    seen += [*steps(4), env.set_task(skill, command).to_dict(), *steps(10)]
    seen += [env.set_task(skill.flip(0), 2 * command).to_dict(), *steps(4)]
    return seen, env.state_dict()


OUTPUTS = ("qpos", "qvel", "sensor_record", "diverged", "overflowed")


def film(env, steps):
    """Let every step of the physics be added to `steps`."""
    simulate = env.sim.step

    def step(ctrl):
        simulate(ctrl)
        steps.append([getattr(env.sim, name).clone() for name in OUTPUTS])

    env.sim.step = step


def play(env, steps):
    """Let the physics do what was filmed: on a GPU it is not the same twice."""
    frames = iter(steps)

    def step(ctrl):
        for name, value in zip(OUTPUTS, next(frames), strict=True):
            getattr(env.sim, name).copy_(value)

    env.sim.step = step


@pytest.mark.parametrize(
    ("phase", "overrides"), [(SKILL_LEARNING, ()), (FINETUNING, ()), (SKILL_LEARNING, TERMS)]
)
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_replayed_steps_are_the_same(phase, overrides, device, request):
    plain, replayed = (build("solo8", phase, device, *overrides) for _ in range(2))
    plain._advance.records = False
    replayed._advance.records = True
    if device == "cpu":
        request.getfixturevalue("taped")
    steps = []
    film(plain, steps)
    expected, end = drive(plain)
    play(replayed, steps)
    seen, end_seen = drive(replayed)
    assert replayed._advance._recording is not None
    for step, (a, b) in enumerate(zip(expected, seen, strict=True)):
        try:
            assert_same(a, b)
        except AssertionError as error:
            raise AssertionError(f"step {step}: {error}") from None
    for state in (end, end_seen):
        state.pop("generator"), state.pop("sim")
    assert_same(end, end_seen)


def test_the_compiler_knows_its_options():
    Recorded(lambda: (), "cuda", compiled=True)  # torch.compile refuses what it does not know
    with pytest.raises(RuntimeError, match="Unexpected optimization option"):
        torch.compile(lambda: (), options={"unroll_reduction_threshold": 33})
