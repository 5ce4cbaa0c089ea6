"""Classes that a configuration names."""

from __future__ import annotations

from typing import TypeVar

from rsl_rl.utils import resolve_callable

from kiras_rl.config import ConfigError

T = TypeVar("T")


def find_class(where: str, name: object, base: type[T]) -> type[T]:
    """Return the class that is named as in package.module:Class.

    Args:
        where: The key of the configuration that names it.
        name: What it says.
        base: What the class has to be a kind of.

    Raises:
        ConfigError: No such class, or one of another kind.
    """
    given = f"{where}={name}"
    try:
        found = resolve_callable(name if isinstance(name, str) else "")
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{given}: give a class as package.module:Class ({error})") from None
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(f"{given}: it has to be a {base.__module__}:{base.__name__}")
    return found
