"""Fixtures that find the real recordings and the released checkpoint, or skip with a reason.

The recordings may not be redistributed. Point SPIKELOOM_SHARED at a folder that holds ``data/`` and
``checkpoints/``; without it the folder ``shared`` beside the checkout is tried.
"""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("SPIKELOOM_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def _shared(relative: str) -> Path:
    path = SHARED / relative
    if not path.exists():
        pytest.skip(f"the released file {relative} is not on this machine (set SPIKELOOM_SHARED)")
    return path


@pytest.fixture(scope="session")
def objects_zip() -> Path:
    """The released Objects recordings."""
    return _shared("data/Ev-Objects.zip")


@pytest.fixture(scope="session")
def containers_zip() -> Path:
    """The released Containers recordings."""
    return _shared("data/Ev-Containers.zip")


@pytest.fixture(scope="session")
def released_checkpoint() -> Path:
    """A checkpoint in the released layout, trained on Objects with the manual graph."""
    return _shared("checkpoints/objects_manual.t7")


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder that holds the released files."""
    return _shared("checkpoints").parent
