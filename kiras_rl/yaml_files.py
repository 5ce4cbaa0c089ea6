"""The one reader of YAML: configurations, sweeps, robots and keyframes mean the same by the same.

Names are text and stand once. `true`, `false` and `null` are themselves, but `on`, `off`, `yes` and
`no` are words; 6e0 is a number, 12:30 and 2026-01-31 are text.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

_LARGEST = 10**300  # of a whole number: a float holds it, too
_DEEPEST = 50
_MERGE = "tag:yaml.org,2002:merge"


class YamlError(ValueError):
    """Text that is no usable YAML: says why, and in which line."""


class _Loader(yaml.SafeLoader):
    """Knows YAML's plain kinds of scalars by the rules of its version 1.2."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012  (as the base class has it)


for _kind, _pattern, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?(?:0|[1-9][0-9_]*)|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)"
        r"|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", r"<<", "<"),
):
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_kind}", re.compile(f"(?:{_pattern})$"), list(_first)
    )


def read_yaml_file(path: Path) -> Any:
    """Return the plain values of a YAML file; None of an empty one.

    Raises:
        OSError: The file cannot be read.
        YamlError: Its text is no usable YAML.
    """
    data = path.read_bytes()
    try:
        return read_yaml_text(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise YamlError(f"line {line} is not UTF-8: save the file in that encoding") from None


def read_yaml_text(text: str) -> Any:
    """Return the plain values of a YAML text: dicts, lists, text, numbers, truth values, None.

    Raises:
        YamlError: No usable YAML, or a key that stands twice.
    """
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return None if node is None else _plain(loader, node, 0)
    except yaml.YAMLError as error:
        raise YamlError(" ".join(str(error).split())) from None
    except RecursionError:
        raise YamlError("it is nested too deeply") from None
    except (ValueError, OverflowError) as error:  # a number that Python cannot have
        if isinstance(error, YamlError):
            raise
        raise YamlError(" ".join(str(error).split())) from None


def _plain(loader: _Loader, node: Node, depth: int) -> Any:
    if depth > _DEEPEST:  # or an alias of what it lies in
        raise YamlError(f"{_line(node)} is nested too deeply")
    if isinstance(node, MappingNode):
        return _mapping(loader, node, depth)
    if isinstance(node, SequenceNode):
        return [_plain(loader, item, depth + 1) for item in node.value]
    value = loader.construct_object(node)
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise YamlError(f"{_line(node)}: {node.value[:20]}... is too large for a whole number")
    return value


def _mapping(loader: _Loader, node: MappingNode, depth: int) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    own: dict[str, Any] = {}
    for key, value in node.value:
        if key.tag == _MERGE:
            merged = _merge(loader, value, depth) | merged
            continue
        if not isinstance(key, ScalarNode):
            raise YamlError(f"{_line(key)}: a key must be a name")
        if key.value in own:
            raise YamlError(f"{_line(key)}: '{key.value}' stands twice: remove one of them")
        own[key.value] = _plain(loader, value, depth + 1)
    return merged | own


def _merge(loader: _Loader, node: Node, depth: int) -> dict[str, Any]:
    values = _plain(loader, node, depth + 1)
    parts = values if isinstance(values, list) else [values]
    if not all(isinstance(part, dict) for part in parts):
        raise YamlError(f"{_line(node)}: only mappings can be merged with <<")
    return {key: value for part in reversed(parts) for key, value in part.items()}


def _line(node: Node) -> str:
    return f"line {node.start_mark.line + 1}"
