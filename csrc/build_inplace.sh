#!/usr/bin/env bash
# Builds the compiled core in the source tree for development: csrc/build_inplace.sh [python]
set -eu
cd "$(dirname "$0")/.."
python=${1:-python3}
cmake -S . -B build -DPython_EXECUTABLE="$(command -v "$python")" -DPERCEPTION_WERROR=ON >/dev/null
cmake --build build -j 2 -- --quiet
# A weak symbol of a level's object could stand in for the same function of another level: csrc/common/levels.h.
if find build -path '*avx*' -name '*.o' -exec nm -C {} + | grep ' [WVu] ' | grep -vE 'avx2::|avx512::|DW\.ref'; then
  echo "build_inplace: the functions above lie outside their level's namespace" >&2; exit 1
fi
cp build/_core*.so perception/
