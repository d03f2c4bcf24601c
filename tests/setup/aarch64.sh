#!/bin/sh
# A Rust compiler, its linter and the standard library for aarch64 out of Debian's packages, unpacked into a folder and
# not installed: rustup's compiler may have no other target, and Debian's would stand in its way. aarch64.sh DIR
set -eu
dir=$(realpath -m "$1")
here=$(cd "$(dirname "$0")" && pwd)
sh "$here/packages.sh" gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user
[ ! -f "$dir/complete" ] || exit 0

echo "unpacking Debian's Rust for aarch64 into $dir"
rm -rf "$dir"
mkdir -p "$dir/apt/lists/partial" "$dir/apt/archives/partial" "$dir/root"
# Lists of both architectures apart from the system's: dpkg need not know a second one.
cat > "$dir/apt/apt.conf" << CONF
APT::Architectures { "$(dpkg --print-architecture)"; "arm64"; };
APT::Sandbox::User "root";
Acquire::Languages "none";
Dir::State::Lists "$dir/apt/lists";
Dir::Cache "$dir/apt";
CONF
export APT_CONFIG="$dir/apt/apt.conf"
cd "$dir/apt/archives"
apt-get -q update
# The name of what PACKAGE depends on that begins so.
depends() { apt-cache depends --important "$1" | sed -n "s/^ *Depends: \($2[0-9.]*\)$/\1/p" | head -n 1; }
compiler=$(depends libstd-rust-web-dev libstd-rust-web-)
apt-get -q download rustc-web rust-web-clippy "$compiler" libstd-rust-web-dev libstd-rust-web-dev:arm64 \
    "$(depends "$compiler" libllvm)"
for package in *.deb; do dpkg -x "$package" "$dir/root"; done
rm -rf "$dir/apt"
touch "$dir/complete"
