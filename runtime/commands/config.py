"""Options of a command in a TOML file: a table for each command, its keys named as on the command line.

``--config FILE.toml`` reads it; what is typed wins. ``--write-config FILE.toml`` writes what a command was given.
"""

import argparse
import json
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import FileFault, read_whole, reading, write_atomically
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.requests.fields import Request, has_default

READ = "--config"
WRITE = "--write-config"

SIZE_LIMIT = 2**20
"""Bytes of such a file."""


def with_config(
    parser: argparse.ArgumentParser, words: Sequence[str], commands: Collection[str]
) -> list[str]:
    """Words of a command line with those of its ``--config`` in front, as far as they are not typed.

    OptionError for a file that cannot be read, and for keys and tables that nothing has.
    """
    typed = list(words)
    whole = {flag for each in parser._actions for flag in each.option_strings}
    reads = _action(parser, READ[2:])
    at = next((i for i, word in enumerate(typed) if reads and _is_typed(reads, [word], whole)), None)
    if at is None or ("=" not in typed[at] and at + 1 == len(typed)):
        return typed  # the parser says that there is no file
    path = typed[at].partition("=")[2] or typed[at + 1]
    command = parser.prog.removeprefix("spikeloom ")
    more: list[str] = []
    places: list[str] = []
    for key, value in _table(path, command, commands).items():
        action = _action(parser, key)
        if action is None or key in (READ[2:], WRITE[2:]):
            raise OptionError(f"{path}: {key}: no option of {command}; see {parser.prog} --help")
        if not action.option_strings:
            places += _texts(path, key, value)
        elif not _is_typed(action, typed, whole):
            more += _typed(path, key, value, action)
    return [*more, *typed] if places and _has_places(parser, [*more, *typed]) else [*places, *more, *typed]


def _has_places(parser: argparse.ArgumentParser, words: Sequence[str]) -> bool:
    """Whether a word that stands alone is among them."""
    try:
        known, _ = argparse.ArgumentParser.parse_known_args(parser, words)
    except OptionError:
        return False
    alone = [each for each in parser._actions if not each.option_strings]
    return any(getattr(known, each.dest, each.default) not in (each.default, None, []) for each in alone)


def _table(path: str, command: str, commands: Collection[str]) -> Mapping[str, Any]:
    """The table of a command, which may be missing."""
    with reading(path, OptionError, "give a TOML file with a table [COMMAND]"):
        tables = tomllib.loads(read_whole(Path(path), "file of options", SIZE_LIMIT).decode("utf-8-sig"))
        if stray := [name for name, table in tables.items() if not isinstance(table, dict)]:
            raise FileFault(f"{stray[0]} is in no table; write [{command}] above it")
        if unknown := [name for name in tables if name.split(" ")[0] not in commands]:
            raise FileFault(f"[{unknown[0]}] is the table of no command; write [{command}]")
    table: Mapping[str, Any] = tables.get(command, {})
    return table


def _action(parser: argparse.ArgumentParser, key: str) -> argparse.Action | None:
    """The option of that name, or the word without one."""
    flag = f"--{key}"
    return next(
        (
            each
            for each in parser._actions
            if flag in each.option_strings or (not each.option_strings and each.dest == key)
        ),
        None,
    )


def _is_typed(action: argparse.Action, typed: Sequence[str], whole: Collection[str]) -> bool:
    """Whether it is on the command line, shortened too."""
    names = [word.partition("=")[0] for word in typed if word.startswith("-")]
    return any(
        flag == name or (len(name) > 2 and name not in whole and flag.startswith(name))
        for flag in action.option_strings
        for name in names
    )


def _typed(path: str, key: str, value: Any, action: argparse.Action) -> list[str]:
    """An option as it is typed."""
    flag = f"--{key}"
    if action.nargs == 0 or isinstance(value, bool):
        if not isinstance(value, bool) or action.nargs not in (0, "?"):
            raise OptionError(
                f"{path}: {key} = {value!r}: allowed: {'true or false' if action.nargs == 0 else 'a value'}"
            )
        return [flag] if value else []
    texts = _texts(path, key, value)
    if isinstance(action, argparse._AppendAction):
        return [f"{flag}={text}" for text in texts]
    return [f"{flag}={','.join(texts)}"]


def _texts(path: str, key: str, value: Any) -> list[str]:
    values = value if isinstance(value, list) else [value]
    if not all(isinstance(each, str | int | float) for each in values):
        raise OptionError(f"{path}: {key}: allowed: text, a number, or a list of these; give one")
    return [str(each) for each in values]


def write_config(path: str, command: str, request: Request) -> None:
    """Write what a request has beside its defaults, as a table."""
    lines = [f"[{json.dumps(command) if ' ' in command else command}]"]
    for each in request.options():
        value = getattr(request, each.name)
        if has_default(each) and value == each.default:
            continue
        name = each.name if each.metadata["positional"] else each.name.replace("_", "-")
        for flag, (meaning, _) in (each.metadata["constants"] or {}).items():
            if value is meaning:
                name, value = flag[2:], True
        flags = [flag[2:] for flag in each.metadata["flags"] if flag.startswith("--")]
        lines.append(f"{(flags or [name])[0]} = {_toml(value)}")
    require_place(path, WRITE, request, ["toml"])
    with write_atomically(path) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _toml(value: Any) -> str:
    """A value as TOML has it."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
