"""What ``finetune`` gives back to networks from elsewhere that lose decisions to rounding.

    python benchmarks/finetuned.py RECORDINGS FOLDER OUT.json NETWORK...

Each NETWORK is a NIR or ONNX file; FOLDER gets the fine-tuned ones, by the place of their network, and keeps them when
the script is started again. Storage and weights come from the training split; the test split reports.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from made import made

import spikeloom
from spikeloom.compiler.files import write_atomically

EPOCHS = 10
STORAGES: dict[str, dict[str, Any]] = {
    "8 bits": {"weight_bits": "8", "scale_groups": "1"},
    "4 bits, 8 scales": {"weight_bits": "4", "scale_groups": "8"},
    "2 bits, 8 scales": {"weight_bits": "2", "scale_groups": "8"},
    "chosen": {},
}


def measured(net: spikeloom.Compiled, test: Any, reference: Any = None) -> dict[str, Any]:
    """Decisions of a netlist beside those of its own float model and of the `reference`; and what they cost."""
    verdict = net.verify(test)
    price = net.estimate(test).details
    decided = np.array(verdict.chip_predictions)
    own = np.array(verdict.float_predictions)
    return {
        "right": int(np.count_nonzero(decided == test.labels)),
        "own_float_right": int(np.count_nonzero(own == test.labels)),
        "equal": int(np.count_nonzero(decided == own)),
        "equal_to_original": int(np.count_nonzero(decided == (own if reference is None else reference))),
        "model_differs": verdict.model_different,
        "spikes": sum(layer.chip for layer in verdict.spikes.values()),
        "missed": list(verdict.missed),
        "operations": price.per_inference.synaptic_operations,
        "cores": len(price.cores),
    }


def main() -> None:
    """Fine-tune every network for every storage and store what was found."""
    source, folder, output, *networks = sys.argv[1:]
    data = spikeloom.recordings(source)
    Path(folder).mkdir(exist_ok=True)
    found: list[dict[str, Any]] = []
    for place, path in enumerate(networks, 1):
        step: dict[str, Any] = {"dt": 1e-4} if path.endswith(".nir") else {}
        rows: dict[str, Any] = {}
        for name, storage in STORAGES.items():
            rounded = spikeloom.compile(path, calibrate=data.train, **step, **storage)
            reference = np.array(rounded.verify(data.test).float_predictions)
            tuned = Path(folder, f"{place}-{name.split()[0]}.nir")
            if not tuned.exists():
                asked = {
                    key: int(value) if key == "scale_groups" else value for key, value in storage.items()
                }
                spikeloom.finetune(path, data, str(tuned), epochs=EPOCHS, **step, **asked)
            after = spikeloom.load(str(tuned.with_suffix(".loom")), network=str(tuned))
            rows[name] = {
                "before": measured(rounded, data.test),
                "after": measured(after, data.test, reference),
            }
            print(place, name, rows[name], flush=True)
        right = int(np.count_nonzero(reference == data.test.labels))
        found.append({"name": Path(path).name, "float_right": right, "storages": rows})
        result = made(data.train, data.test) | {
            "epochs": EPOCHS,
            "samples": len(data.test),
            "networks": found,
        }
        with write_atomically(Path(output)) as file:
            file.write(json.dumps(result, indent=1).encode())


if __name__ == "__main__":
    main()
