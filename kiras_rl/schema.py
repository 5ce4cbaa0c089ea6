"""The types of a configuration.

They name and type every key and hold no default: a value stands in one place, cfg/base.yaml, with
its unit and source. null (None) removes a block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass
class SimConfig:
    """Physics."""

    backend: str
    threads: int
    timestep: float
    substeps: int
    solver_iterations: int
    max_contacts: int
    max_constraints: int
    max_ccd: int


@dataclass
class ObservationConfig:
    """Observation groups: term name -> {scale, noise}; null removes a term."""

    history_length: int
    noise: bool
    proprio: dict[str, Any]
    critic: dict[str, Any]
    imitation: dict[str, Any]


@dataclass
class RewardConfig:
    """Task reward: term name -> {weight, parameters of the term}; null removes a term.

    It is their sum, or with `sigma` r+ exp(r- / sigma) of the positive and of the negative ones.
    """

    scale_by_dt: bool
    penalty_scale: list[list[float]]
    terms: dict[str, Any]
    sigma: float | None


@dataclass
class CommandConfig:
    """Velocity commands in the heading frame, and others.

    `terms` holds the others: name -> {parameters of the term}; null removes one.
    """

    lin_vel_x: tuple[float, float]
    lin_vel_y: tuple[float, float]
    ang_vel_z: tuple[float, float]
    zero_probability: float
    resample_probability: float
    heading_gain: float
    terms: dict[str, Any]


@dataclass
class SkillConfig:
    """Which skill a world is asked for, and where its episodes start."""

    switch_probability: float
    start_at_target: float
    joint_noise: float
    velocity_noise: float


@dataclass
class TerminationConfig:
    """Ends of an episode; failures: name -> {parameters of the term}; null removes one."""

    episode_length: float
    random_first_length: bool
    terms: dict[str, Any]


@dataclass
class RandomizationConfig:
    """Domain randomization: ranges [low, high]; null leaves the nominal value.

    `terms` holds others: name -> {parameters of the term}; null removes one, or all.
    """

    friction: tuple[float, float] | None
    payload: tuple[float, float] | None
    com_shift: tuple[float, float] | None
    kp_factor: tuple[float, float] | None
    kd_factor: tuple[float, float] | None
    motor_factor: tuple[float, float] | None
    torque_factor: tuple[float, float] | None
    leg_mass_factor: tuple[float, float] | None
    joint_friction_factor: tuple[float, float] | None
    joint_damping_factor: tuple[float, float] | None
    encoder_bias: tuple[float, float] | None
    imu_tilt: tuple[float, float] | None
    gyro_bias: tuple[float, float] | None
    action_delay: tuple[int, int] | None
    observation_delay: tuple[int, int] | None
    push_velocity: tuple[float, float] | None
    push_interval: float
    terms: dict[str, Any] | None


@dataclass
class RoughTaskConfig:
    """What robots on rough ground are asked for, where it is not what those on flat ground are."""

    lin_vel_x: tuple[float, float]
    zero_probability: float
    resample_probability: float
    heading_probability: float
    switch_probability: float
    start_at_target: float


@dataclass
class TerrainConfig:
    """Tiles: type name -> {proportion, parameters of the type}; null removes a type.

    A list of two numbers holds the values of the lowest and of the top level.
    """

    levels: int
    variants: int
    scale: float
    seed: int
    cell: float
    noise: tuple[float, float]
    task: RoughTaskConfig
    types: dict[str, Any]


@dataclass
class EnvConfig:
    """The Markov decision process."""

    action_clip: float
    observations: ObservationConfig
    rewards: RewardConfig
    commands: CommandConfig
    skills: SkillConfig
    terminations: TerminationConfig
    constraints: dict[str, Any]
    randomized_share: list[list[float]]
    randomization: RandomizationConfig
    terrain: TerrainConfig | None


@dataclass
class DiscriminatorConfig:
    """LSGAN discriminator of pairs of Phi."""

    hidden_dims: list[int]
    learning_rate: float
    updates: int
    batch_size: int
    gradient_penalty: float
    noise: list[list[float]]


@dataclass
class PremiumConfig:
    """Premium trajectory selector."""

    rule: str
    window: int
    capacity: int
    max_age: int
    min_command: float
    min_progress: float
    max_distance: float
    per_iteration: int
    keyframe_share: float
    distance_weight: float


@dataclass
class ImitationConfig:
    """Self-imitation learning."""

    reward_weight: float
    whole_from: list[list[float]]
    discriminator: DiscriminatorConfig
    premium: PremiumConfig


@dataclass
class MultiCriticConfig:
    """Two critics and the schedule that mixes their advantages."""

    sigma: float
    omega2_floor: float
    std_floor: float


@dataclass
class EstimatorConfig:
    """Environment context estimator with AdaBoot."""

    latent_dim: int
    encoder_dims: list[int]
    decoder_dims: list[int]
    relative_step: float
    epochs: int
    kl_weight: float
    prior_weight: float
    adaboot: str
    adaboot_floor: float

    def __post_init__(self) -> None:
        """Take a bare `off` for the word: YAML reads it as false."""
        if self.adaboot == "False":
            self.adaboot = "off"


@dataclass
class SkillInitConfig:
    """Skill Initialization."""

    floor: float
    smoothing: float


@dataclass
class PPOConfig:
    """Proximal policy optimisation."""

    num_steps: int
    num_epochs: int
    num_mini_batches: int
    gamma: float
    lam: float
    clip_param: float
    value_loss_coef: float
    max_grad_norm: float
    learning_rate: float
    learning_rate_range: tuple[float, float]
    desired_kl: list[list[float]]
    action_std: list[list[float]]
    actor_dims: list[int]
    critic_dims: list[int]
    only_positive_rewards: bool


@dataclass
class LearnerConfig:
    """The learner; a null block removes that part of KiRAS, `parts` adds others."""

    class_name: str
    precision: str
    ppo: PPOConfig
    imitation: ImitationConfig | None
    multi_critic: MultiCriticConfig | None
    estimator: EstimatorConfig | None
    skill_init: SkillInitConfig | None
    parts: dict[str, Any]


@dataclass
class TerrainEvaluationConfig:
    """The evaluation on terrain."""

    robots: int
    level: int
    command: tuple[float, float]


@dataclass
class EvaluationConfig:
    """The deterministic evaluation beside the training."""

    interval: int
    worlds_per_skill: int
    duration: float
    command: float
    terrain: TerrainEvaluationConfig


@dataclass
class RetentionConfig:
    """What holds the policy near that of skill learning."""

    residual_weight: float
    flat_loss_weight: float


@dataclass
class FinetuningConfig:
    """Terrain finetuning, the second phase; sim, env and learner hold what changes there."""

    iterations: int
    retention: RetentionConfig
    sim: dict[str, Any]
    env: dict[str, Any]
    learner: dict[str, Any]


@dataclass
class Config:
    """Everything that defines a run."""

    robot: str
    seed: int
    device: str
    num_envs: int
    iterations: int
    checkpoint_minutes: float
    sim: SimConfig
    env: EnvConfig
    learner: LearnerConfig
    finetuning: FinetuningConfig | None
    evaluation: EvaluationConfig
