#!/bin/sh
# A Rust compiler, its linter and the standard libraries of other processors out of Debian's packages, unpacked into a
# folder and not installed: rustup's compiler may have no other target, and Debian's would stand in its way. Installs GCC and
# the C library of those processors, and QEMU. cross.sh DIR ARCHITECTURE… (arm64, armhf)
set -eu
dir=$(realpath -m "$1")
shift
here=$(cd "$(dirname "$0")" && pwd)
# Standard libraries where Debian's signed list of an architecture cannot be had (a mirror that is not consistent): the
# package out of the pool, by its checksum.
known="libstd-rust-web-dev_1.96.0+dfsg1-1~deb12u2_armhf.deb b9f9dd1d03a903680f918cb2bba00a2a3d76558545d5e6a8061072ab461bb989"

# Lists of both architectures apart from the system's: dpkg need not know a second one.
lists() {
    rm -rf "$dir/apt"
    mkdir -p "$dir/apt/lists/partial" "$dir/apt/archives/partial" "$dir/root"
    cat > "$dir/apt/apt.conf" << CONF
APT::Architectures { "$(dpkg --print-architecture)"; $1 };
APT::Sandbox::User "root";
Acquire::Languages "none";
Dir::State::Lists "$dir/apt/lists";
Dir::Cache "$dir/apt";
CONF
    export APT_CONFIG="$dir/apt/apt.conf"
    cd "$dir/apt/archives"
    apt-get -q update --error-on=any
}

unpack() {
    for package in *.deb; do dpkg -x "$package" "$dir/root"; done
    cd "$dir"
    unset APT_CONFIG
    rm -rf "$dir/apt"
}

# The name of what PACKAGE depends on that begins so.
depends() { apt-cache depends --important "$1" | sed -n "s/^ *Depends: \($2[0-9.]*\)$/\1/p" | head -n 1; }

compiler() {
    echo "unpacking Debian's Rust into $dir"
    lists ""
    compiler=$(depends libstd-rust-web-dev libstd-rust-web-)
    apt-get -q download rustc-web rust-web-clippy "$compiler" libstd-rust-web-dev "$(depends "$compiler" libllvm)"
    apt-cache show --no-all-versions libstd-rust-web-dev | sed -n 's/^Version: //p' > "$dir/version"
    unpack
}

library() {
    echo "unpacking Debian's standard library of Rust for $1 into $dir"
    version=$(cat "$dir/version")
    if lists "\"$1\";"; then
        apt-get -q download "libstd-rust-web-dev:$1=$version"
    else
        file=libstd-rust-web-dev_${version}_$1.deb
        sum=$(echo "$known" | sed -n "s/^$file //p")
        [ -n "$sum" ] || { echo "Debian's list of packages for $1 cannot be had here" >&2; exit 1; }
        echo "Debian's list of packages for $1 cannot be had here: $file by its checksum"
        /usr/lib/apt/apt-helper -q download-file "http://deb.debian.org/debian-security/pool/updates/main/r/rustc-web/$file" "$file" "SHA256:$sum"
    fi
    unpack
}

[ -f "$dir/compiler" ] || { rm -rf "$dir/root"; compiler; touch "$dir/compiler"; }
for arch in "$@"; do
    case $arch in
    arm64) sh "$here/packages.sh" gcc-aarch64-linux-gnu g++-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user ;;
    armhf) sh "$here/packages.sh" gcc-arm-linux-gnueabihf g++-arm-linux-gnueabihf libc6-dev-armhf-cross qemu-user ;;
    esac
    [ -f "$dir/$arch" ] || { library "$arch"; touch "$dir/$arch"; }
done
