"""Compile, verify and price networks that others have published: ``public_networks.py FOLDER OUT.json``.

FOLDER holds clones of the repositories named below, each under its own name (``NIR``, ``lava-dl``, ``NIRTorch``,
``rockpool``). Their recordings are not public or too large, so every network gets 40 made ones: each channel has an
event in a step with one probability, the least of RATES at which the float network's classes fire at all, seeded. The
first 20 are for calibration, the others for verification.

The word for a network is *faithful* when it passes ``verify`` and the chip has 95 % of the float model's class spikes,
or when its integers are read as they stand; *approximate* when it compiles and does not, *silent* when no class fires
even at the highest rate, *refused* when it does not compile; then the reason stands beside.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from made import made as what_made_it

STEPS, RECORDINGS = 100, 20
RATES = 0.1, 0.3, 0.9
IN_COMMON = 0.95
"""Share of the float model's class spikes that a faithful network has."""


@dataclass(frozen=True)
class Published:
    """A file of a public repository, what made it, and the options that it needs."""

    name: str
    made_by: str
    repository: str
    path: str
    options: tuple[str, ...] = ()


NETX = "tutorials/lava/lib/dl"
NIR_STEP = ("--dt", "1e-4")
ONE = (*NIR_STEP, "--polarities", "1")
FIRST = ("--polarities", "3", "--polarities-first")
NETWORKS = (
    Published(
        "Braille, reset to zero", "snnTorch", "NIR", "paper/03_rnn/braille_noDelay_bias_zero.nir", NIR_STEP
    ),
    Published(
        "Braille, subtracting",
        "snnTorch",
        "NIR",
        "paper/03_rnn/braille_noDelay_noBias_subtract.nir",
        NIR_STEP,
    ),
    Published(
        "Braille, nested", "snnTorch", "NIR", "paper/03_rnn/extras/braille_noDelay_bias_zero_subgraph.nir"
    ),
    Published(
        "Braille, no resets in the file",
        "Rockpool",
        "rockpool",
        "tests/tests_default/nir_graphs/braille.nir",
        ("--dt", "1"),
    ),
    Published("N-MNIST convolutions", "sinabs", "NIR", "paper/02_cnn/cnn_sinabs.nir", ("--dt", "1")),
    Published("one LIF neuron", "Norse", "NIR", "paper/01_lif/lif_norse.nir", ONE),
    Published("one LIF neuron", "Rockpool", "NIR", "paper/01_lif/lif_rockpool.nir", ONE),
    Published(
        "two LIF neurons",
        "snnTorch",
        "NIR",
        "paper/01_lif/debug_spike_representation/two_lif_neurons.nir",
        ONE,
    ),
    Published("Oxford", "lava-dl", "lava-dl", f"{NETX}/netx/oxford/Trained/network.net"),
    Published("MNIST", "lava-dl", "lava-dl", f"{NETX}/netx/mnist/trained_mnist_network.net"),
    Published("tiny", "lava-dl", "lava-dl", "tests/lava/lib/dl/netx/tiny.net", FIRST),
    Published(
        "PilotNet, LIF", "lava-dl", "lava-dl", "tests/lava/lib/dl/netx/gts/pilotnet_lif/network.net", FIRST
    ),
    Published(
        "PilotNet, sigma-delta",
        "lava-dl",
        "lava-dl",
        "tests/lava/lib/dl/netx/gts/pilotnet_sdnn/network.net",
        FIRST,
    ),
    Published("MNIST, rates", "lava-dl", "lava-dl", f"{NETX}/bootstrap/mnist/Trained/network.net"),
)


def spikeloom(*arguments: str) -> subprocess.CompletedProcess[str]:
    """One command of ours, as a process of its own."""
    command = [sys.executable, "-m", "spikeloom", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def recordings(folder: Path, taxels: int, polarities: int, classes: int, rate: float) -> None:
    """Made recordings of a network's input in the released layout, train and test."""
    generator = np.random.default_rng(20)
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True, exist_ok=True)
        for number in range(RECORDINGS):
            events = generator.random((taxels, polarities, STEPS)) < rate
            np.save(
                folder / split / f"sample_{number}_label_{number % classes}.npy", events.astype(np.uint8)
            )


def tried(folder: Path, network: Published) -> dict[str, object]:
    """What becomes of one network."""
    file = str(folder / network.repository / network.path)
    row: dict[str, object] = {**asdict(network), "options": " ".join(network.options)}
    with tempfile.TemporaryDirectory() as place:
        netlist, data = str(Path(place, "net.loom")), Path(place, "data")
        plain = spikeloom("compile", file, *network.options, "-o", netlist, "--json")
        if plain.returncode:
            return {**row, "word": "refused", "why": plain.stderr.strip().split(": ", 2)[-1]}
        made = json.loads(plain.stdout)
        given = dict(zip(network.options[::2], network.options[1::2], strict=False))
        sensor = made["taxels"], int(given.get("--polarities", 2)), made["classes"]
        integers = file.endswith(".net")
        for rate in RATES:
            recordings(data, *sensor, rate)
            if not integers:
                again = spikeloom(
                    "compile", file, *network.options, "--calibrate", str(data), "-o", netlist, "--json"
                )
                again.check_returncode()
                made = json.loads(again.stdout)
                row |= {"storage": [{k: t[k] for k in t if k != "layers"} for t in made.get("trials", [])]}
            price = json.loads(spikeloom("estimate", netlist, "--data", str(data), "--json").stdout)
            row |= {"rate": rate} | {key: made[key] for key in ("neurons", "synapses_stored", "cores")}
            row |= {"operations": price["per_inference"]["synaptic_operations"]}
            row |= {"energy_j": price["per_inference"]["energy_j"]["davies2018"]}
            if integers and price["layers"][-1]["spikes"]:
                return {**row, "word": "faithful", "why": "integers as they stand"}
            if not integers:
                options = ("--checkpoint", file, *network.options, "--data", str(data), "--json")
                verdict = spikeloom("verify", netlist, *options)
                checked = json.loads(verdict.stdout)
                spikes = list(checked["spikes"].values())[-1]
                row |= {"decisions_equal": checked["decision_agreement"], "recordings": checked["samples"]}
                common = (spikes["float"] + spikes["chip"] - spikes["different"]) / (
                    2 * max(spikes["float"], 1)
                )
                row |= {"spikes": spikes, "in_common": common}
                if spikes["float"]:
                    faithful = verdict.returncode == 0 and common >= IN_COMMON
                    return {
                        **row,
                        "word": "faithful" if faithful else "approximate",
                        "why": "; ".join(checked["missed"]),
                    }
        return {**row, "word": "silent", "why": "no class fires"}


def main(folder: str, out: str) -> None:
    """Try all and write the table."""
    rows = []
    for network in NETWORKS:
        rows.append(tried(Path(folder), network))
        print(
            *(
                rows[-1].get(key, "")
                for key in ("name", "made_by", "word", "why", "decisions_equal", "spikes")
            )
        )
    Path(out).write_text(json.dumps(what_made_it() | {"networks": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
