"""Cells as ``spikeloom reproduce`` keeps them, with made-up figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from spikeloom.models.training.schedule import DECAY_EPOCHS
from spikeloom.runtime.studies.paper.cells import FORMAT, Row, cell_file, write_cell
from spikeloom.runtime.studies.paper.published import RECORDINGS

SAMPLES = {"objects": 144, "containers": 60}

CAPACITY = "core 0 (fc1): 15808 used, 4096 allowed (loihi1.core.axons_in); fewer inputs to the layer"


def made_cell(
    data: str,
    system: str,
    form: str,
    epochs: int,
    seed: int,
    correct: tuple[int, int, int],
    *,
    chip: tuple[int, int] | None = None,
    scale: float = 1.0,
    samples: int | None = None,
    sha256: str | None = None,
) -> dict[str, Any]:
    """A cell.

    `correct`: test recordings right at the best, last and clean epoch; `chip`: at the last and the clean one on the
    chip, which refuses the network where it is None; `scale`: of operations and energies.
    """
    total = samples or SAMPLES[data]
    names = dict(zip(("best", "last", "clean"), correct, strict=True))
    when = {"best": epochs // 2, "last": epochs, "clean": epochs - 1}
    return {
        "format": FORMAT,
        "data": data,
        "system": system,
        "form": form,
        "epochs": epochs,
        "decay_epochs": DECAY_EPOCHS,
        "seed": seed,
        "data_sha256": RECORDINGS[data] if sha256 is None else sha256,
        "test_samples": total,
        **{
            which: {"epoch": when[which], "correct": right, "accuracy": right / total} for which, right in names.items()
        },
        "chip": {"target": "loihi1", "bits": 8}
        | (
            {"refused": [CAPACITY]}
            if chip is None
            else {
                which: made_figures(when[which], names[which], right, total, scale)
                for which, right in zip(("last", "clean"), chip, strict=True)
            }
        ),
    }


def made_figures(epoch: int, float_correct: int, correct: int, samples: int, scale: float) -> dict[str, Any]:
    """Figures of one epoch on the chip."""
    energy = {"davies2018": 200e-6 * scale, "sanafe": 270e-6 * scale}
    return {
        "epoch": epoch,
        "float_correct": float_correct,
        "correct": correct,
        "equal": samples - 3,
        "synaptic_operations": 6e6 * scale,
        "first_layer_operations": 2e6 * scale,
        "energy_j": energy,
        "first_layer_energy_j": {name: joule / 2 for name, joule in energy.items()},
        "cores": 6,
        "neurons": 2580,
        "synapses": 385_511,
        "first_layer": {
            "neurons": 2496,
            "cannot_fire": 336,
            "unheard": 0,
            "quiet_in_training": 310,
            "quiet_in_both": 260,
        },
        "without_quiet": {
            "correct": correct,
            "equal_to_chip": samples - 1,
            "synaptic_operations": 5.7e6 * scale,
            "first_layer_operations": 1.7e6 * scale,
            "energy_j": {name: 0.9 * joule for name, joule in energy.items()},
            "first_layer_energy_j": {name: 0.4 * joule for name, joule in energy.items()},
            "cores": 5,
            "neurons": 2270,
            "synapses": 340_000,
        },
    }


def kept(folder: Path, *cells: dict[str, Any]) -> None:
    """Keep cells in a folder."""
    (folder / "cells").mkdir(parents=True, exist_ok=True)
    for cell in cells:
        row = Row(data=cell["data"], system=cell["system"], form=cell["form"], epochs=cell["epochs"])
        write_cell(cell_file(folder, row.cell(cell["seed"])), cell)
