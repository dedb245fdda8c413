"""The command ``demo``: the main job on what the package ships."""

import tempfile
from collections.abc import Callable
from typing import Any

from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.runtime.commands.main_job import compile, estimate, verify
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


REQUEST = Request


def run(_request: Request) -> Outcome:
    """Run the commands one after the other; the worst exit code counts."""
    results: dict[str, Any] = {}
    shown: list[Section] = []
    worst = 0
    folder = tempfile.mkdtemp(prefix="spikeloom-")
    for name, *words in STEPS:
        kind, run_it = COMMANDS[name]
        outcome = run_it(request_of(kind, [word.format(folder=folder) for word in words]))
        typed = " ".join(["spikeloom", name, *words]).replace("{folder}/", "")
        first, *others = outcome.sections(outcome.result)
        shown += [Section(first.title, [Code([typed]), *first.blocks]), *others]
        results[name], worst = outcome.result, max(worst, outcome.code)
    net = f"{folder}/grasps.loom"
    following = repeat.command("report", net, *STEPS[1][2:], "-o", "grasps.html")
    verdict = f"verdict: {in_a_sentence(results['verify'])}\nkept: {net}; all of it on one page:"
    shown.append(Section("Next", [Text(verdict), Code([following])]))
    return Outcome(results, lambda _: shown, worst)
