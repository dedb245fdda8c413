"""What the seed paper says each system and graph reaches, where its figures are known here.

References
----------
.. [1] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020. Mean and standard deviation of ten runs, the best epoch of each on the test split.
"""

from __future__ import annotations

from dataclasses import dataclass

from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET

RUNS = 10
"""Trainings behind each figure."""

RECORDINGS = {
    "objects": "99d93e3387c9fd7e27c5edfa0aa9b9ba732acdbb542af3a7a0aefdd787ff709e",
    "containers": "76bf7e7beab61bba8534ae8522e45630edd55d454897766797cdbd8491e37f1c",
}
"""Hash over both splits of the released recordings, see :func:`protocols.data_digest`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Published:
    """A figure of the paper, in percent.

    Parameters
    ----------
    mean : float
        Over ``RUNS`` trainings.
    std : float or None
        Standard deviation over them; None where it is not known here.
    """

    mean: float
    std: float | None


_FIGURES = {
    ("objects", TACTILESGNET, "manual"): (89.44, 0.55),
    ("containers", TACTILESGNET, "manual"): (64.17, 2.75),
    ("objects", GRID_CNN, ""): (88.40, 1.14),
    ("containers", GRID_CNN, ""): (60.17, 2.78),
    ("objects", MLP, ""): (85.97, 0.85),
    ("containers", MLP, ""): (58.83, 2.49),
    ("objects", GCN, "manual"): (85.14, 1.51),
    ("containers", GCN, "manual"): (58.83, 2.84),
    # of the table of graphs only the best ones
    ("objects", TACTILESGNET, "knn:7"): (89.65, None),
    ("containers", TACTILESGNET, "knn:4"): (67.00, 1.39),
}
# The paper names no padding of its grid-based CNN, and its neighbours and trees list some edges twice.


def published(data: str, sha256: str, system: str, form: str) -> Published | None:
    """Figure for a system on recordings of that hash; None where it is not known, or the recordings are others.

    Examples
    --------
    >>> published("objects", RECORDINGS["objects"], "grid-cnn", "same")
    Published(mean=88.4, std=1.14)
    >>> published("objects", "", "mlp", "none"), published("objects", RECORDINGS["objects"], "tactilesgnet", "knn:1")
    (None, None)
    """
    if RECORDINGS.get(data) != sha256:
        return None
    figure = _FIGURES.get((data, system, form if system in (TACTILESGNET, GCN) else ""))
    plain = form.removeprefix("released:")
    if figure is None and plain != form:
        figure = _FIGURES.get((data, system, plain))
    return None if figure is None else Published(mean=figure[0], std=figure[1])
