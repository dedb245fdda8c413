"""What the order of training recordings is worth: shuffled each epoch, as here, or always the same, as released.

    python benchmarks/order.py DATA OUT.json [--system mlp] [--seeds 3] [--epochs 100]

The released code takes recordings in the order in which the folder lists them, the same in every epoch: which one that
is depends on the machine. Tried are ``fixed``, one order drawn for all epochs, and ``listed``, by file name. Accuracies
are of the best epoch on test and of the last.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from made import made

from spikeloom.compiler.systems import GRAPH_SYSTEMS, MLP
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.network_kinds import kind_of
from spikeloom.models.recordings.evtouch import BIN_S, Recordings
from spikeloom.models.training.kinds import seen_by
from spikeloom.models.training.train import train
from spikeloom.runtime.cli import build_parser
from spikeloom.runtime.commands.training.train import both_splits, plan_jobs

ORDERS = ("shuffled", "fixed", "listed")


def order_of(kind: str, training: Recordings, seed: int) -> Any:
    """What stands in for the generator that shuffles; None where recordings are shuffled anew."""
    if kind == "shuffled":
        return None
    listed = np.argsort(training.files)
    order = listed if kind == "listed" else np.random.default_rng(seed).permutation(len(training))
    return SimpleNamespace(permutation=lambda _count: order)


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--system", default=MLP)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--orders", nargs="+", choices=ORDERS, default=ORDERS)
    asked = parser.parse_args()
    training, test = both_splits(asked.recordings, len(NEUTOUCH), BIN_S)
    found: dict[str, Any] = made(training, test) | {"data": Path(asked.recordings).name}
    found |= {"system": asked.system, "epochs": asked.epochs}
    for kind in asked.orders:
        runs = []
        for seed in range(asked.seeds):
            words = ["train", "--data", asked.recordings, "--system", asked.system, "--graph", "manual"]
            words = words if asked.system in GRAPH_SYSTEMS else words[:5]
            words += ["--seed", str(seed), "--epochs", str(asked.epochs), "-o", "none.pt"]
            (job,) = plan_jobs(build_parser().parse_args(words), training, test)
            order = order_of(kind, training, seed)
            with patch(
                "numpy.random.default_rng", np.random.default_rng if order is None else lambda _seed, o=order: o
            ):
                trained = train(
                    training,
                    test,
                    seen_by(job.plan),
                    kind_of(job.plan.system).architecture(job.plan),
                    epochs=job.epochs,
                    seed=seed,
                    recipe=job.plan.recipe,
                )
            right = [epoch.correct for epoch in trained.history]
            runs.append(
                {"seed": seed, "best": max(right), "last": right[-1], "loss": trained.history[-1].training_loss}
            )
            print(kind, runs[-1], file=sys.stderr)
        of_test = 100 / len(test)
        means = {which: statistics.fmean(run[which] for run in runs) * of_test for which in ("best", "last")}
        found[kind] = {"runs": runs, "mean": means}
        asked.output.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps({kind: found[kind]["mean"] for kind in asked.orders}))


if __name__ == "__main__":
    main()
