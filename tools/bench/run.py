"""Runs the bench of a public data set, from the download to the table.

python tools bench.run NAME DIR -o WORK

NAME: lerf-mask, lerf-ovs or scannetpp; NAME --help lists the options.
"""

from __future__ import annotations

import sys

from bench.lerf import LerfMask, LerfOvs
from bench.scannetpp import ScanNetPP
from perception.errors import InputError

BENCHES = {bench.name: bench for bench in (LerfMask, LerfOvs, ScanNetPP)}


def main(arguments: list[str]) -> int:
    """Runs the bench that the first argument names; returns the exit code: 0, or 2 for bad usage or input."""
    try:
        if not arguments or arguments[0] not in BENCHES:
            raise InputError(f"expected one of: {', '.join(BENCHES)}, found {arguments[:1] or 'nothing'}")
        BENCHES[arguments[0]].main(arguments[1:])
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
