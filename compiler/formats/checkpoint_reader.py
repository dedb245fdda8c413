"""Read trained checkpoints of all systems, from our own files and from files of ``torch.save``."""

from __future__ import annotations

import hashlib
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint, Dense, Float32Array
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.spikeloom_checkpoint import own_contents, own_members, require_constants
from spikeloom.compiler.formats.tensors import Arrays, Contents
from spikeloom.compiler.formats.torch_checkpoint import GIVE, read_released
from spikeloom.compiler.systems import (
    GRID_CNN,
    SYSTEMS,
    Grid,
    kernel_of,
    window_forms,
)
from spikeloom.compiler.types import IntArray

BETA, THETA = 0.2, 0.5
"""Decay and threshold of the released code; files in its layout do not hold them."""

SIZE_LIMIT = 2**28
"""Bytes that a checkpoint may have: 256 MiB, a hundred times the released ones."""


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    system: str | None = None,
    cells: IntArray | None = None,
) -> Checkpoint:
    """Read a checkpoint of any known layout.

    Parameters
    ----------
    path : path
        File.
    run : int
        Which run of a released file.
    weights : {"last", "best", "clean"}, optional
        Which epoch, where the file holds several; the first of these that it holds without. The best one was chosen
        on the test split, the clean one on a part of the training split.
    beta, theta : float, optional
        Decay and threshold; taken from the file, or from the released code where the file does not say.
    system : str, optional
        Which system it is; the file tells by itself.
    cells : (taxels, 2) int64, optional
        Row and column of each taxel on the grid of a grid-based CNN, where the file does not say.

    Raises
    ------
    ModelError
        If the file is no checkpoint, holds code, is damaged or altered, does not hold what is asked for, or its
        tensors do not make the system; every fault of the tensors is listed.
    OptionError
        If `system` is another than the file's, or `weights`, `beta` or `theta` has a value that does not exist, or a
        fine-tuned network had another one.
    """
    if weights is not None and weights not in WEIGHTS:
        raise OptionError(f"--weights {weights}: unknown; choose from {', '.join(WEIGHTS)}")
    if system is not None and system not in SYSTEMS:
        raise OptionError(f"--system {system}: unknown; choose from {', '.join(SYSTEMS)}")
    require_constants("", OptionError, beta, theta)
    where, path = str(path), Path(path)
    content = _content(where, path)
    members = own_members(where, content)
    if members is None:
        found = read_released(where, content, run, system)
        if weights not in (None, "last"):
            raise ModelError(f"{where}: --weights {weights}: the file holds the last epoch only; omit --weights")
    else:
        if run != 0:
            raise ModelError(f"{where}: --run {run}: the file holds only run 0; omit --run")
        found = own_contents(where, members, weights)
        _require_fit(where, found, system, beta, theta)
    arrays = {name: _plain(array) for name, array in found.arrays.items()}
    stages = sorted({key.split(".")[0] for key in arrays if key.startswith("fc")}, key=lambda name: int(name[2:]))
    constants = {"beta": (beta, found.beta, BETA), "theta": (theta, found.theta, THETA)}
    known = {name: next(value for value in values if value is not None) for name, values in constants.items()}
    return Checkpoint(
        hops=arrays["conv1.hops"],
        conv_bias=arrays["conv1.bias"],
        dense=tuple(Dense(name=name, weight=arrays[f"{name}.weight"], bias=arrays[f"{name}.bias"]) for name in stages),
        beta=known["beta"],
        theta=known["theta"],
        assumed=tuple(name for name, (given, held, _) in constants.items() if given is None and held is None),
        graph=found.graph,
        edges=found.edges,
        layout=found.layout,
        weights=found.weights,
        sets=found.sets,
        runs=found.runs,
        training=found.training,
        forms=found.forms,
        sha256=hashlib.sha256(content).hexdigest(),
        system=found.system,
        grid=_released_grid(where, arrays, cells) if members is None and found.system == GRID_CNN else found.grid,
        dynamics=found.dynamics,
        towers=found.towers,
        bins=found.bins,
    )


def _require_fit(where: str, found: Contents, system: str | None, beta: float | None, theta: float | None) -> None:
    """Refuse what contradicts a file of our own."""
    if system not in (None, found.system):
        raise OptionError(f"--system {system}: {where} holds a {found.system}; omit --system")
    for name, value, held in (("beta", beta, found.beta), ("theta", theta, found.theta)):
        if found.forms is not None and value not in (None, held):
            raise OptionError(f"--{name} {value:g}: {where} was fine-tuned with {held:g}; omit --{name}")
    if beta is not None and found.dynamics.betas:
        decays = ", ".join(f"{each:g}" for each in found.dynamics.betas)
        raise OptionError(f"--beta {beta:g}: {where} has a decay for each layer, {decays}; omit --beta")


def _released_grid(where: str, arrays: Arrays, cells: IntArray | None) -> Grid:
    """Grid of a file that does not say what it is: which of the two forms, the number of places tells."""
    if cells is None:
        raise ModelError(f"{where}: where the taxels lie on the grid is not in this file; name the sensor")
    filters, features, _ = arrays["conv1.hops"].shape
    places = arrays["fc1.weight"].shape[1] // features
    forms = window_forms(cells, kernel_of(filters))
    counts = {form: math.prod(grid.places(kernel_of(filters))) for form, grid in forms.items()}
    for form, count in counts.items():
        if count == places:
            return forms[form]
    sizes = " or ".join(f"{count} (padding {form})" for form, count in counts.items())
    raise ModelError(
        f"{where}: fc1 was trained on {places} places, a window of {kernel_of(filters)} * {kernel_of(filters)} on this "
        f"sensor has {sizes}; give the sensor that it was trained on"
    )


def _plain(array: npt.NDArray[Any]) -> Float32Array:
    copy = np.array(array, np.float32, order="C")
    copy.flags.writeable = False
    return copy


def _content(where: str, path: Path) -> bytes:
    """Bytes of the file."""
    if not path.is_file():
        raise ModelError(f"{where}: no such file; {GIVE}")
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise ModelError(f"{where}: cannot be read ({error.strerror or error}); check its permissions") from error
    if len(content) > SIZE_LIMIT:
        raise ModelError(f"{where}: more than {SIZE_LIMIT} bytes, the limit of a checkpoint; {GIVE}")
    return content
