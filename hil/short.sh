#!/bin/sh
# The short set as a check that may be run anywhere: what a machine lacks for it is said, and nothing is flown;
# a machine too busy to get through in a quarter of an hour says nothing of the daemon, and that is said too.
# What fails is flown once more on a new machine, and both are told: only what fails twice refuses.
set -eu
cd "$(dirname "$0")/.."
skip() {
    echo "hil-short: SKIPPED, $1"
    exit 0
}
ends=$(($(date +%s) + 900))
# Runs a command in what is left of the quarter of an hour.
within() {
    left=$((ends - $(date +%s)))
    [ "$left" -gt 0 ] || skip "not through in 15 minutes"
    result=0
    timeout --kill-after=20 "$left" "$@" || result=$?
    [ "$result" != 124 ] && [ "$result" != 137 ] || skip "not through in 15 minutes"
    return "$result"
}
[ "$(id -u)" = 0 ] || skip "nothing was flown: making the image takes root"
command -v apt-get >/dev/null || skip "nothing was flown: the image is made of Debian's packages"
within make hil-tools && within sh hil/base.sh target/hil || skip "nothing was flown: Debian's packages are not to be had"
# What feeds the machine is there from the tests.
within cargo build --locked --example hil_feed --example hil_frames --example hil_stream
set -- hil SCENARIOS="cold_boot unplug landing" PARTS="--bin windhover" TOOLS=target/debug/examples
within make "$@" && exit 0
echo "hil-short: FAILED once; flown once more on a new machine"
within make "$@"
