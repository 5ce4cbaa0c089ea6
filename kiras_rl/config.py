"""Configurations: typed here, valued in cfg/base.yaml, narrowed by `extends` and `key=value`.

The dataclasses below name and type every key and hold no default: a value stands in one place,
cfg/base.yaml, with its unit and source.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

CFG_FOLDER = Path(__file__).resolve().parent / "cfg"
if not CFG_FOLDER.is_dir():  # an editable install: kiras_rl.cfg is the top-level folder cfg/
    CFG_FOLDER = Path(__file__).resolve().parents[1] / "cfg"

RESUME_OVERRIDES = ("iterations", "device", "sim.threads", "checkpoint_minutes")
"""Keys that may change when a run is resumed: none of them changes what was learned so far."""


class ConfigError(ValueError):
    """A configuration that cannot be used: says what was given and what is allowed."""


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
    """Task reward: term name -> {weight, parameters of the term}; null removes a term."""

    scale_by_dt: bool
    terms: dict[str, Any]


@dataclass
class CommandConfig:
    """Velocity commands in the heading frame."""

    lin_vel_x: tuple[float, float]
    lin_vel_y: tuple[float, float]
    ang_vel_z: tuple[float, float]
    zero_probability: float
    resample_probability: float


@dataclass
class SkillConfig:
    """Which skill a world is asked for, and where its episodes start."""

    switch_probability: float
    start_at_target: float
    joint_noise: float
    velocity_noise: float


@dataclass
class TerminationConfig:
    """Ends of an episode."""

    episode_length: float
    random_first_length: bool
    base_contact_force: float
    max_tilt: float


@dataclass
class RandomizationConfig:
    """Domain randomization; null leaves the nominal value."""

    friction: tuple[float, float] | None
    payload: tuple[float, float] | None
    com_shift: tuple[float, float] | None
    kp_factor: tuple[float, float] | None
    kd_factor: tuple[float, float] | None
    action_delay: tuple[int, int] | None
    push_velocity: tuple[float, float] | None
    push_interval: float


@dataclass
class EnvConfig:
    """The Markov decision process."""

    action_clip: float
    observations: ObservationConfig
    rewards: RewardConfig
    commands: CommandConfig
    skills: SkillConfig
    terminations: TerminationConfig
    randomization: RandomizationConfig


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
    max_distance: float
    per_iteration: int
    keyframe_share: float
    distance_weight: float


@dataclass
class ImitationConfig:
    """Self-imitation learning."""

    reward_weight: float
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
    learning_rate: float
    epochs: int
    kl_weight: float
    prior_weight: float
    adaboot: str
    adaboot_floor: float


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
    """The learner; a null block removes that part of KiRAS."""

    ppo: PPOConfig
    imitation: ImitationConfig | None
    multi_critic: MultiCriticConfig | None
    estimator: EstimatorConfig | None
    skill_init: SkillInitConfig | None


@dataclass
class EvaluationConfig:
    """The deterministic evaluation beside the training."""

    interval: int
    worlds_per_skill: int
    duration: float
    command: float


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
    evaluation: EvaluationConfig


def load_config(name: str, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a configuration.

    Args:
        name: A file of cfg/ without its ending ("solo8", "ablations/no_sil") or a path.
        overrides: `key=value` strings, applied last.

    Raises:
        ConfigError: Unknown file, unknown key, wrong type or missing value.
    """
    return _resolve(_read_chain(name), list(overrides), source=name)


def config_from_dict(values: dict, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Rebuild a configuration from `config_to_dict`, with overrides.

    Raises:
        ConfigError: As `load_config`.
    """
    return _resolve([values], list(overrides), source="the saved configuration")


def config_to_dict(config: Config) -> dict:
    """Return a configuration as nested plain values, ready for YAML and checkpoints."""
    return OmegaConf.to_container(OmegaConf.structured(config), resolve=True)


def save_config(config: Config, path: Path) -> None:
    """Write a configuration as YAML."""
    path.write_text(OmegaConf.to_yaml(config_to_dict(config)), encoding="utf-8")


def check_resume_overrides(overrides: list[str]) -> None:
    """Refuse overrides that would make a resumed run another run.

    Raises:
        ConfigError: A key outside RESUME_OVERRIDES.
    """
    for item in overrides:
        key = item.split("=", 1)[0]
        if key not in RESUME_OVERRIDES:
            raise ConfigError(
                f"'{key}' cannot change when a run is resumed; allowed: "
                f"{', '.join(RESUME_OVERRIDES)}. Start a new run for anything else"
            )


def list_configs() -> list[str]:
    """Return the names of the shipped configurations."""
    names = (p.relative_to(CFG_FOLDER).with_suffix("") for p in CFG_FOLDER.rglob("*.yaml"))
    return sorted(n.as_posix() for n in names)


def _resolve(layers: list[dict], overrides: list[str], source: str) -> Config:
    config = OmegaConf.structured(Config)
    for layer in layers:
        config = _merge(config, layer, source)
    for item in overrides:
        config = _merge(config, _parse_override(item), f"override '{item}'")
    try:
        missing = sorted(OmegaConf.missing_keys(config))
        result = None if missing else OmegaConf.to_object(config)
    except OmegaConfBaseException as error:  # a reference ${...} that leads nowhere
        raise ConfigError(_explain(error, source)) from None
    if missing:
        raise ConfigError(f"{source} leaves out: {', '.join(missing)}; extend base or set them")
    assert isinstance(result, Config)
    for key in ("num_envs", "iterations"):
        if getattr(result, key) < 1:
            raise ConfigError(f"{key}={getattr(result, key)}: at least 1")
    return result


def _explain(error: OmegaConfBaseException, source: str) -> str:
    key = getattr(error, "full_key", None)
    return ": ".join([source, *([key] if key else []), str(error).splitlines()[0]])


def _parse_override(item: str) -> DictConfig:
    key, separator, _ = item.partition("=")
    if not separator or not key:
        raise ConfigError(f"'{item}' is not an override; write key=value, as in num_envs=512")
    try:
        return OmegaConf.from_dotlist([item])
    except Exception as error:  # the YAML parser's own errors are of many kinds
        reason = " ".join(str(error).split())
        raise ConfigError(f"override '{item}' is not readable: {reason}") from None


def _merge(config: DictConfig, layer: dict | DictConfig, source: str) -> DictConfig:
    _check_keys(config, OmegaConf.create(layer), source)
    try:
        return OmegaConf.merge(config, layer)
    except OmegaConfBaseException as error:
        raise ConfigError(_explain(error, source)) from None


def _check_keys(config: DictConfig, layer: DictConfig, source: str, prefix: str = "") -> None:
    """Raise at the first key of `layer` that the typed configuration does not have."""
    kind = OmegaConf.get_type(config)
    if kind in (None, dict, type(None)):
        return  # terms are checked where they are looked up, a block that was null by the merge
    allowed = list(kind.__dataclass_fields__)
    for key in layer:
        if key not in allowed:
            hint = difflib.get_close_matches(str(key), allowed, n=1)
            meant = f"; did you mean '{prefix}{hint[0]}'?" if hint else "."
            raise ConfigError(
                f"{source}: unknown key '{prefix}{key}'{meant} Allowed: {', '.join(allowed)}"
            )
        child, known = layer._get_node(key), config._get_node(key)
        if isinstance(child, DictConfig) and isinstance(known, DictConfig):
            _check_keys(known, child, source, f"{prefix}{key}.")


def _read_chain(name: str) -> list[dict]:
    """Return the layers from the root of `extends` down to `name`."""
    layers, seen = [], []
    current: str | None = name
    while current is not None:
        path = _find(current, relative_to=seen[-1].parent if seen else None)
        if path in seen:
            raise ConfigError(f"'extends' goes round in circles: {path} is extended twice")
        seen.append(path)
        try:
            values = OmegaConf.to_container(OmegaConf.load(path))
        except Exception as error:
            reason = " ".join(str(error).split())
            raise ConfigError(f"{path} is not readable YAML: {reason}") from None
        if not isinstance(values, dict):
            raise ConfigError(f"{path} holds no keys: a configuration is a YAML mapping")
        current = values.pop("extends", None)
        if not isinstance(current, str | None):
            raise ConfigError(f"{path}: extends: give one name, not {current}")
        layers.append(values)
    return layers[::-1]


def _find(name: str, relative_to: Path | None) -> Path:
    candidates = [CFG_FOLDER / f"{name}.yaml", Path(name)]
    if relative_to is not None:
        candidates.append(relative_to / f"{name}.yaml")
    for path in candidates:
        if path.is_file():
            return path.resolve()
    known = list_configs()
    hint = difflib.get_close_matches(name, known, n=1)
    meant = f"did you mean '{hint[0]}'? " if hint else ""
    raise ConfigError(
        f"no configuration '{name}': {meant}shipped ones are {', '.join(known)}, "
        "or give the path of a YAML file"
    )
