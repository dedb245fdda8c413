#!/usr/bin/env bash
# From a sensor that nobody has met to a stream of decisions: a made-up square of 5 x 5 taxels, synthetic grasps on it,
# a network trained on those, its netlist, and one grasp decided while it happens. Needs no file; writes to DIR.
#
#   bash examples/square_sensor.sh [DIR]
set -euo pipefail
dir="${1:-$(mktemp -d)}"
mkdir -p "$dir"
cd "$dir"
say() { printf '\n$ %s\n' "$*"; "$@"; }

# 1. Where the taxels are: x,y in millimetres, taxel 0 first, 3 mm apart.
python3 -c 'print("x,y", *(f"{3 * i},{3 * j}" for j in range(5) for i in range(5)), sep="\n")' > coords.csv

# 2. Recordings. Yours would be event files (time_s,taxel,polarity) or the released layout; these are made up.
say spikeloom data convert synthetic --taxels coords.csv -o grasps
say spikeloom data describe grasps --taxels coords.csv

# 3. Train on a graph of the four nearest neighbours, on all cores if you give several --seeds.
say spikeloom train --data grasps --taxels coords.csv --graph knn:4 --epochs 1 --features 16 -o square.pt --picture training.png

# 4. Lower it to the chip, and see what that changes. The checkpoint knows its graph.
say spikeloom compile square.pt --calibrate grasps -o square.loom
say spikeloom verify square.loom --checkpoint square.pt --data grasps --limit 36 --min-agreement 0.9

# 5. One grasp as it would arrive from the sensor, line by line, and the decision while it runs.
first="$(find grasps/test -name '*.npy' | sort | sed -n 1p)"
say spikeloom data convert "$first" -o grasp.csv
say spikeloom watch square.loom --input grasp.csv --bins 100
