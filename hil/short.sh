#!/bin/sh
# The short set as a check that may be run anywhere: what a machine lacks for it is said, and nothing is flown;
# a machine too busy to get through in a quarter of an hour says nothing of the daemon, and that is said too.
set -eu
cd "$(dirname "$0")/.."
skip() {
    echo "hil-short: SKIPPED, nothing was flown: $1"
    exit 0
}
[ "$(id -u)" = 0 ] || skip "making the image takes root"
command -v apt-get >/dev/null || skip "the image is made of Debian's packages"
result=0
timeout --kill-after=20 900 make hil SCENARIOS="cold_boot unplug landing" || result=$?
[ "$result" != 124 ] || skip "not through in 15 minutes"
exit "$result"
