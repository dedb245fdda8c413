"""Read trained checkpoints of all systems, whatever their layout: each has a module beside this, and a row here."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from spikeloom.compiler.archive import AGAIN
from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint, constant_faults
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import read_whole, reading
from spikeloom.compiler.formats.own_checkpoint import is_own, read_own
from spikeloom.compiler.formats.torch_checkpoint import read_torch


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
) -> Checkpoint:
    """Read a checkpoint of any known layout; `run` is one of those of a released file.

    weights: which epoch, ``last``, ``best`` (on the test split) or ``clean`` (on a part of the training
    split), where the file holds several; the first of these that it holds by default. beta, theta: decay and
    threshold, where the file does not say; those of the released code by default. Files in the released
    layout hold a TactileSGNet.

    Raises ModelError if the file is no checkpoint, holds code, is damaged or altered, lacks the set or run,
    or its tensors do not make the system, with every fault of them; OptionError if an option contradicts the
    file, or has a value that does not exist.
    """
    if weights is not None and weights not in WEIGHTS:
        raise OptionError(f"--weights {weights}: unknown; choose from {', '.join(WEIGHTS)}")
    if faults := constant_faults(beta, theta):
        raise OptionError(faults[0])
    with reading(path, ModelError, AGAIN):
        checkpoint = _read(read_whole(Path(path), "checkpoint"), run, weights)
    _require_fit(str(path), checkpoint, beta, theta)
    given = [name for name, value in (("beta", beta), ("theta", theta)) if value is not None]
    return replace(
        checkpoint,
        beta=checkpoint.beta if beta is None else beta,
        theta=checkpoint.theta if theta is None else theta,
        assumed=tuple(name for name in checkpoint.assumed if name not in given),
    )


def _require_fit(where: str, found: Checkpoint, beta: float | None, theta: float | None) -> None:
    """Refuse what contradicts the file."""
    if beta is not None and found.dynamics.betas:
        decays = ", ".join(f"{each:g}" for each in found.dynamics.betas)
        raise OptionError(f"--beta {beta:g}: {where} has a decay for each layer, {decays}; omit --beta")
    for name, value, held in (("beta", beta, found.beta), ("theta", theta, found.theta)):
        if name not in found.assumed and value not in (None, held):
            raise OptionError(f"--{name} {value:g}: {where} was trained with {held}; omit --{name}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A kind of checkpoint file.

    takes: whether content is of this kind. read: reads content, of which a run and a set of weights are wanted;
    one that holds a single run, or the last epoch alone, need not look at these.
    """

    takes: Callable[[bytes], bool]
    read: Callable[[bytes, int, str | None], Checkpoint]


LAYOUTS = (
    Layout(takes=is_own, read=lambda content, _run, weights: read_own(content, weights)),
    Layout(takes=lambda _content: True, read=lambda content, run, _weights: read_torch(content, run)),
)
"""All of them; the first that takes a file reads it, the last says what is wrong with any other."""


def _read(content: bytes, run: int, weights: str | None) -> Checkpoint:
    """Checkpoint of any layout, which has the run and the weights that are wanted."""
    layout = next(layout for layout in LAYOUTS if layout.takes(content))
    checkpoint = layout.read(content, run, weights)
    if not 0 <= run < checkpoint.runs:
        raise ModelError(f"--run {run}: the file holds only run 0; omit --run")
    if weights not in (None, *checkpoint.sets):
        raise ModelError(f"--weights {weights}: the file holds the last epoch only; omit --weights")
    return checkpoint
