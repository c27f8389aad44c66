#!/bin/sh
# drone_racing_setup.sh FOLDER: makes the environment in which `python -m benchmarks.outside.drone_racing` runs.
# Run it in the root of this repository. crazyflow 0.4, pip's default, doesn't fit the races.
set -eu
python3 -m venv "$1/venv"
"$1/venv/bin/pip" install "crazyflow==0.1.0" "gymnasium[array-api]>=1.2" ml-collections packaging drone-models \
    drone-controllers "jax>=0.7,!=0.10.2" warp-lang fire toml
"$1/venv/bin/pip" install -c constraints.txt -e .
git clone https://github.com/learnsyslab/lsy_drone_racing "$1/lsy_drone_racing"
git -C "$1/lsy_drone_racing" checkout eb891d0
echo "JAX_PLATFORMS=cpu PYTHONPATH=.:$1/lsy_drone_racing $1/venv/bin/python -m benchmarks.outside.drone_racing \\"
echo "    --repository $1/lsy_drone_racing"
