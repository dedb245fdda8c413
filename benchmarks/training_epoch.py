"""Time training epochs on one core.

    OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/training_epoch.py RECORDINGS [--graph manual] [--epochs 4]

Prints CPU and wall seconds of each epoch, evaluation on the test split included; the first holds the compilation of
the kernels.
"""

import argparse
import json
import time
from itertools import pairwise

from models.evtouch import load_recordings
from models.graphs import build_graph, normalised_adjacency
from models.networks import Architecture
from models.train import Epoch, train


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings")
    parser.add_argument("--graph", default="manual")
    parser.add_argument("--epochs", type=int, default=4)
    arguments = parser.parse_args()

    graph = build_graph(arguments.graph)
    training = load_recordings(arguments.recordings, "train")
    test = load_recordings(arguments.recordings, "test")
    marks = [(time.process_time(), time.perf_counter())]

    def mark(_epoch: Epoch) -> None:
        marks.append((time.process_time(), time.perf_counter()))

    train(
        training,
        test,
        normalised_adjacency(graph.edges, graph.n_taxels),
        Architecture(taxels=graph.n_taxels, classes=int(training.labels.max()) + 1),
        epochs=arguments.epochs,
        after_epoch=mark,
    )
    spans = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(marks)]
    print(
        json.dumps(
            {
                "training_samples": len(training),
                "test_samples": len(test),
                "cpu_s": [round(cpu, 2) for cpu, _ in spans],
                "wall_s": [round(wall, 2) for _, wall in spans],
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
