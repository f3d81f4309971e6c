#!/usr/bin/env bash
# Photos in, map and labelled cloud out: launch/map.sh PHOTOS OUT.gsmap [options of `perception map`]
set -euo pipefail
if [ $# -lt 2 ]; then
  echo "usage: $0 PHOTOS OUT.gsmap [options of 'perception map']" >&2
  exit 2
fi
photos=$1 map=$2
shift 2
perception map "$photos" -o "$map" "$@"
perception export "$map" -o "${map%.gsmap}.ply" --color instance
