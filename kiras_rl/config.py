"""Reading configurations: cfg/base.yaml, narrowed by `extends` and `key=value`."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from kiras_rl.deploy.errors import PlainError
from kiras_rl.files import replacing
from kiras_rl.limits import find_outside_fields
from kiras_rl.ranges import find_mistake
from kiras_rl.schema import Config, TerrainConfig
from kiras_rl.yaml_files import YamlError, read_yaml_file, read_yaml_text

T = TypeVar("T")

CFG_FOLDER = Path(__file__).resolve().parent / "cfg"
if not CFG_FOLDER.is_dir():  # an editable install: kiras_rl.cfg is the top-level folder cfg/
    CFG_FOLDER = Path(__file__).resolve().parents[1] / "cfg"
BASE = CFG_FOLDER / "base.yaml"
SWEEP_FOLDER = CFG_FOLDER / "sweeps"  # lists of runs, see kiras_rl.tools.training.sweep

MACHINE_KEYS = ("device", "sim.threads", "checkpoint_minutes")
"""Keys about the machine that trains: none of them makes a run another experiment."""

RESUME_OVERRIDES = ("iterations", "finetuning.iterations", *MACHINE_KEYS)
"""Keys that may change when a run is resumed: none of them changes what was learned so far."""

OBSOLETE = tuple(
    f"{phase}{key}"
    for phase in ("", "finetuning.")
    for key in (
        "learner.estimator.learning_rate",  # relative_step is in their place
        "learner.estimator.full_rate_std",
        "env.commands.least_lin_vel_x",  # env.terrain.task has what is asked on rough ground
        "env.commands.heading_probability",
        "env.terrain.start_level",  # levels rise as fast as the policy can follow
    )
)
"""Keys of what earlier versions saved."""

MOVED = {
    f"{phase}{old}": f"{phase}{new}"
    for phase in ("", "finetuning.")
    for old, new in (
        ("env.terminations.base_contact_force", "env.terminations.terms.base_contact.force"),
        ("env.terminations.max_tilt", "env.terminations.terms.tilted.angle"),
    )
}
"""Where the values of keys of earlier versions stand now."""


class ConfigError(PlainError, ValueError):
    """A configuration that cannot be used: says what was given and what is allowed."""


def load_config(name: str, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a configuration.

    Args:
        name: A file of cfg/ without its ending ("solo8", "ablations/no_sil") or a path.
        overrides: `key=value` strings, applied last.

    Raises:
        ConfigError: Unknown file, unknown key, wrong type or missing value.
    """
    begin, layers = _read_chain(name)
    return _resolve(layers, list(overrides), source=name, begin=begin)


def config_from_dict(values: dict, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Rebuild a configuration from `config_to_dict`, with overrides.

    Keys that are younger than what was saved get the values of base; those that have moved keep
    their values, and those that no longer exist are left out.

    Raises:
        ConfigError: As `load_config`.
    """
    source = "the saved configuration"
    saved = _merge(copy.deepcopy(_schema()), _moved(_without(values, OBSOLETE), MOVED), source)
    younger = OmegaConf.create()
    for key in (*OmegaConf.missing_keys(saved), *_missing_terrain(saved)):
        OmegaConf.update(younger, key, OmegaConf.select(_base(), key))
    return _resolve([younger], list(overrides), source, begin=saved)


def _missing_terrain(saved: DictConfig) -> list[str]:
    """Return the keys that the terrain of finetuning leaves out, which only its phase types."""
    where = "finetuning.env.terrain"
    if (terrain := OmegaConf.select(saved, where)) is None:
        return []
    typed = OmegaConf.structured(TerrainConfig)
    _check_keys(typed, terrain, "the saved configuration", f"{where}.")
    return [f"{where}.{key}" for key in OmegaConf.missing_keys(OmegaConf.merge(typed, terrain))]


def _without(values: dict, keys: Iterable[str]) -> dict:
    """Return nested values without some keys, which have dots."""
    values = copy.deepcopy(values)
    for *path, last in (key.split(".") for key in keys):
        block = values
        for name in path:
            block = block.get(name) or {}
        block.pop(last, None)
    return values


def _moved(values: dict, keys: Mapping[str, str]) -> DictConfig:
    """Return nested values with some keys, which have dots, moved to others."""
    before, after = OmegaConf.create(values), OmegaConf.create(_without(values, keys))
    for old, new in keys.items():
        if (value := OmegaConf.select(before, old)) is not None:
            OmegaConf.update(after, new, value)
    return after


def config_from_layers(layers: list[dict], source: str) -> Config:
    """Merge a whole configuration and changes to it; `source` names them in errors.

    Raises:
        ConfigError: As `load_config`.
    """
    return _resolve(layers, [], source)


def read_block(where: str, kind: type[T], values: dict) -> T:
    """Return a block whose keys the schema does not know, typed by a dataclass.

    Args:
        where: Its key in the configuration.
        kind: The dataclass; a field may be `limited`.
        values: What the configuration says.

    Raises:
        ConfigError: Unknown key, wrong type, missing value, or a number outside of its range.
    """
    begin, layer = OmegaConf.structured(kind), OmegaConf.create(values)
    _check_keys(begin, layer, where, f"{where}.")
    try:
        block = OmegaConf.unsafe_merge(begin, layer)
        missing = sorted(OmegaConf.missing_keys(block))
        result: Any = None if missing else OmegaConf.to_object(block)
    except OmegaConfBaseException as error:
        raise ConfigError(_explain(error, where)) from None
    if missing:
        raise ConfigError(f"{where} leaves out: {', '.join(missing)}")
    if mistake := find_outside_fields(result, where):
        raise ConfigError(mistake)
    return result


def config_to_dict(config: Config) -> dict:
    """Return a configuration as nested plain values, ready for YAML and checkpoints."""
    return _plain(asdict(config))


def save_config(config: Config, path: Path) -> None:
    """Write a configuration as YAML, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(OmegaConf.to_yaml(config_to_dict(config)), encoding="utf-8")


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
    files = (path for path in CFG_FOLDER.rglob("*.yaml") if path.parent != SWEEP_FOLDER)
    return sorted(path.relative_to(CFG_FOLDER).with_suffix("").as_posix() for path in files)


def _plain(value: Any) -> Any:
    """Return nested mappings and sequences as dicts and lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@cache
def _schema() -> DictConfig:
    """Return the typed configuration without values: to copy, never to change."""
    return OmegaConf.structured(Config)


@cache
def _base() -> DictConfig:
    """Return cfg/base.yaml, which is most of any configuration: to copy, never to change."""
    return _merge(copy.deepcopy(_schema()), read_keys(BASE), "base")


def _resolve(
    layers: Iterable[dict | DictConfig],
    overrides: list[str],
    source: str,
    begin: DictConfig | None = None,
) -> Config:
    """Put layers and overrides on top of `begin`, by default on nothing."""
    config = copy.deepcopy(_schema() if begin is None else begin)
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
    if mistake := find_mistake(config_to_dict(result)):
        raise ConfigError(mistake)
    return result


def _explain(error: OmegaConfBaseException, source: str) -> str:
    key = getattr(error, "full_key", None)
    return ": ".join([source, *([key] if key else []), str(error).splitlines()[0]])


def _parse_override(item: str) -> DictConfig:
    key, separator, text = item.partition("=")
    if not separator or not key:
        raise ConfigError(f"'{item}' is not an override; write key=value, as in num_envs=512")
    layer = OmegaConf.create()
    try:
        OmegaConf.update(layer, key, read_yaml_text(text))
        return layer
    except (OmegaConfBaseException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"override '{item}' is not readable: {reason}") from None


def _merge(config: DictConfig, layer: dict | DictConfig, source: str) -> DictConfig:
    """Return `config` with the values of `layer`; do not use what was given any more."""
    layer = OmegaConf.create(layer)
    _check_keys(config, layer, source)
    try:
        merged = OmegaConf.unsafe_merge(config, layer)
    except OmegaConfBaseException as error:
        raise ConfigError(_explain(error, source)) from None
    assert isinstance(merged, DictConfig)
    return merged


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
            if moved := MOVED.get(f"{prefix}{key}"):
                meant = f"; it is '{moved}' now."
            raise ConfigError(
                f"{source}: unknown key '{prefix}{key}'{meant} Allowed: {', '.join(allowed)}"
            )
        child, known = layer._get_node(key), config._get_node(key)
        if isinstance(child, DictConfig) and isinstance(known, DictConfig):
            _check_keys(known, child, source, f"{prefix}{key}.")


def _read_chain(name: str) -> tuple[DictConfig, list[dict]]:
    """Return what `extends` begins with, base or nothing, and the layers from there to `name`."""
    layers, seen = [], []
    current: str | None = name
    while current is not None:
        path = _find(current, relative_to=seen[-1].parent if seen else None)
        if path in seen:
            raise ConfigError(f"'extends' goes round in circles: {path} is extended twice")
        if path == BASE:
            return _base(), layers[::-1]
        seen.append(path)
        values = read_keys(path)
        current = values.pop("extends", None)
        if not isinstance(current, str | None):
            raise ConfigError(f"{path}: extends: give one name, not {current}")
        layers.append(values)
    return _schema(), layers[::-1]


def read_keys(path: Path) -> dict:
    """Return the mapping that a YAML file holds.

    Raises:
        ConfigError: It cannot be read, or holds something else.
    """
    try:
        values = read_yaml_file(path)
    except (OSError, YamlError) as error:
        raise ConfigError(f"{path} is not readable YAML: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no keys: a configuration is a YAML mapping")
    return values


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
