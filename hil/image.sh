#!/bin/sh
# What the bench flies with: the image from the newest package, and a simulated flight.
set -eu
cd "$(dirname "$0")/.."
deb=$(ls -t target/debian/windhover_*.deb | head -n 1)
out=target/hil
bash hil/build.sh "$deb" target/release/windhover "$out"
test -f "$out/flight.truth.csv" || target/release/windhover simulate "$out/flight.mcap" --duration 240 --fps 5 --seed 7
