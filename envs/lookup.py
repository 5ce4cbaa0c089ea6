"""Finding a term of the MDP by what a YAML says of it.

A term is a function whose first argument is what it may look at. An entry of the YAML holds its
parameters. Its name is that of a function in the library, or any other with the key `function`,
which names one of the user's:

    terms:
      lin_vel_y: {weight: -0.5}
      spin: {function: "my_package.terms:spin", weight: -0.1}
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from kiras_rl.config import ConfigError

FUNCTION = "function"
"""Key of an entry that names a function of the user's."""


def find_term(
    module: Mapping[str, object],
    name: str,
    entry: Any,
    first: type,
    where: str,
    own: tuple[str, ...] = (),
    hint: str = "its parameters, as in %s: {}",
    kind: str = "parameter",
) -> partial[Any]:
    """Return the function of an entry, bound to the parameters that the entry has.

    Args:
        module: Globals of the library's module.
        name: Of the entry.
        entry: What the YAML says.
        first: Type of what a term looks at.
        where: Key of the YAML under which the entry stands, for messages.
        own: Keys that every entry takes; they are no parameters.
        hint: What an entry holds at least, for messages; %s is its name.
        kind: What messages call its keys.

    Raises:
        ConfigError: No such function, or a parameter that is unknown, missing or no number.
    """
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}.{name}: give {hint % name}")
    if FUNCTION in entry:
        function = import_function(entry[FUNCTION], f"{where}.{name}.{FUNCTION}")
    else:
        function = find_function(module, name, first, where)
    return _bind(function, entry, f"{where}.{name}", own, kind)


def find_terms(
    module: Mapping[str, object], entries: Mapping[str, Any], first: type, where: str
) -> dict[str, partial[Any]]:
    """Return the functions of all entries that are not null, by name; see `find_term`."""
    return {
        name: find_term(module, name, entry, first, where)
        for name, entry in entries.items()
        if entry is not None
    }


class TermSet:
    """The configured terms of a kind.

    Attributes:
        names: In the order of the YAML.
        functions: Theirs, without parameters.
    """

    def __init__(
        self, module: Mapping[str, object], entries: Mapping[str, Any], first: type, where: str
    ) -> None:
        """Look the terms up; see `find_term`.

        Raises:
            ConfigError: Unknown term or parameter, or a parameter that is no number.
        """
        self.terms, self._where = find_terms(module, entries, first, where), where
        self.names = tuple(self.terms)
        self.functions = [term.func for term in self.terms.values()]


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


def import_function(name: object, where: str) -> Callable:
    """Return a function that is named as in package.module:function.

    Args:
        name: What the YAML says.
        where: Its key, for the message.

    Raises:
        ConfigError: No such function.
    """
    given = f"{where}={name}: give a function as package.module:function"
    module, _, attribute = name.partition(":") if isinstance(name, str) else ("", "", "")
    if not module or not attribute:
        raise ConfigError(given)
    try:
        function = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{given} ({error})") from None
    if not inspect.isfunction(function):
        raise ConfigError(f"{given}; this is a {type(function).__name__}")
    return function


def _is_term(function: Callable, first: type) -> bool:
    parameters = list(inspect.signature(function).parameters.values())
    is_public = not function.__name__.startswith("_")
    return is_public and bool(parameters) and parameters[0].annotation in (first, first.__name__)


def _bind(
    function: Callable, entry: dict, where: str, own: tuple[str, ...], kind: str
) -> partial[Any]:
    """Return a function with the parameters of its entry."""
    signature = inspect.signature(function)
    parameters = {k: value for k, value in entry.items() if k not in (*own, FUNCTION)}
    allowed = list(signature.parameters)[1:]
    if unknown := [key for key in parameters if key not in allowed]:
        takes = ", ".join([*own, *allowed]) or "none"
        raise ConfigError(f"{where}: unknown {kind} '{unknown[0]}'; it takes {takes}")
    try:
        signature.bind(None, **parameters)
    except TypeError as error:
        raise ConfigError(f"{where}: {error}") from None
    for key, value in parameters.items():
        if signature.parameters[key].annotation in ("int", "float", int, float):
            _check_number(f"{where}.{key}", value)
    return partial(function, **parameters)


def _check_number(where: str, value: object) -> None:
    if not isinstance(value, int | float) or isinstance(value, bool):
        shown = "null" if value is None else repr(value)
        raise ConfigError(f"{where}={shown}: must be a number")
