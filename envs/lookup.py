"""Finding a term of the MDP by the name that a YAML gives it."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping

from kiras_rl.config import ConfigError


def find_function(module: Mapping[str, object], name: str, first: type, where: str) -> Callable:
    """Return the public function `name` of a module whose first argument is of type `first`.

    Args:
        module: The module's globals.
        name: Name in the YAML.
        first: Type that marks a function as a term.
        where: Key of the YAML, for the message.

    Raises:
        ConfigError: No such term; lists those that exist.
    """
    terms = {key: f for key, f in module.items() if inspect.isfunction(f) and _is_term(f, first)}
    if name not in terms:
        hint = difflib.get_close_matches(name, terms, n=1)
        meant = f"did you mean '{hint[0]}'? " if hint else ""
        raise ConfigError(f"{where}: no term '{name}': {meant}known: {', '.join(sorted(terms))}")
    return terms[name]


def _is_term(function: Callable, first: type) -> bool:
    parameters = list(inspect.signature(function).parameters.values())
    is_public = not function.__name__.startswith("_")
    return is_public and bool(parameters) and parameters[0].annotation == first.__name__
