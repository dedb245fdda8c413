"""Options of a command, derived from its request."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import Field
from typing import Any, TypeVar

from spikeloom.runtime.requests.fields import Request, has_default, kind_of

R = TypeVar("R", bound=Request)

KINDS = {"int": int, "float": float}


def add_options(
    parser: argparse.ArgumentParser, kind: type[Request], choices: Mapping[str, Sequence[str]] | None = None
) -> None:
    """Add the options of a request; `choices` are those of fields that know them only now."""
    for each in kind.options():
        _add_option(parser, each, (choices or {}).get(each.name))


def _add_option(parser: argparse.ArgumentParser, each: Field[Any], choices: Sequence[str] | None) -> None:
    about = each.metadata
    options = group(parser, about["group"])
    if about["constants"]:
        axis = options.add_mutually_exclusive_group()
        for flag, (value, text) in about["constants"].items():
            axis.add_argument(flag, dest=each.name, action="store_const", const=value, help=text)
        return
    kind = kind_of(each)
    said: dict[str, Any] = {"help": _help(each)}
    if not about["positional"]:
        said |= {"dest": each.name, "default": each.default if has_default(each) else None}
        said |= {} if has_default(each) else {"required": True}
    if kind == "bool":
        said["action"] = "store_true"
    else:
        said |= {"metavar": about["metavar"], "choices": choices or about["choices"], "type": KINDS.get(kind, str)}
    if about["bare"] is not None:
        said |= {"nargs": "?", "const": about["bare"]}
    if kind == "tuple":
        said |= {"nargs": "+"} if about["positional"] else {"action": "append", "default": None}
    flags = about["flags"] or (f"--{each.name.replace('_', '-')}",)
    options.add_argument(*([each.name] if about["positional"] else flags), **said)


def _help(each: Field[Any]) -> str:
    """What a field says of itself, and its default where that is a value."""
    text = str(each.metadata["text"])
    if has_default(each) and each.default not in (None, False, ()):
        text += f" (default: {str(each.default).replace('%', '%%')})"
    return text


def request_of(kind: type[R], words: Sequence[str]) -> R:
    """What a request's command line says."""
    parser = argparse.ArgumentParser()
    add_options(parser, kind)
    made: R = kind.of(vars(parser.parse_args(list(words))))
    return made


def group(parser: argparse.ArgumentParser, title: str) -> Any:
    """Options under one heading."""
    if title == "options":
        return parser
    known = (each for each in parser._action_groups if each.title == title)
    return next(known, None) or parser.add_argument_group(title)


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command."""
    common = group(parser, "output")
    common.add_argument("--json", action="store_true", help="print the result as JSON")
    common.add_argument("--debug", action="store_true", help="show a traceback on errors")
