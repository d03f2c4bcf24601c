#!/bin/sh
# Builds the image from the newest package, simulates the flight, flies the bench. Arguments go to bench.py.
set -eu
cd "$(dirname "$0")/.."
deb=$(ls -t target/debian/windhover_*.deb | head -n 1)
out=target/hil
bash hil/build.sh "$deb" "$out"
test -f "$out/flight.mcap" || target/release/windhover simulate "$out/flight.mcap" --duration 90 --fps 10 --seed 7
exec python3 hil/bench.py --image "$out" --windhover target/release/windhover \
    --feed target/release/examples/hil_feed --frames target/release/examples/hil_frames \
    --capture "$out/flight.mcap" --truth "$out/flight.truth.csv" "$@"
