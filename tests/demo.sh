#!/bin/sh
# A simulated flight from sensor bytes to a report, then one in real time with its page: demo.sh BINARY FOLDER [PAGE]
set -eu
windhover="$1"
folder="$2"
page="${3:-127.0.0.1:8080}"
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
# On a desktop the report opens by itself.
if [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ] && command -v xdg-open > /dev/null; then
    xdg-open "$folder/report.html" > /dev/null 2>&1 || true
fi
echo
# Somebody at a terminal can look at the page; elsewhere it is enough that it works.
if [ -t 1 ]; then seconds=180; else seconds=15; fi
echo "== the same in real time for $seconds seconds: daemon, ground station and its page (Ctrl-C ends it)"
flight="" station=""
stop() {
    # The station ends after the flight, so that it has all of it.
    for process in $flight $station; do
        kill "$process" 2> /dev/null || true
        wait "$process" 2> /dev/null || true
    done
    flight="" station=""
}
trap stop EXIT
trap 'exit 130' INT TERM
keys="$folder/live/keys"
# At a smaller scale two processors have time for the browser too.
"$windhover" simulate --live --scale 0.6 --duration "$seconds" --dir "$folder/live" > "$folder/live.log" 2>&1 &
flight=$!
until [ -s "$keys/station-demo.key" ]; do
    kill -0 "$flight" 2> /dev/null || { cat "$folder/live.log" >&2; exit 1; }
    sleep 0.1
done
"$windhover" ground --open --web "$page" --connect 127.0.0.1:7447 --out "$folder/ground" \
    --authority "$keys/authority.pem" --certificate "$keys/station-demo.pem" &
station=$!
wait "$flight" || { cat "$folder/live.log" >&2; exit 1; }
flight=""
kill -0 "$station" 2> /dev/null || { echo "the station ended early" >&2; exit 1; }
stop
tail -n 1 "$folder/live.log"
echo
echo "the report          $folder/report.html"
echo "the flight          $folder/flight.mcap, for Foxglove; as tables in $folder/tables"
echo "the live flight     on the card $folder/live/card, at the station $folder/ground; its log $folder/live.log"
echo "live once more      make demo, or $windhover simulate --live"
