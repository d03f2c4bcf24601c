#!/bin/sh
# Makes the image and flies the bench. Arguments go to bench.py.
set -eu
cd "$(dirname "$0")/.."
sh hil/image.sh
exec python3 hil/bench.py "$@"
