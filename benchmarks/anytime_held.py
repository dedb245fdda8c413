"""Early decisions calibrated on recordings that the network was trained on, and on others.

    python benchmarks/anytime_held.py DATA OUT.json [--epochs 100] [--network FILE.pt]

A network is trained by the released recipe on four fifths of the training split. Factors come from races for second
place in these, as ``anytime --calibrate`` finds them, and from the decisions on the fifth that was left out, as
``--held-out`` finds them. Counted are the test decisions that differ with each, and the steps that it saves.
FILE.pt keeps the network; an interrupted training goes on.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.network_kinds import kind_of
from spikeloom.models.recordings.evtouch import BIN_S, Recordings
from spikeloom.models.training.kinds import seen_by
from spikeloom.models.training.train import train, validation_split
from spikeloom.runtime.cli import build_parser
from spikeloom.runtime.commands.choose.anytime import ALLOWED
from spikeloom.runtime.commands.training.train import both_splits, plan_jobs
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.capabilities import require_stoppable
from spikeloom.runtime.studies.anytime import exits


def fit(fitted: Recordings, held: Recordings, words: list[str], network: Path) -> None:
    """Train on the one part and store the last epoch."""
    (job,) = plan_jobs(build_parser().parse_args([*words, "-o", "none.pt"]), fitted, held)
    kind = kind_of(job.plan.system)
    trained = train(
        fitted,
        held,
        seen_by(job.plan),
        kind.architecture(job.plan),
        epochs=job.epochs,
        recipe=job.plan.recipe,
        state=network.with_suffix(".state"),
        resume=True,
    )
    kind.save(network, {"last": trained.last}, job.plan, {})


def main() -> None:
    """Train, calibrate, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--network", type=Path, default=Path("fitted.pt"))
    asked = parser.parse_args()
    training, test = both_splits(asked.recordings, len(NEUTOUCH), BIN_S)
    fitted, held = validation_split(training)
    if not asked.network.exists():
        words = ["train", "--data", asked.recordings, "--graph", "manual", "--epochs", str(asked.epochs)]
        fit(fitted, held, words, asked.network)
    checkpoint = read_checkpoint(asked.network)
    weights = expand(checkpoint, propagation(checkpoint, None, str(asked.network))[1])
    netlist = compile_network(weights, Options(training_events=fitted.events)).netlist
    machine = require_stoppable(machine_of(netlist))
    votes, lengths = {}, {}
    for name, data in (("fitted", fitted), ("held", held), ("test", test)):
        lengths[name] = np.full(len(data), data.steps)
        votes[name] = machine.cumulative(data.events, lengths[name]).votes
    at = exits.standing(votes["test"], lengths["test"])
    sure, rows = exits.proven(votes["test"], at, exits.most_votes(machine, test.steps)), np.arange(len(test))
    found: dict[str, Any] = made(training, test) | {"recordings": {"fitted": len(fitted), "held": len(held)}}
    found |= {"test_samples": len(test), "correct": int(np.count_nonzero(at.decision == test.labels)), "rules": {}}
    sources = {
        "races": exits.races(votes["fitted"], lengths["fitted"]),
        "held": exits.standing(votes["held"], lengths["held"]),
    }
    for name, race in sources.items():
        for allowed in ALLOWED:
            rule = exits.calibrate(exits.turning_points(race), allowed)
            ends = exits.exits(sure, at, rule.factor)
            spent = np.mean(ends + 1 + machine.read_out_lag) / (test.steps + netlist.max_depth)
            found["rules"].setdefault(name, {})[f"{100 * allowed:g} %"] = {
                "factor": rule.factor,
                "calibrated_on": rule.races,
                "bound": rule.bound,
                "differ": int(np.count_nonzero(at.leader[rows, ends] != at.decision)),
                "steps_saved": float(1 - spent),
            }
    with write_atomically(asked.output) as file:
        file.write((json.dumps(found, indent=1) + "\n").encode())
    print(json.dumps(found["rules"], indent=1))


if __name__ == "__main__":
    main()
