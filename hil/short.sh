#!/bin/sh
# The short set as a check that may be run anywhere: what a machine lacks for it is said, and nothing is flown.
# Builds come first and take what they take; a machine too busy to fly through in a quarter of an hour after them says
# nothing of the daemon, and that is said too. What fails is flown once more on a new machine, and both are shown: only
# what fails twice refuses.
set -eu
cd "$(dirname "$0")/.."
skip() {
    sh .ci/skip hil-short "$1"
    exit 0
}
[ "$(id -u)" = 0 ] || skip "nothing was flown: making the image takes root"
command -v apt-get >/dev/null || skip "nothing was flown: the image is made of Debian's packages"
make hil-tools && sh hil/base.sh target/hil || skip "nothing was flown: Debian's packages are not to be had"
# What feeds the machine is there from the tests.
make debug
make deb PARTS="--bin windhover"
sh hil/image.sh

ends=$(($(date +%s) + 900))
# Flies the set in what is left of the quarter of an hour.
fly() {
    left=$((ends - $(date +%s)))
    [ "$left" -gt 0 ] || skip "not flown through in 15 minutes"
    result=0
    timeout --kill-after=20 "$left" python3 hil/bench.py --tools target/debug/examples cold_boot unplug landing ||
        result=$?
    [ "$result" != 124 ] && [ "$result" != 137 ] || skip "not flown through in 15 minutes"
    return "$result"
}
# Whether the last five minutes were so busy that an emulated machine falls behind whatever it runs: of a load of three a
# processor the emulator itself makes one.
busy() { awk -v processors="$(nproc)" '{ exit !($2 > 3 * processors) }' /proc/loadavg; }
fly && exit 0
echo "hil-short: FAILED once; flown once more on a new machine"
fly && exit 0
! busy || skip "FAILED twice, on a machine too busy to say anything (load $(cut -d ' ' -f 2 /proc/loadavg))"
exit 1
