"""What a user may say: a field of a request has a type, a default, and one sentence of help.

From the fields of a request derive the options of its command, ``--help``, the line that repeats it, the
keywords and the documentation of its Python function, and what is sent to workers. This module imports
nothing heavy.
"""

from __future__ import annotations

import inspect
import os
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, TypeVar

from spikeloom.compiler.errors import OptionError

HEADING = "Parameters\n----------"

F = TypeVar("F", bound=Callable[..., Any])


def option(
    text: str = "",
    *,
    default: Any = None,
    required: bool = False,
    positional: bool = False,
    metavar: str | None = None,
    choices: Sequence[Any] | None = None,
    group: str = "options",
    flags: Sequence[str] = (),
    constants: Mapping[str, tuple[Any, str]] | None = None,
    bare: Any = None,
) -> Any:
    """A field of a request.

    text: help, one sentence; `metavar` stands for the value there.
    required, positional: it has no default; its word stands without a flag.
    choices: values that are allowed.
    group: heading in ``--help``.
    flags: of the command line, where they are not ``--name``.
    constants: flags without a value: what each means, and its help.
    bare: value where the flag stands alone.
    """
    about = {"text": text, "positional": positional, "metavar": metavar, "choices": choices, "group": group}
    about |= {"flags": tuple(flags), "constants": constants, "bare": bare}
    if required or positional:
        return field(metadata=about)
    return field(default=default, metadata=about)


@dataclass(frozen=True, kw_only=True)
class Request:
    """A question with all its options; the names are those of the command line, with underscores."""

    @classmethod
    def options(cls) -> tuple[Field[Any], ...]:
        """Its fields in the order of the help."""
        return tuple(each for each in fields(cls) if "text" in each.metadata)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Any:
        """A request from values by name; those that it has no field for are passed over."""
        values = {each.name: given[each.name] for each in fields(cls) if each.name in given}
        for each in fields(cls):
            if kind_of(each) == "tuple" and each.name in values:
                values[each.name] = tuple(values[each.name] or ())
        return cls(**values)


def kind_of(each: Field[Any]) -> str:
    """First word of a field's type: ``int``, ``float``, ``bool``, ``str`` or ``tuple``."""
    return str(each.type).split("[", maxsplit=1)[0].split(" |", maxsplit=1)[0]


def has_default(each: Field[Any]) -> bool:
    """Whether a field may be left out."""
    return each.default is not MISSING or each.default_factory is not MISSING


ALLOWED = {
    "int": "a whole number",
    "float": "a number",
    "bool": "True or False",
    "str": "text, a number, or several of these",
    "tuple": "text, or several",
}


def checked(kind: type[Request], given: Mapping[str, Any]) -> Any:
    """A request from the values of a Python call; OptionError naming keyword, value and what is allowed."""
    values = {}
    for each in kind.options():
        if each.name in given:
            values[each.name] = _value(each, given[each.name])
    return kind(**values)


def _value(each: Field[Any], value: Any) -> Any:
    """What a field holds for a value of Python."""
    if has_default(each) and (value is None or value is each.default):
        return value
    kind = kind_of(each)
    taken = _taken(kind, value)
    choices = each.metadata["choices"]
    objects = {"Network": "populations", "Recordings": "events"}  # that some fields take as they are
    if taken is None and not any(
        kind in str(each.type) and hasattr(value, has) for kind, has in objects.items()
    ):
        fault = f"{each.name} {reprlib.repr(value)}: {type(value).__name__} found"
        raise OptionError(f"{fault}, allowed: {ALLOWED.get(kind, kind)}; give one")
    if choices and not set(taken if kind == "tuple" else [taken]) <= set(choices):
        raise OptionError(
            f"{each.name} {value!r}: allowed: {', '.join(map(str, choices))}; give one of these"
        )
    return value if taken is None else taken  # networks and recordings stay what they are


def _taken(kind: str, value: Any) -> Any:
    """The value where it is of a kind; None where it is not."""
    if isinstance(value, bool) or kind == "bool":
        return value if isinstance(value, bool) and kind == "bool" else None
    if kind == "int":
        return value if isinstance(value, int) else None
    if kind == "float":
        return float(value) if isinstance(value, int | float) else None
    many = value if isinstance(value, list | tuple) else [value]
    if not many or not all(isinstance(part, str | int | float | os.PathLike) for part in many):
        return None
    return tuple(map(str, many)) if kind == "tuple" else ",".join(map(str, many))


def documented(kind: type[Request]) -> Callable[[F], F]:
    """Add what a request says of its fields to the parameters in the documentation of its Python function."""

    def decorate(function: F) -> F:
        text, raises, errors = inspect.cleandoc(function.__doc__ or "").partition("\n\nRaises\n---")
        options = {each.name: each for each in kind.options()}
        lines = [] if HEADING in text else ["", HEADING]
        for name, annotation in function.__annotations__.items():
            if name in options:
                lines += [
                    f"{name} : {annotation}",
                    f"    {options[name].metadata['text']}".replace("%%", "%"),
                ]
        function.__doc__ = "\n".join([text, *lines]) + raises + errors
        return function

    return decorate
