"""The worked example runs as it stands: from made-up coordinates to a decision stream."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_square_sensor_example_reaches_a_decision(tmp_path):
    # `spikeloom` is whatever this interpreter runs, installed or not
    command = tmp_path / "bin" / "spikeloom"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m spikeloom "$@"\n')
    command.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "src"),
    }
    done = subprocess.run(
        ["bash", ROOT / "examples" / "square_sensor.sh", tmp_path / "made"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=540,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    made = tmp_path / "made"
    for name in ("coords.csv", "grasps.png", "training.png", "square.pt", "square.loom", "grasp.csv"):
        assert (made / name).stat().st_size > 0
    assert "E0  specification = engine in every" in done.stdout
    assert "grasp 1: class " in done.stdout
    assert "1 grasp, 100 bins" in done.stdout
