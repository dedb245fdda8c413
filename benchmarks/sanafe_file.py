"""SANA-FE on a file of ``export --to sanafe``: ``sanafe_file.py NET.yaml GIVEN.npz RUNS.json``.

GIVEN.npz has `events` (recordings, channels, T), `steps` to run and `models` of time; RUNS.json gets of each recording
and model the spikes as step, group and number, joules by part, and SANA-FE's trace of each step.
"""

import json
import sys
from pathlib import Path

import numpy as np
import sanafe


def main() -> None:
    """Run each recording from rest by each model."""
    network, given, output = sys.argv[1:]
    arrays = np.load(given)
    chip = sanafe.SpikingChip(sanafe.load_loihi())
    chip.load(sanafe.load_net(network, sanafe.load_loihi()))
    runs = []
    for events in arrays["events"]:
        for model in arrays["models"]:
            if runs:
                chip.reset()
            for neuron, train in zip(chip.mapped_neuron_groups["input"], events, strict=True):
                neuron.set_attributes(model_attributes={"spikes": [bool(bit) for bit in train]})
            run = chip.sim(
                int(arrays["steps"]),
                timing_model=str(model),
                processing_threads=1,
                spike_trace=True,
                perf_trace=True,
            )
            fired = [
                [step, spike.group_name, spike.neuron_offset]
                for step, row in enumerate(run["spike_trace"])
                for spike in row
            ]
            trace = {name: list(values) for name, values in run["perf_trace"].items()}
            runs.append({"spikes": fired, "energy": run["energy"], "trace": trace})
    Path(output).write_text(json.dumps(runs), "utf-8")


if __name__ == "__main__":
    main()
