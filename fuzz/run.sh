#!/bin/sh
# Runs each fuzz target for SECONDS, all of them or those that are named: run.sh SECONDS [TARGET…]. Needs cargo-fuzz in the path. The
# stable compiler builds them, optimised a little: twice as soon as a release build, with checks of overflows. A target that fails does
# not stop the others; its input is in fuzz/artifacts.
set -eu
cd "$(dirname "$0")/.."
seconds=$1
shift
export RUSTC_BOOTSTRAP=1 CARGO_PROFILE_RELEASE_OPT_LEVEL=1 CARGO_PROFILE_RELEASE_DEBUG=false
[ $# -gt 0 ] || set -- $(sed -n 's/^name = "\(.*\)"/\1/p' fuzz/Cargo.toml | tail -n +2)
python3 fuzz/seeds.py fuzz/corpus
cargo fuzz build -s none
mkdir -p fuzz/artifacts
failed=""
for target in "$@"; do
    echo "== $target"
    cargo fuzz run -s none "$target" -- -max_total_time="$seconds" -rss_limit_mb=2000 -timeout=10 -max_len=65536 -print_final_stats=1 \
        > "fuzz/artifacts/$target.log" 2>&1 || failed="$failed $target"
    grep -E '^(Done|stat::number_of_executed_units|stat::peak_rss_mb|SUMMARY|.*panicked at)' "fuzz/artifacts/$target.log" || true
done
[ -z "$failed" ] || { echo "failed:$failed (fuzz/artifacts)" >&2; exit 1; }
