#!/usr/bin/env bash
# Pages of the public API from its docstrings: pip install pdoc && docs/build.sh [OUT]   (default: site/)
# The index is the list of public names in the docstring of the package.
set -euo pipefail
python - "${1:-site}" <<'PY'
import re
import sys
from pathlib import Path

import pdoc

import perception

vars(perception).update({name: getattr(perception, name) for name in perception.__all__})  # else found at first use
names = re.findall(r"`(perception\.[\w.]+)`", perception.__doc__)
pdoc.pdoc(*dict.fromkeys(["perception", *(name.rpartition(".")[0] for name in names)]), output_directory=Path(sys.argv[1]))
PY
