"""Options of a command, derived from its request."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import Field
from typing import Any, TypeVar

from spikeloom.models.progress import FORM, LINES
from spikeloom.runtime.requests.fields import Request, has_default, kind_of

R = TypeVar("R", bound=Request)

KINDS = {"int": int, "float": float}


GROUPS = (
    "options",
    "network",
    "storage",
    "layout",
    "recordings",
    "depth and prices",
    "counters",
    "hardware",
    "output",
)
"""Headings in the order of the help."""

SUBJECTS = ("checkpoint", "data")
"""What a question is about, which stands first under its heading."""


def add_options(
    parser: argparse.ArgumentParser,
    kind: type[Request],
    choices: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    """Add the options of a request; `choices`, with what each means, are of fields that know them only now."""
    options = sorted(kind.options(), key=lambda each: each.name not in SUBJECTS)
    for each in sorted(options, key=lambda each: GROUPS.index(each.metadata["group"])):
        _add_option(parser, each, (choices or {}).get(each.name))


def _add_option(
    parser: argparse.ArgumentParser, each: Field[Any], meanings: Mapping[str, str] | None
) -> None:
    about = each.metadata
    options = group(parser, about["group"])
    if about["constants"]:
        axis = options.add_mutually_exclusive_group()
        for flag, (value, text) in about["constants"].items():
            axis.add_argument(flag, dest=each.name, action="store_const", const=value, help=text)
        return
    kind = kind_of(each)
    choices = about["choices"] if meanings is None else tuple(meanings)
    said: dict[str, Any] = {"help": _help(each)}
    if meanings is not None:
        said["help"] = "; ".join(f"{name}: {meaning}" for name, meaning in meanings.items())
    if not about["positional"]:
        said |= {"dest": each.name, "default": each.default if has_default(each) else None}
        said |= {} if has_default(each) else {"required": True}
    if kind == "bool":
        said["action"] = "store_true"
    else:
        said |= {"metavar": about["metavar"], "choices": choices, "type": KINDS.get(kind, str)}
    if about["bare"] is not None:
        said |= {"nargs": "?", "const": about["bare"]}
    if kind == "tuple":
        said |= {"nargs": "+"} if about["positional"] else {"action": "append", "default": None}
    flags = about["flags"] or (f"--{each.name.replace('_', '-')}",)
    options.add_argument(*([each.name] if about["positional"] else flags), **said)


def _help(each: Field[Any]) -> str:
    """What a field says of itself, and its default where that is a value."""
    text = str(each.metadata["text"])
    if has_default(each) and not any(each.default is nothing for nothing in (None, False, ())):
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
    parser.set_defaults(config_table=parser.prog.removeprefix("spikeloom "))  # of a file of options
    common = group(parser, "output")
    common.add_argument("--json", action="store_true", help="print the result as JSON")
    common.add_argument(
        "--config", metavar="FILE.toml", help="options from the file's table of this command"
    )
    common.add_argument("--write-config", metavar="FILE.toml", help="write these options as such a file")
    common.add_argument(
        "--progress",
        choices=(LINES,),
        help=f"how far it is as lines of JSON on standard error (everywhere: {FORM}={LINES})",
    )
    common.add_argument("--debug", action="store_true", help="show a traceback on errors")
