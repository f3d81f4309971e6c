#!/usr/bin/env bash
# Builds the compiled core in the source tree for development: csrc/build_inplace.sh [python]
set -eu
cd "$(dirname "$0")/.."
python=${1:-python3}
cmake -S . -B build -DPython_EXECUTABLE="$(command -v "$python")" -DPERCEPTION_WERROR=ON >/dev/null
cmake --build build -j 2 -- --quiet
cp build/_core*.so perception/
