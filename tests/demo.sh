#!/bin/sh
# A simulated flight from sensor bytes to a report: demo.sh BINARY FOLDER
set -eu
windhover="$1"
folder="$2"
mkdir -p "$folder"
echo "== a helicopter follows a vehicle for half a minute: serial bytes, camera frames, and the truth"
"$windhover" simulate "$folder/capture.mcap" --scenario follow --duration 30 --seed 1
echo
echo "== the capture through the pipeline, with the log an operator would tail"
"$windhover" replay "$folder/capture.mcap" --out "$folder/flight.mcap" --log
echo
echo "== how far the estimates are from the truth"
"$windhover" report "$folder/flight.mcap" --truth "$folder/capture.truth.csv" --out "$folder/report.html"
"$windhover" export "$folder/flight.mcap" --format csv --out "$folder/tables"
echo
echo "Open $folder/report.html in a browser; $folder/flight.mcap opens in Foxglove."
