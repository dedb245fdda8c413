"""Pieces of a chart's work, as they cross process borders; :mod:`chart.work` does them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

FORMAT = 1
"""Of what is measured; goes up when a figure means something else."""

SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Where recordings are, and how they are read.

    Parameters
    ----------
    path : str
        As ``--data`` names them.
    bin_s : float
        Seconds of a step.
    sha256 : str, optional
        Of both splits; another process holds its own against it.
    """

    path: str
    bin_s: float
    sha256: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decide:
    """Decisions of a float model when parts of each recording have passed.

    Parameters
    ----------
    words : tuple of str
        Of a ``compile`` command that names the network.
    sha256 : str
        Of the checkpoint.
    data : Data
    windows : tuple of int
        Per cent.
    """

    words: tuple[str, ...]
    sha256: str
    data: Data
    windows: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """Layouts of a network, rounded once.

    Parameters
    ----------
    layouts : mapping of str to tuple of str
        Words of a ``compile`` command by layout; they differ in the layout alone.
    sha256 : str
        Of the checkpoint.
    files : mapping of str to Path
        Where each netlist is kept.
    data : Data
        Whose training split chooses the scales.
    """

    layouts: Mapping[str, tuple[str, ...]]
    sha256: str
    files: Mapping[str, Path]
    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A netlist on a part of every recording.

    Parameters
    ----------
    build : Build
        What makes the netlist, should its file be gone.
    layout : str
        Which one.
    sha256 : str
        Of the file.
    window : int
        Per cent.
    """

    build: Build
    layout: str
    sha256: str
    window: int
