"""The command ``demo``: the main job on what the package ships."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from typing import Any

from spikeloom.models.recordings.grasps import SYNTHETIC

STEPS = (
    ("compile", "pretrained:grasps", "--calibrate", SYNTHETIC, "-o", "{folder}/grasps.loom"),
    ("verify", "{folder}/grasps.loom", "--checkpoint", "pretrained:grasps", "--data", SYNTHETIC),
    ("estimate", "{folder}/grasps.loom", "--data", SYNTHETIC),
)
"""Commands that run in a temporary folder."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Take no options of its own."""


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], Callable[[dict[str, Any]], str], int]:
    """Run the commands one after the other, by what the command line gives for that; the worst exit code counts."""
    results: dict[str, Any] = {}
    texts: list[str] = []
    worst = 0
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as folder:
        for words in STEPS:
            results[words[0]], text, code = arguments.run_words([word.format(folder=folder) for word in words])
            typed = " ".join(words).replace("{folder}/", "")
            texts.append(f"$ spikeloom {typed}\n{text}")
            worst = max(worst, code)
    return results, lambda _: "\n\n".join(texts), worst
