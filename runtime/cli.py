"""The command line: name the commands, import the one that is chosen, run it, print what it returns.

Exit codes: 0 fine, 1 a check failed, 2 an interrupt or a user's mistake (one line on stderr, a traceback
only with ``--debug``). Results go to stdout, progress to stderr, when it is a terminal or
``--progress json`` asks.
"""

import argparse
import difflib
import json
import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import CapacityError, OptionError, SpikeloomError, UnfinishedError
from spikeloom.compiler.files import WRITTEN
from spikeloom.models.progress import FORM, require_form

if TYPE_CHECKING:
    from spikeloom.runtime.report.sections import Outcome

GROUPS: dict[str, dict[str, str]] = {
    "main job": {
        "demo": "the main job on a shipped checkpoint and synthetic grasps; needs no files and no internet",
        "doctor": "whether this installation works: versions, cores, caches, kernels, shipped files",
        "compile": "compile a trained network to a netlist within the limits of the chip",
        "inspect": "show a netlist (layers, scales, cores, use of each limit) or a checkpoint",
        "run": "run a netlist in the integer arithmetic of the chip",
        "verify": "compare chip and float model, spike for spike",
        "estimate": "synaptic operations, energy and time of an inference",
        "report": "one self-contained page: verdict, accuracy, cores, taxels, spikes, energy, time, provenance",
    },
    "choose": {
        "smallest": "the cheapest of many networks that is about as accurate as the best, compiled and verified",
        "chart": "accuracy against energy, time and size for a grid of configurations, and which one to deploy",
        "lean": "which neurons, taxels and hops its recordings do not need, and a netlist without them",
        "anytime": "how early decisions could be taken, and what that saves",
    },
    "check": {
        "explain": "why chip and float model differ on one recording: roots, their causes, and what removes them",
        "stress": "where float network and chip break: a seeded battery of perturbations, with verdicts and reasons",
        "certify": "which decisions no small change of a recording alters: proven, not sampled",
    },
    "training": {
        "train": "train networks, and report the last, best and clean epoch",
        "finetune": "train a network further with the chip's integers, down to ternary weights",
        "join": "put several trained networks side by side in one, whose votes add up",
    },
    "exchange": {
        "export": "write a network in the format of another program",
        "data": "fetch recordings, describe them, convert events to the released layout",
        "watch": "read event lines (time_s,taxel,polarity) and print the running decision",
    },
}
"""Commands by what a person wants; each is the module of its name in ``runtime/commands/<group>/``."""

COMMANDS = {name: (group, summary) for group, names in GROUPS.items() for name, summary in names.items()}

SHELLS = ("bash", "zsh", "tcsh")
"""That completion scripts are written for."""

Arguments = argparse.Namespace


class Parser(argparse.ArgumentParser):
    """Reports a wrong command line in one line, as any other mistake is, and names the option that was meant."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise OptionError(f"{message}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Add what ``--config`` says; refuse an unknown option first, so that the near one can be named."""
        if self._subparsers is None:
            if any(word.startswith("--c") for word in args):  # it may be shortened
                from spikeloom.runtime.commands.config import with_config

                args = with_config(self, args, COMMANDS)
            known = list(self._option_string_actions)
            places = {action.dest: action.metavar for action in self._actions if not action.option_strings}
            for word in args:
                if word.startswith("--") and word not in known and (place := places.get(word[2:])):
                    raise OptionError(f"{word}: {place} stands alone, without it; see {self.prog} --help")
                if word.startswith("--") and not any(
                    name.startswith(word.partition("=")[0]) for name in known
                ):
                    raise OptionError(f"{word}: unknown option{near(word, known)}; see {self.prog} --help")
        return super().parse_known_args(args, namespace)


def near(word: str, known: Iterable[str]) -> str:
    """What was probably meant, as part of a sentence.

    >>> near("verfy", COMMANDS), near("x", COMMANDS)
    (', did you mean verify?', '')
    """
    close = difflib.get_close_matches(word.partition("=")[0], known, 1)
    return f", did you mean {close[0]}?" if close else ""


def _module(command: str) -> Any:
    group, _ = COMMANDS[command]
    return import_module(f"spikeloom.runtime.commands.{group.replace(' ', '_')}.{command}")


def _overview() -> str:
    lines = []
    for group, names in GROUPS.items():
        lines += ["", f"{group}:", *(f"  {name:<11} {summary}" for name, summary in names.items())]
    return "\n".join(lines).lstrip("\n")


def build_parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """Describe the command line, with the options of one command, of none (""), or of all (None)."""
    parser = Parser(
        prog="spikeloom",
        usage="%(prog)s [-h] [-V] [--print-completion {bash,zsh,tcsh}] COMMAND …",
        description="Lower a trained spiking graph network for touch to a netlist for a neuromorphic chip, run it bit "
        "for bit, compare it with the float model and price it.",
        epilog=_overview() + "\n\nspikeloom COMMAND --help shows the options of a command",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-V", "--version", action="version", version=f"spikeloom {__version__}")
    parser.add_argument("--print-completion", choices=SHELLS, help="print a completion script")
    hidden = argparse.SUPPRESS if chosen == "" else None  # the overview names them, by group
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", help=hidden, prog="spikeloom"
    )
    for name in COMMANDS if chosen is None else filter(None, [chosen]):
        sub = commands.add_parser(name, description=COMMANDS[name][1], help=COMMANDS[name][1])
        _describe(sub, _module(name))
    return parser


def _describe(parser: argparse.ArgumentParser, module: Any) -> None:
    """Add the options of a command; one without a request has commands of its own."""
    from spikeloom.runtime.commands.options import add_common, add_options

    if not hasattr(module, "REQUEST"):
        module.add_arguments(parser)
        return
    parser.set_defaults(action=module.run, request=module.REQUEST)
    add_options(parser, module.REQUEST, getattr(module, "OPTIONS", None))
    add_common(parser)
    parser.epilog = getattr(module, "NOTES", None)


def _parse(words: Sequence[str]) -> Arguments | None:
    """Options of a command; None where help was wanted of none and is printed."""
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    first = next((word for word in words if not word.startswith("-")), None)
    if "--print-completion" in words:
        import shtab

        if words[-1] not in SHELLS:
            raise OptionError(f"--print-completion: give one of {', '.join(SHELLS)}")
        sys.stdout.write(shtab.complete(build_parser(), shell=words[-1]) + "\n")
        return None
    if first is None:
        if words and not {"-h", "--help", "-V", "--version"} & set(words):
            raise OptionError(f"{words[0]}: stands before a command; see spikeloom --help")
        build_parser("").parse_args(words or ["--help"])
    elif first not in COMMANDS:
        raise OptionError(f"{first}: no command{near(first, COMMANDS)}; see spikeloom --help")
    return build_parser(first).parse_args(words)


def _written() -> str:
    """Which files are left of a command that did not end."""
    return ", ".join(path for path in WRITTEN if Path(path).exists())


def _mistake(error: Exception) -> list[str]:
    """Lines for a user: one, or one per violated limit."""
    if isinstance(error, CapacityError):
        return [*map(str, error.violations), *getattr(error, "__notes__", ())]
    if isinstance(error, OSError) and error.strerror:
        where = error.filename or "a file"
        left = f"; written before: {_written()}" if _written() else ""
        return [f"{where}: {error.strerror}; check space and permissions{left}"]
    if isinstance(error, MemoryError):
        return [f"out of memory ({error or 'no size known'}); give fewer recordings with --limit"]
    return [" ".join([str(error), *(f"({note})" for note in getattr(error, "__notes__", ()))])]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    from spikeloom.runtime.report.console import progress, show, tell
    from spikeloom.runtime.report.sections import terminal

    words = sys.argv[1:] if argv is None else argv
    WRITTEN.clear()
    try:
        arguments = _parse(words)
        if arguments is None:
            return 0
        from spikeloom.runtime.report.encode import encode  # with numpy, which help need not wait for

        request = arguments.request.of(vars(arguments))
        if arguments.write_config is not None:
            from spikeloom.runtime.commands.config import write_config

            write_config(arguments.write_config, arguments.config_table, request)
        if arguments.progress is not None:
            os.environ[FORM] = arguments.progress
        require_form()
        outcome: Outcome = arguments.action(request)
        text = (
            json.dumps(encode(outcome.result))
            if arguments.json
            else terminal(outcome.sections(outcome.result))
        )
        progress("")
        show(text)
        return outcome.code
    except (SpikeloomError, OSError, MemoryError) as error:
        progress("")
        if "--debug" in words:
            raise
        for line in _mistake(error):
            tell(line)
        if isinstance(error, UnfinishedError):
            sys.stderr.write(f"spikeloom: go on with: {shlex.join(['spikeloom', *words])}\n")
            return 1
        return 2
    except KeyboardInterrupt as interrupt:
        progress("")
        tell(f"interrupted; {str(interrupt) or (_written() or 'nothing') + ' was written'}")
        return 2
