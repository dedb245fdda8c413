"""The command ``demo``: the main job on what the package ships."""

import argparse
import tempfile
from typing import Any

from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.runtime.commands.main_job import compile, estimate, verify
from spikeloom.runtime.equivalence.verdict import in_a_sentence
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.report.sections import Code, Outcome, Section, Text

COMMANDS = {"compile": compile, "verify": verify, "estimate": estimate}

STEPS = (
    ("compile", "pretrained:grasps", "--calibrate", SYNTHETIC, "-o", "{folder}/grasps.loom"),
    ("verify", "{folder}/grasps.loom", "--checkpoint", "pretrained:grasps", "--data", SYNTHETIC),
    ("estimate", "{folder}/grasps.loom", "--data", SYNTHETIC),
)
"""Commands that run in a new folder for temporary files, where the netlist stays."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Take no options of its own."""


def run(_arguments: argparse.Namespace) -> Outcome:
    """Run the commands one after the other; the worst exit code counts."""
    results: dict[str, Any] = {}
    shown: list[Section] = []
    worst = 0
    folder = tempfile.mkdtemp(prefix="spikeloom-")
    for name, *words in STEPS:
        parser = argparse.ArgumentParser()
        COMMANDS[name].add_arguments(parser)
        found = COMMANDS[name].run(parser.parse_args([word.format(folder=folder) for word in words]))
        typed = " ".join(["spikeloom", name, *words]).replace("{folder}/", "")
        first, *others = found.sections(found.result)
        shown += [Section(first.title, [Code([typed]), *first.blocks]), *others]
        results[name], worst = found.result, max(worst, found.code)
    net = f"{folder}/grasps.loom"
    following = repeat.command("report", net, *STEPS[1][2:], "-o", "grasps.html")
    verdict = f"verdict: {in_a_sentence(results['verify'])}\nkept: {net}; all of it on one page:"
    shown.append(Section("Next", [Text(verdict), Code([following])]))
    return Outcome(results, lambda _: shown, worst)
