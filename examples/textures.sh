#!/usr/bin/env bash
# From a folder of another laboratory's files to a netlist that holds under conditions it has not seen: textures felt by
# nine taxels at several speeds and forces. ZIP holds textureNN_speedS_forceF.npz with `spikes` (steps, 10), a step a
# millisecond; the recordings are those of github.com/LIMB-UCF/NTP. Takes about ten minutes on two cores.
#
#   bash examples/textures.sh ZIP [DIR] [TIME]
set -euo pipefail
zip="$(realpath "$1")"
dir="${2:-$(mktemp -d)}"
time="${3:-8m}"
mkdir -p "$dir"
cd "$dir"
say() { printf '\n$ %s\n' "$*"; "$@"; }

# 1. Recordings as event files, with a table of what they are and under which conditions they were made. Speed 3600 is
#    kept for test: no network sees it before the end.
python3 - "$zip" <<'PYTHON'
import csv, io, re, sys, zipfile
from pathlib import Path

import numpy as np

rows = []
with zipfile.ZipFile(sys.argv[1]) as archive:
    for name in sorted(archive.namelist()):
        texture, speed, force = re.fullmatch(r"(texture\d+)_speed(\d+)_force([\d.]+)\.npz", name).groups()
        spikes = np.load(io.BytesIO(archive.read(name)), allow_pickle=False)["spikes"][:, :9]  # column 9 is no taxel
        file = Path("textures", "test" if speed == "3600" else "train", f"{texture}_speed{speed}_force{force}.csv")
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w", newline="") as out:
            events = csv.writer(out, lineterminator="\n")
            events.writerow(["time_s", "taxel", "polarity"])
            events.writerows([f"{(step + 0.5) / 1000:.4f}", taxel, 1] for step, taxel in np.argwhere(spikes))
        rows.append([f"{file.parent.name}/{file.name}", texture, speed, force])
with open("textures/recordings.csv", "w", newline="") as out:
    csv.writer(out, lineterminator="\n").writerows([["file", "label", "speed", "force"], *rows])
with open("taxels.csv", "w") as out:
    print("x,y", *(f"{2 * (n // 3)},{2 * (n % 3)}" for n in range(9)), sep="\n", file=out)
PYTHON
say spikeloom data describe textures --split train

# 2. The cheapest network that does the job. Each speed and each force of the training split is left out in turn, so
#    that the accuracy is what a new speed or force would see; the test split is read once, at the end.
say spikeloom smallest --data textures --taxels taxels.csv --graph knn:4 --time "$time" -o small.loom --html small.html

# 3. What it costs, and where it breaks.
say spikeloom estimate small.loom --data textures --limit 24
say spikeloom stress small.loom --checkpoint small.pt --data textures --only events_lost,faster,taxels_dead --limit 24
