#!/bin/sh
# A simulated flight from sensor bytes to a report: demo.sh BINARY FOLDER
set -eu
windhover="$1"
folder="$2"
mkdir -p "$folder"
echo "== a simulated helicopter follows a vehicle for half a minute: serial bytes, camera frames, and the truth"
"$windhover" simulate "$folder/capture.mcap" --scenario follow --duration 30 --seed 1
echo
echo "== the pipeline on the capture, with the operator's log"
"$windhover" replay "$folder/capture.mcap" --out "$folder/flight.mcap" --log
echo
echo "== the estimates against the truth"
"$windhover" report "$folder/flight.mcap" --truth "$folder/capture.truth.csv" --out "$folder/report.html"
"$windhover" export "$folder/flight.mcap" --format csv --out "$folder/tables"
echo
# On a desktop the report opens by itself.
if [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ] && command -v xdg-open > /dev/null; then
    xdg-open "$folder/report.html" > /dev/null 2>&1 || true
fi
echo "Open $folder/report.html in a browser; $folder/flight.mcap opens in Foxglove."
echo "The same live, with a map: $windhover simulate --live --duration 120"
