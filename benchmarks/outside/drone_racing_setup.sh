#!/bin/sh
# drone_racing_setup.sh FOLDER [REPOSITORY]: makes the environment in which `python -m benchmarks.outside.drone_racing` runs.
# Run it in the root of this repository. REPOSITORY is a clone of theirs, where GitHub can't be reached.
# crazyflow 0.4, pip's default, doesn't fit the races. What is there already stays, so it may be run again.
set -eu
races="$1/lsy_drone_racing"
[ -d "$races" ] || git clone "${2:-https://github.com/learnsyslab/lsy_drone_racing}" "$races"
git -C "$races" checkout -q eb891d0
[ -d "$1/venv" ] || python3 -m venv "$1/venv"
"$1/venv/bin/pip" install "crazyflow==0.1.0" "gymnasium[array-api]>=1.2" ml-collections packaging drone-models \
    drone-controllers "jax>=0.7,!=0.10.2" warp-lang fire toml
"$1/venv/bin/pip" install -c constraints.txt -e .
echo "JAX_PLATFORMS=cpu PYTHONPATH=.:$races $1/venv/bin/python -m benchmarks.outside.drone_racing \\"
echo "    --repository $races"
