#!/usr/bin/env bash
# API pages from the docstrings: pip install pdoc && docs/build.sh [OUT]   (default: site/)
set -euo pipefail
python - <<'PY' | xargs python -m pdoc -o "${1:-site}"
import pkgutil

import perception

print("perception")
for module in pkgutil.walk_packages(perception.__path__, "perception."):
    if not module.name.rsplit(".", 1)[1].startswith("_"):
        print(module.name)
PY
