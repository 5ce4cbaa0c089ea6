"""Four Solo-8 on flat ground, each in another keyframe, on every physics backend.

Warp compiles its kernels when they are first used, for about a minute, and keeps them in
~/.cache/warp (WARP_CACHE_PATH moves that folder): the next run of the tests finds them there.
"""

import pytest
import torch

from kiras_rl.envs.model import build_scene
from kiras_rl.robots.robot import load_robot

WORLDS, SUBSTEPS = 4, 4


class Drill:
    """The same start and the same targets for every simulation of four Solo-8."""

    def __init__(self, library=None):
        self.robot = load_robot("solo8")
        self.scene = build_scene(  # dry friction of joints takes many iterations to converge
            self.robot, timestep=0.005, solver_iterations=60, max_delay=3, library=library
        )
        self.scene.model.opt.tolerance = 1e-8  # backends agree where their solvers converge
        frames = [torch.tensor(k.qpos) for k in self.robot.keyframes[:WORLDS]]
        self.qpos = torch.stack(frames).float()
        self.hold = self.qpos[:, 7:].clone()
        noise = torch.rand(20, WORLDS, 8, generator=torch.Generator().manual_seed(1))
        self.targets = self.hold + 0.6 * noise - 0.3  # rad, over 20 control steps

    def begin(self, sim, worlds=(0, 1, 2, 3), lift=0.005):
        """Put worlds into their keyframes, `lift` metres above the ground or one for each."""
        qpos, hold = self.qpos.to(sim.device, copy=True), self.hold.to(sim.device)
        qpos[:, 2] += torch.as_tensor(lift, device=sim.device)
        qvel = torch.zeros(WORLDS, sim.model.nv, device=sim.device)
        sim.write_state(self.mask(sim, worlds), qpos, qvel, hold)

    def run(self, sim, targets=None):
        """Simulate and return what a simulation hands out, each (T, N, ...)."""
        targets = self.targets if targets is None else targets
        steps = []
        for target in targets.to(sim.device):
            sim.step(target)
            motion = {
                "qpos": sim.qpos,
                "qvel": sim.qvel,
                "record": sim.sensor_record,
                "diverged": sim.diverged,
            }
            steps.append({name: x.cpu().clone() for name, x in motion.items()})
        return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}

    @staticmethod
    def mask(sim, worlds):
        mask = torch.zeros(WORLDS, dtype=torch.bool, device=sim.device)
        mask[list(worlds)] = True
        return mask

    @staticmethod
    def nominal(sim, field):
        values = torch.tensor(getattr(sim.model, field), dtype=torch.float32, device=sim.device)
        return values.repeat(WORLDS, *[1] * values.dim())

    def set_delays(self, sim, steps):
        """Delay the targets of world i by steps[i] physics steps."""
        # Half a step less, as in Randomizer: reads the same target, whatever the rounding of time.
        seconds = (torch.tensor(steps).float() - 0.5).clamp(min=0) * sim.model.opt.timestep
        values = seconds[:, None].expand(-1, sim.model.nu).to(sim.device)
        sim.write_field("actuator_delay", self.mask(sim, range(WORLDS)), values)


@pytest.fixture(scope="session")
def drill():
    return Drill()


@pytest.fixture(scope="session")
def make_drill():
    """Return a function that makes the drill for the tiles of a library."""
    return Drill


@pytest.fixture(scope="session")
def build(drill):
    """Return a function that builds a simulation: native, warp (on the CPU) or cuda (warp)."""

    def make(name, model=drill.scene.model, max_contacts=24, max_constraints=112, **options):
        if name == "native":
            from kiras_rl.envs.simulation.native import NativeSimulation

            return NativeSimulation(model, WORLDS, SUBSTEPS, **{"threads": 1} | options)
        from kiras_rl.envs.simulation.warp import WarpSimulation

        device = torch.device("cuda" if name == "cuda" else "cpu")
        return WarpSimulation(
            model, WORLDS, SUBSTEPS, device, max_contacts, max_constraints, **options
        )

    return make


@pytest.fixture(scope="session")
def simulations(build):
    """Return a function that hands out the one simulation of a backend, as new."""
    built = {}

    def get(name):
        if name not in built:
            sim = build(name)
            built[name] = sim, sim.state_dict()
        sim, initial = built[name]
        sim.load_state_dict(initial)
        return sim

    return get
