"""The environment: one robot, S skills, N worlds, with the rsl-rl VecEnv interface."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import reduce
from operator import or_

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.envs import commands, curriculum, randomization
from kiras_rl.envs.bounds import broken
from kiras_rl.envs.commands import TaskSampler, find_commands
from kiras_rl.envs.constraints import Constraints
from kiras_rl.envs.curriculum import Curriculum
from kiras_rl.envs.description import describe_deployment
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.kinematics import FootKinematics
from kiras_rl.envs.measuring import measure
from kiras_rl.envs.memory import Memory
from kiras_rl.envs.model import build_scene
from kiras_rl.envs.observations import View
from kiras_rl.envs.observer import NOISE, Observer
from kiras_rl.envs.postures import Postures
from kiras_rl.envs.randomization import (
    Randomizer,
    fields_of,
    find_randomizations,
    nominal_physics,
)
from kiras_rl.envs.randomness import UniformBuffer, columns_of
from kiras_rl.envs.rewards import RewardSum
from kiras_rl.envs.sensing import Sensors
from kiras_rl.envs.simulation.build import make_simulation
from kiras_rl.envs.state import STANDING, Asked, Keyframes, Limits, RobotState, Step, Task
from kiras_rl.envs.terminations import Terminations
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.envs.terrains import CROSSED
from kiras_rl.interfaces import Measurements, SkillEnv
from kiras_rl.recorded import Recorded, copied
from kiras_rl.robots.identity import change, identity
from kiras_rl.robots.robot import Robot
from kiras_rl.schedules import piecewise_linear
from kiras_rl.schema import EnvConfig, SimConfig

GRAVITY = 9.81  # m/s^2
COMPILED = 1024  # worlds; fewer are bound by launches, which a graph takes away by itself
KEYFRAME_COMMANDS = (0.0, 0.4, 0.8)  # of the largest v_x, for the value of a skill


class QuadrupedEnv(SkillEnv):
    """See SkillEnv for the interface and `step` for the order of one control step."""

    cfg: EnvConfig

    def __init__(
        self,
        cfg: EnvConfig,
        sim_cfg: SimConfig,
        robot: Robot,
        num_envs: int,
        backend: str,
        device: torch.device,
        seed: int,
        progress: float = 1.0,
    ) -> None:
        """Build the scene, the worlds and the terms, and reset every world.

        `progress` is how much of a phase is done; see `set_progress`.
        """
        self.cfg, self.robot_cfg = cfg, robot
        self.num_envs, self.num_actions = num_envs, len(robot.joint_names)
        self.device = device
        self.skills = robot.skills
        self.step_dt = sim_cfg.timestep * sim_cfg.substeps
        self.max_episode_length = round(cfg.terminations.episode_length / self.step_dt)
        self._library = build_library(cfg.terrain) if cfg.terrain else None
        delay, late = cfg.randomization.action_delay, cfg.randomization.observation_delay
        self.scene = build_scene(
            robot,
            sim_cfg.timestep,
            sim_cfg.solver_iterations,
            max_delay=delay[1] if delay else 0,
            observation_delay=late[1] if late else 0,
            library=self._library,
        )
        self._randomizations = find_randomizations(cfg.randomization)
        written = fields_of(self._randomizations.values(), self.scene.model)
        self.sim = make_simulation(self.scene, sim_cfg, num_envs, backend, device, written)
        self.keyframes = Keyframes.of(robot, device)
        self.keyframe_height, self.keyframe_pitch = self.keyframes.height, self.keyframes.pitch
        self.keyframe_joint_pos = self.keyframes.joint_pos
        self.keyframe_clearance = self.keyframes.clearance
        self._limits = limits = Limits.of(robot, device)
        self.joint_limits = torch.stack([limits.low, limits.high])
        self.velocity_limit, self.torque_limit = limits.velocity, limits.torque
        self.mass = float(self.scene.model.body_subtreemass[self.scene.base_body])
        self._ground = None
        if self._library:
            self._ground = Ground(self._library, num_envs, device)
            self.terrains, self.terrain_levels = self._library.types, self._library.levels
        self._allocate(robot)
        self._build_terms(seed)
        self.set_progress(progress)
        self._begin()

    # --- construction -------------------------------------------------------------------------

    def _allocate(self, robot: Robot) -> None:
        n, device = self.num_envs, self.device
        self._all = torch.ones(n, dtype=torch.bool, device=device)
        index = torch.zeros(n, dtype=torch.int64, device=device)
        self._commands = find_commands(self.cfg.commands.terms)
        widths = {name: term.func.width for name, term in self._commands.items()}
        command = torch.zeros(n, 3, device=device)
        self.task = Task.of(command, index, index, Asked.nothing(widths, command))
        self._held = False  # tasks set from outside stay until set again
        self._length = index.clone()
        self._action = torch.zeros(n, self.num_actions, device=device)
        self._last_action = self._action.clone()
        self._last_joint_vel = torch.zeros(n, self.num_actions, device=device)
        self._last_joint_torque = torch.zeros(n, self.num_actions, device=device)
        physics = nominal_physics(self.scene)
        self._physics = torch.tensor([physics], device=device).repeat(n, 1)
        self._measurements: Measurements | None = None
        self._kinematics = FootKinematics(self.scene.model, robot, device)
        self.robot = RobotState(self.sim, self.scene.sensors, self._kinematics, self._ground)
        self._postures = Postures(
            robot,
            self.keyframes,
            self._kinematics,
            self._ground,
            self.cfg.skills,
            widths,
            physics,
        )

    def _build_terms(self, seed: int) -> None:
        cfg = self.cfg
        self._observer = Observer(cfg.observations, self._view())
        phi = self._observer.imitation
        self.keyframe_features = phi(self._postures.at_rest([0.0]))
        self.feature_noise = phi.noise
        self.imitation_units = tuple(phi.units)
        self.imitation_terms = tuple(zip(phi.names, phi.sizes, phi.scales, strict=True))
        self._rewards = RewardSum(cfg.rewards, self.step_dt, self.device)
        feet = len(self.robot_cfg.foot_geoms)
        self._terminations = Terminations(cfg.terminations.terms)
        terms = [*self._rewards.functions, *self._terminations.functions]
        self._constraints = Constraints(cfg.constraints)
        self.constraints = self._constraints.names
        terms += self._constraints.functions
        self._memory = Memory(terms, self.num_envs, feet, self.device)
        generator = torch.Generator(device=self.device)
        generator.manual_seed(seed)
        columns = {"joint": self.num_actions, "velocity": 2, NOISE: self._observer.proprio.size}
        columns |= commands.COLUMNS | randomization.columns(self.num_actions)
        columns |= Sensors.columns(self.num_actions)
        if self._library:
            columns |= curriculum.COLUMNS | {"yaw": 1}
        own = self._randomizations
        columns |= columns_of(randomization.TERMS, own, self.num_actions)
        columns |= columns_of(commands.TERMS, self._commands, self.num_actions)
        self._random = UniformBuffer(self.num_envs, columns, generator)
        self._randomizer = Randomizer(
            cfg.randomization, self.scene, self.sim, self._random, own, self.step_dt
        )
        self._sensors = Sensors(cfg.randomization, self.sim, self.scene.sensors, self._random)
        self._curriculum = None
        if self._library:
            self._curriculum = Curriculum(self._library, len(self.skills), self._random)
        self._is_flat = self._curriculum.is_flat if self._curriculum else self._all
        self._tasks = TaskSampler(
            cfg.commands,
            cfg.skills,
            len(self.skills),
            self._random,
            is_rough=~self._is_flat,
            on_rough=cfg.terrain.task if cfg.terrain else None,
            terms=self._commands,
            step_dt=self.step_dt,
        )
        self._placed: torch.Tensor | None = None  # tiles chosen from outside, (N,)
        self._advance = Recorded(
            self._judge_and_begin,
            self.device,
            carried=self._carried,
            renewed=(self.robot, self._observer),
            variant=lambda: (self._held, self._placed is None),
            compiled=self.num_envs >= COMPILED,
        )

    def _carried(self) -> list[tuple[object, str]]:
        """Return the attributes that a step reads and replaces; see `Recorded`."""
        names = [*_BUFFERS, "_last_action", *(f"task.{name}" for name in self.task.tensors())]
        names += [f"task.terms.{name}" for name in vars(self.task.terms)]
        slots: list[tuple[object, str]] = [(self, name) for name in names]
        slots += [(self._memory, name) for name in self._memory.names]
        slots += [(self._sensors, "errors")]
        slots += [(self._tasks, "probabilities")]
        slots += [(self._observer, name) for name in ("clean", "features", "_frame", "_history")]
        if self._curriculum:
            slots += [(self._curriculum, name) for name in self._curriculum.state_dict()]
        if self._placed is not None:
            slots += [(self, "_placed")]
        return slots

    def _begin(self) -> None:
        step = self._last_step(~self._all)
        self._terminations(step)  # a term of a wrong shape is refused now
        self._violations(step, ~self._all)
        self._reward(step, ~self._all)
        self.reset()
        if self.cfg.terminations.random_first_length:
            # Otherwise all worlds time out together, and the data of a rollout is all alike.
            uniform = torch.rand(
                self.num_envs, generator=self._random.generator, device=self.device
            )
            self._length[:] = (uniform * self.max_episode_length).long()

    # --- one control step ---------------------------------------------------------------------

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advance every world by one control step; reset those that end.

        The order: act, simulate, judge (terminations, rewards, imitation features: all of the
        motion that just happened), then choose what comes next (tasks, resets, pushes), and
        observe. What is judged is never touched by a reset, and what is observed is never older
        than the reset: it follows from positions and velocities, which every write renews.

        Args:
            actions: Unscaled joint targets around q0, (N, J).

        Returns:
            observations: Groups of kiras_rl.interfaces, new tensors.
            rewards: Task reward, unclipped, (N,).
            dones: Episodes that ended, (N,) bool.
            extras: What kiras_rl.interfaces names EXTRA_*, NEXT_PROPRIO and `log`.
        """
        clip = self.cfg.action_clip
        self._last_action, self._action = self._action, actions.clamp(-clip, clip)
        begin = time.perf_counter()
        # A motor follows its encoder: what the encoder calls the target is off by its bias.
        targets = self._postures.joint_targets(self._action) - self._sensors.encoder_bias
        self.sim.step(targets)
        physics_time = time.perf_counter() - begin
        self._random.refill()
        obs, rewards, dones, extras = self._advance()
        return obs, rewards, dones, extras | {names.EXTRA_PHYSICS_TIME: physics_time}

    def _judge_and_begin(self) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Do all of a step that follows the physics."""
        self._length = self._length + 1
        self.robot.read_step()
        diverged = self.sim.diverged | broken(self.robot, self.keyframes, GRAVITY * self.mass)
        invalid = diverged | self.sim.overflowed
        step = self._last_step(diverged)
        reasons = self._terminations(step)
        step.fallen = fallen = reduce(or_, reasons, diverged)
        violations = self._violations(step, invalid)
        distance = self._distance()
        crossed = (distance > CROSSED) & (self._ground is not None)  # flat ground has no end
        # Memory that ran out is no fault of the policy's: the episode is cut.
        cut = self.sim.overflowed | crossed | (self._length >= self.max_episode_length)
        time_outs = cut & ~fallen
        terms = self._reward(step, invalid)
        observer, view = self._observer, self._view()
        extras = {
            names.EXTRA_TIME_OUTS: time_outs,
            names.EXTRA_IMITATION: _unless(invalid, observer.imitation(view), observer.features),
            names.EXTRA_VALID: ~invalid,
            names.EXTRA_FLAT: self._is_flat,
            names.NEXT_PROPRIO: _unless(invalid, observer.proprio(view), observer.clean),
            "log": self._log(terms, [fallen, time_outs, diverged, *reasons]),
            **violations,
        }
        self._measurements = measure(self.robot, self._limits, distance, fallen | invalid)

        done = fallen | time_outs
        if self._curriculum:
            self._curriculum.record(self.task, self.robot, self.step_dt)
            self._curriculum.keep_counting(extras[names.EXTRA_VALID])
            self._curriculum.update(done, fallen, crossed, self.task.skill)
        self._begin_next(done)
        return self._observe(done), self._rewards.total(terms), done, extras

    def _distance(self) -> torch.Tensor:
        """Return how far bases are from the middle of their tile, max(|x|, |y|), (N,), m."""
        return self.robot.base_pos_w[:, :2].abs().amax(dim=1)

    def _last_step(self, fallen: torch.Tensor) -> Step:
        """Return the step that was just made, as terms see it."""
        command = self.task.command
        return Step(
            stands=torch.linalg.vector_norm(command, dim=-1) < STANDING,
            robot=self.robot,
            task=self.task,
            keyframes=self.keyframes,
            limits=self._limits,
            target=self._postures.asked(self._action),
            action=self._action,
            last_action=self._last_action,
            last_joint_vel=self._last_joint_vel,
            last_joint_torque=self._last_joint_torque,
            memory=self._memory,
            fresh=self._length == 1,
            fallen=fallen,
            weight=GRAVITY * self.mass,
            dt=self.step_dt,
        )

    def _violations(self, step: Step, invalid: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return what a step adds to its extras where constraints are configured."""
        if not self.constraints:
            return {}
        return {names.EXTRA_CONSTRAINTS: self._constraints(step).masked_fill(invalid[:, None], 0.0)}

    def _reward(self, step: Step, invalid: torch.Tensor) -> torch.Tensor:
        """Return the weighted reward terms, (N, terms), and remember the step.

        A world whose physics broke has no meaningful terms; it earns nothing but the termination.
        """
        terms = self._rewards(step)
        self._memory.advance(step)
        return terms.masked_fill(invalid[:, None] & ~self._rewards.is_termination, 0.0)

    def _begin_next(self, done: torch.Tensor) -> None:
        """Choose the next tasks, reset the worlds that ended and push some of the others."""
        if self._held:
            self.task = self._tasks.go_on(self.task, done)
        else:
            task = self._tasks.advance(self.task, done)
            if self._curriculum:
                self._curriculum.keep_counting((task.skill == self.task.skill) | done)
            self.task = task
        self._last_joint_torque = self.robot.joint_torque.clone()
        self._reset_worlds(done, self.task.start)
        push, velocity = self._randomizer.pushes(self.step_dt)
        qvel = self.sim.qvel.clone()
        qvel[:, :2].add_(velocity)
        push, qvel = self._randomizer.kick(push, qvel)
        self.sim.write_velocity(push & ~done, qvel)
        self._read_begin()

    def _read_begin(self) -> None:
        """Read where the next step begins, and steer from there."""
        self.robot.read_kinematics()
        self._last_joint_vel = self.robot.joint_vel.clone()
        self.task = self._tasks.steer(self.task, self.robot.yaw)

    def _reset_worlds(self, mask: torch.Tensor, start: torch.Tensor) -> None:
        """Put the masked worlds into the keyframes `start`, (N,), with new physics and ground."""
        self._sensors.reset(mask, self._randomizer.reset(mask))
        if self._observer.tells_physics:
            self._physics = torch.where(mask[:, None], self._randomizer.physics, self._physics)
        if self._curriculum and self._ground:
            self._curriculum.begin(mask, self.task.skill)
            tile = self._curriculum.tiles() if self._placed is None else self._placed
            self._ground.write(mask, tile)
            self.sim.write_terrain(mask, tile)
        qpos, qvel = self._postures.draw_begin(start, self._random)
        joint_pos = qpos[:, 7:]
        self.sim.write_state(mask, qpos, qvel, joint_pos)
        # The targets that hold the start pose: what was "commanded" before the episode.
        holding = self._postures.holding(joint_pos + self._sensors.encoder_bias)
        self._action = torch.where(mask[:, None], holding, self._action)
        self._last_joint_torque = self._last_joint_torque.masked_fill(mask[:, None], 0.0)
        self._memory.forget(mask)
        self._length = self._length.masked_fill(mask, 0)

    # --- observations -------------------------------------------------------------------------

    def _view(self) -> View:
        q0 = self._postures.default_joint_pos
        task, action = self.task, self._action
        return View(self.robot, self.robot, task, self.keyframes, q0, action, self._physics)

    def _observe(self, begun: torch.Tensor) -> TensorDict:
        return self._observer.observe(self._view(), self._sensors, begun, self._random)

    def _log(self, terms: torch.Tensor, events: list[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return means of the weighted terms (N, terms) and counts of events, (N,) bool each."""
        means = terms.mean(dim=0).unbind()
        log = {
            f"Reward/{name}": mean for name, mean in zip(self._rewards.names, means, strict=True)
        }
        reasons = [f"{names.ENDED_BY}{name}" for name in self._terminations.names]
        happened = torch.stack([self.sim.overflowed, *events], dim=1)
        counts = happened.sum(dim=0, dtype=torch.float32).unbind()
        log |= zip([*_EVENTS, *reasons], counts, strict=True)
        return log | (self._curriculum.describe(self.skills) if self._curriculum else {})

    # --- the rest of SkillEnv -----------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        """Return the observation of the last step or reset."""
        return copied(self._observer.observation)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps since the last reset, (N,) int64; rsl-rl assigns to it."""
        return self._length

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self._length = value.to(self.device, torch.int64).clone()

    def seed(self, seed: int) -> None:
        """Restart the random numbers."""
        self._random.generator.manual_seed(seed)

    def reset(
        self,
        skill: torch.Tensor | None = None,
        command: torch.Tensor | None = None,
        hold_heading: bool = False,
    ) -> TensorDict:
        """Reset every world; a given skill starts at its own keyframe and stays."""
        self._random.refill()
        task = self._tasks.advance(self.task, self._all)
        self._held = self._held or skill is not None
        start = task.start if skill is None else skill
        skill = task.skill if skill is None else skill
        command = task.command if command is None else command
        heading = task.heading.clone().fill_(math.inf if hold_heading else math.nan)
        given = command is not task.command or hold_heading
        self.task = Task(
            command=command.clone(),
            skill=skill.clone(),
            start=start.clone(),
            heading=heading if given else task.heading,
            terms=task.terms,
        )
        self._reset_worlds(self._all, self.task.start)
        self._read_begin()
        return self._observe(self._all)

    def place(
        self, terrain: torch.Tensor, level: torch.Tensor, variant: torch.Tensor | None = None
    ) -> None:
        """Choose the ground of every world; variants are dealt in turn where none is given.

        Raises:
            ValueError: All ground is flat.
        """
        if self._library is None:
            raise ValueError("env.terrain=null: all ground is flat, there is none to choose")
        if variant is None:
            variant = torch.arange(self.num_envs, device=self.device) % self._library.variants
        self._placed = self._library.index(terrain, level, variant)

    def set_task(self, skill: torch.Tensor, command: torch.Tensor) -> TensorDict:
        """Give every world a new skill and command, which stay until the next call."""
        self._held = True
        start = torch.where(skill == self.task.skill, self.task.start, self.task.skill)
        self.task = Task.of(command, skill, start, self.task.terms)
        return copied(self._observer.change_task(self._view()))

    def set_skill_probabilities(self, probabilities: torch.Tensor) -> None:
        """Set the probabilities with which new skills are drawn, (S,)."""
        self._tasks.probabilities = probabilities.to(self.device)

    def set_progress(self, progress: float) -> None:
        """Set what changes over a phase to its value at this share of it, in [0, 1]."""
        self._rewards.set_progress(progress)
        share = piecewise_linear(self.cfg.randomized_share, progress)
        for tensor in (self._randomizer.share, self._observer.noise):
            tensor.fill_(share)  # in place: a graph reads it

    def measure(self) -> Measurements:
        """Return the measurements of the last step, before its resets.

        Raises:
            RuntimeError: No step was made yet.
        """
        if self._measurements is None:
            raise RuntimeError("nothing is measured before the first step")
        return replace(self._measurements, **copied(vars(self._measurements)))

    def foot_pos_b(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the centres of the feet in the base frame, (N, F, 3), m."""
        return self._kinematics.foot_pos_b(joint_pos)

    def foot_height_b(self, gravity_b: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the height of each foot's lowest point above the base, (N, F), m."""
        return self._kinematics.foot_height_b(gravity_b, joint_pos)

    def robot_identity(self) -> dict:
        """Return what a training depends on of the robot, as plain values."""
        return identity(self.robot_cfg)

    def robot_change(self, before: dict) -> str | None:
        """Return how the robot differs from an earlier `robot_identity`, None if it does not."""
        return change(before, self.robot_identity())

    def name_term(self, group: str, column: int) -> str:
        """Name the term that a column of a group of observations comes from."""
        return self._observer.name_term(group, column) or super().name_term(group, column)

    def keyframe_observations(self) -> torch.Tensor:
        """Return critic observations at rest in each keyframe for G commands, (S, G, C)."""
        largest = self.cfg.commands.lin_vel_x[1]
        view = self._postures.at_rest([largest * share for share in KEYFRAME_COMMANDS])
        return self._observer.privileged(view).unflatten(0, (len(self.skills), -1))

    def describe(self) -> dict:
        """Return the deployment contract of a policy trained here."""
        return describe_deployment(self.robot_cfg, self.cfg, self._observer.proprio, self.step_dt)

    def state_dict(self) -> dict:
        """Return all that the next steps depend on, for an exact resume."""
        state = {
            "task": self.task.tensors(),
            "commands": dict(vars(self.task.terms)),
            "held": self._held,
            "probabilities": self._tasks.probabilities,
            "generator": self._random.generator.get_state(),
            "observer": self._observer.state_dict(),
            "buffers": {name: getattr(self, name) for name in _BUFFERS},
            "memory": self._memory.state_dict(),
            "sensors": self._sensors.state_dict(),
            "curriculum": self._curriculum.state_dict() if self._curriculum else {},
            "tile": self._ground.tile if self._ground else None,
        }
        return copied(state) | {"sim": self.sim.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state of the same number of worlds."""
        self.sim.load_state_dict(state["sim"])
        task = {k: v.to(self.device) for k, v in state["task"].items()}
        terms = {k: v.to(self.device) for k, v in state.get("commands", {}).items()}
        self.task = Task(**task, terms=Asked(**terms))
        self._held = state["held"]
        self.set_skill_probabilities(state["probabilities"])
        self._random.generator.set_state(state["generator"].cpu())
        for name, buffer in state["buffers"].items():
            setattr(self, name, buffer.to(self.device))
        self._memory.load_state_dict(state["memory"])
        self._sensors.load_state_dict(state["sensors"])
        self._observer.load_state_dict(state["observer"])
        if self._curriculum and self._ground:
            self._curriculum.load_state_dict(state["curriculum"])
            self._ground.write(self._all, state["tile"].to(self.device))
        self.robot.read_kinematics()


_EVENTS = ("Sim/overflowed", names.FALLS, names.TIME_OUTS, "Sim/diverged")
_BUFFERS = ("_length", "_action", "_last_joint_vel", "_last_joint_torque", "_physics")


def _unless(mask: torch.Tensor, new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
    """Return `new` (N, k), with `old` in the masked worlds (N,)."""
    return torch.where(mask[:, None], old, new)
