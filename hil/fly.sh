#!/bin/sh
# Builds the image from the newest package, simulates the flight, flies the bench. Arguments go to bench.py; TOOLS is
# where what feeds the machine was built.
set -eu
cd "$(dirname "$0")/.."
deb=$(ls -t target/debian/windhover_*.deb | head -n 1)
out=target/hil
bash hil/build.sh "$deb" target/release/windhover "$out"
test -f "$out/flight.truth.csv" || target/release/windhover simulate "$out/flight.mcap" --duration 240 --fps 5 --seed 7
exec python3 hil/bench.py --image "$out" --windhover target/release/windhover --tools "${TOOLS:-target/release/examples}" \
    --capture "$out/flight.mcap" --truth "$out/flight.truth.csv" "$@"
