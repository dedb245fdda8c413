"""The command ``demo``: the main job on what the package ships."""

import io
import multiprocessing
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.runtime.commands.main_job import compile, estimate, verify
from spikeloom.runtime.commands.main_job.doctor import usable_cores
from spikeloom.runtime.commands.options import request_of
from spikeloom.runtime.equivalence.verdict import in_a_sentence
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.report.sections import Code, Outcome, Section, Text
from spikeloom.runtime.requests.fields import Request
from spikeloom.runtime.requests.main_job import CompileRequest, EstimateRequest, VerifyRequest

COMMANDS: dict[str, tuple[type[Request], Callable[[Any], Outcome]]] = {
    "compile": (CompileRequest, compile.run),
    "verify": (VerifyRequest, verify.run),
    "estimate": (EstimateRequest, estimate.run),
}

STEPS = (
    ("compile", "pretrained:grasps", "--calibrate", SYNTHETIC, "-o", "{folder}/grasps.loom"),
    ("verify", "{folder}/grasps.loom", "--checkpoint", "pretrained:grasps", "--data", SYNTHETIC),
    ("estimate", "{folder}/grasps.loom", "--data", SYNTHETIC),
)
"""Commands that run in a new folder for temporary files, where the netlist stays."""

IN_SMALL = (
    ("compile", "pretrained:grasps", "-o", "{folder}/grasps.loom"),
    ("estimate", "{folder}/grasps.loom", "--data", SYNTHETIC, "--limit", "1"),
)
"""Commands whose machine code the first of ``STEPS`` does not need: no two processes compile the same."""


REQUEST = Request


def run(_request: Request) -> Outcome:
    """Run the commands one after the other; the worst exit code counts."""
    results: dict[str, Any] = {}
    shown: list[Section] = []
    worst = 0
    folder = tempfile.mkdtemp(prefix="spikeloom-")
    ahead = _compile_ahead(folder)
    for name, words, outcome in _outcomes(STEPS, folder):
        if ahead is not None:
            ahead.join()  # what it has not compiled by now would be compiled twice
        typed = " ".join(["spikeloom", name, *words]).replace("{folder}/", "")
        first, *others = outcome.sections(outcome.result)
        shown += [Section(first.title, [Code([typed]), *first.blocks]), *others]
        results[name], worst = outcome.result, max(worst, outcome.code)
    net = f"{folder}/grasps.loom"
    following = repeat.command("report", net, *STEPS[1][2:], "-o", "grasps.html")
    verdict = f"verdict: {in_a_sentence(results['verify'])}\nkept: {net}; all of it on one page:"
    shown.append(Section("Next", [Text(verdict), Code([following])]))
    return Outcome(results, lambda _: shown, worst)


def _outcomes(steps: Iterable[Sequence[str]], folder: str) -> Iterator[tuple[str, Sequence[str], Outcome]]:
    """Run commands one after the other."""
    for name, *words in steps:
        kind, run_it = COMMANDS[name]
        yield name, words, run_it(request_of(kind, [word.format(folder=folder) for word in words]))


def _compile_ahead(folder: str) -> BaseProcess | None:
    """Let another core compile for the later commands while the first one runs, unless that was ever done."""
    from spikeloom.compiler.layer_kernel import run_layer

    kept = getattr(getattr(run_layer, "stats", None), "cache_path", None)
    if kept is None or usable_cores() == 1 or any(Path(kept).glob("*run_layer*")):
        return None
    ahead = multiprocessing.get_context("spawn").Process(target=_run_in_small, args=(folder,), daemon=True)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which the process inherits: Ctrl-C is not for it
    ahead.start()
    signal.signal(signal.SIGINT, before)
    return ahead


def _run_in_small(folder: str) -> None:
    """Run on little, in silence: what goes wrong here the commands themselves will meet and say."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    silent = redirect_stderr(io.StringIO())
    with suppress(Exception), tempfile.TemporaryDirectory(dir=folder) as own, silent:
        for _ in _outcomes(IN_SMALL, own):
            pass
