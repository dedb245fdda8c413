"""Time single steps of a live stream, Python and checks included, against the length of a bin.

    OMP_NUM_THREADS=1 python benchmarks/live_step.py NET.loom RECORDINGS [--split test] [--limit 20] [--bin 0.02]

Every bin of the recordings is one call of ``stream.step`` that also asks for the decision and its margin; the figures
are wall-clock times of these calls, after one grasp of warm-up. They are taken twice: one bin right after the other,
and at the pace of a sensor (first recording only), where the processor's caches have forgotten the network meanwhile.
The final counts are held against those of a run of the whole recordings.
"""

import argparse
import json
import time

import numpy as np

from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Stream
from spikeloom.runtime.machines.loihi1.engine import simulate
from spikeloom.runtime.machines.votes import class_counts


def timed_grasp(stream: Stream, recording: np.ndarray, pace_s: float) -> tuple[list[float], np.ndarray]:
    """Seconds of each step of a recording (taxels, 2, bins), and the final counts."""
    stream.reset()
    seconds = []
    for events in np.ascontiguousarray(np.moveaxis(recording, -1, 0)):
        time.sleep(pace_s)
        begun = time.perf_counter()
        step = stream.step(events)
        _ = step.decision, step.margin
        seconds.append(time.perf_counter() - begun)
    return seconds, (step, *stream.finish())[-1].counts


def figures(seconds: list[float], bin_s: float) -> dict[str, float]:
    """Median, 99th percentile and maximum, also as shares of a bin."""
    median, late, worst = np.percentile(seconds, [50, 99, 100]).tolist()
    return {
        "steps": len(seconds),
        "median_ms": round(median * 1e3, 4),
        "p99_ms": round(late * 1e3, 4),
        "max_ms": round(worst * 1e3, 4),
        "median_share_of_bin": round(median / bin_s, 5),
        "p99_share_of_bin": round(late / bin_s, 5),
    }


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("netlist")
    parser.add_argument("recordings")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int, default=20)
    parser.add_argument("--bin", type=float, default=0.02)
    arguments = parser.parse_args()

    live = machine_for(arguments.netlist)
    events = load_data(arguments.recordings, arguments.split, limit=arguments.limit).events
    begun = time.perf_counter()
    stream = live.stream()
    opened_s = time.perf_counter() - begun
    timed_grasp(stream, events[0], 0)
    grasps = [timed_grasp(stream, recording, 0) for recording in events]
    paced, _ = timed_grasp(stream, events[0], arguments.bin)
    whole = simulate(live.netlist, events.reshape(len(events), live.netlist.n_inputs, -1)).counts.spikes
    print(
        json.dumps(
            {
                "compartments": live.netlist.n_compartments,
                "synapses": live.netlist.n_synapses,
                "bin_ms": arguments.bin * 1e3,
                "open_stream_ms": round(opened_s * 1e3, 1),
                "back_to_back": figures([s for seconds, _ in grasps for s in seconds], arguments.bin),
                "at_the_pace_of_the_sensor": figures(paced, arguments.bin),
                "equals_run": np.array_equal([counts for _, counts in grasps], class_counts(live.netlist, whole)),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
