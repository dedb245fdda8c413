"""The file of certificates: recordings, what is claimed of each, and what shows it.

An archive of :mod:`compiler.archive`. ``bins`` (channels, all steps) are those set in each step of each recording, one
after another, bounded by ``step_bounds``. By recording ``decision``, ``unaltered`` (no so many events alter it) and
``rule`` (by which that can be checked); ``changes`` (changes, 2), channel and step of events that do alter it,
by ``change_bounds``; ``pasts`` (groups, 3), what a proof tells apart of the past of a group: see ``Evidence``; by
``past_bounds``.
"""

import numpy as np

from spikeloom.compiler.archive import archive_bytes, write_archive
from spikeloom.runtime.studies.robustness.results import Certificates

FORMAT = "spikeloom-certificate"

VERSION = 2


def write_certificate(path: str, result: Certificates, netlist_sha256: str) -> None:
    """Write what was found, whole or not at all."""
    found = result.certificates
    shown = [each.evidence for each in found if each.evidence is not None]
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "netlist_sha256": netlist_sha256,
        "files": [each.file for each in found],
    }
    arrays = {
        "decision": np.array([each.decision for each in found]),
        "unaltered": np.array([each.unaltered for each in shown]),
        "rule": np.array([each.rule for each in shown]),
        "bins": np.concatenate([each.bins for each in shown], axis=1),
        "step_bounds": np.cumsum([0, *(each.bins.shape[1] for each in shown)]),
        "changes": np.concatenate([each.changes for each in shown]),
        "change_bounds": np.cumsum([0, *(len(each.changes) for each in shown)]),
        "pasts": np.concatenate([each.pasts for each in shown]),
        "past_bounds": np.cumsum([0, *(len(each.pasts) for each in shown)]),
    }
    write_archive(archive_bytes(manifest, arrays), path)
