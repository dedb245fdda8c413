"""Read trained checkpoints of all systems, from our own files and from files of ``torch.save``."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint, constant_faults
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import read_whole
from spikeloom.compiler.formats.spikeloom_checkpoint import members_of, read_own
from spikeloom.compiler.formats.torch_checkpoint import GIVE, read_torch
from spikeloom.compiler.systems import SYSTEMS


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    system: str | None = None,
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
        Which system it must be; files in the released layout hold a TactileSGNet.

    Raises
    ------
    ModelError
        If the file is no checkpoint, holds code, is damaged or altered, lacks the set or run, or its
        tensors do not make the system; every fault of the tensors is listed.
    OptionError
        If `system` is another than the file's, or `weights`, `beta` or `theta` has a value that does not exist, or a
        fine-tuned network had another one.
    """
    if weights is not None and weights not in WEIGHTS:
        raise OptionError(f"--weights {weights}: unknown; choose from {', '.join(WEIGHTS)}")
    if system is not None and system not in SYSTEMS:
        raise OptionError(f"--system {system}: unknown; choose from {', '.join(SYSTEMS)}")
    if faults := constant_faults(beta, theta):
        raise OptionError(faults[0])
    where = str(path)
    try:
        content = read_whole(Path(path), "checkpoint", GIVE)
    except ModelError as error:
        raise ModelError(f"{where}: {error}") from error
    members = members_of(where, content)
    if members is None:
        found = read_torch(where, content, run)
        if weights not in (None, "last"):
            raise ModelError(f"{where}: --weights {weights}: the file holds the last epoch only; omit --weights")
    else:
        if run != 0:
            raise ModelError(f"{where}: --run {run}: the file holds only run 0; omit --run")
        found = read_own(where, content, members, weights)
    _require_fit(where, found, system, beta, theta)
    given = [name for name, value in (("beta", beta), ("theta", theta)) if value is not None]
    return replace(
        found,
        beta=found.beta if beta is None else beta,
        theta=found.theta if theta is None else theta,
        assumed=tuple(name for name in found.assumed if name not in given),
    )


def _require_fit(where: str, found: Checkpoint, system: str | None, beta: float | None, theta: float | None) -> None:
    """Refuse what contradicts the file."""
    if system not in (None, found.system):
        raise OptionError(f"--system {system}: {where} holds a {found.system}; omit --system")
    for name, value, held in (("beta", beta, found.beta), ("theta", theta, found.theta)):
        if found.forms is not None and value not in (None, held):
            raise OptionError(f"--{name} {value:g}: {where} was fine-tuned with {held:g}; omit --{name}")
    if beta is not None and found.dynamics.betas:
        decays = ", ".join(f"{each:g}" for each in found.dynamics.betas)
        raise OptionError(f"--beta {beta:g}: {where} has a decay for each layer, {decays}; omit --beta")
