"""Write recordings as plain arrays, for scripts that run in environments without this package.

``python benchmarks/recordings_npz.py DATA.zip SPLIT OUT.npz`` writes ``events`` (samples, channels, steps) uint8,
channel ``taxel * polarities + polarity``, and ``labels``.
"""

import sys

import numpy as np

from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import BIN_S


def main() -> None:
    """Convert one split."""
    source, split, target = sys.argv[1:]
    data = load_data(source, split, bin_s=BIN_S)
    samples, taxels, polarities, steps = data.events.shape
    events = data.events.reshape(samples, taxels * polarities, steps).astype(np.uint8)
    np.savez_compressed(target, events=events, labels=data.labels)
    print(f"{target}: {samples} recordings of {steps} steps")


if __name__ == "__main__":
    main()
