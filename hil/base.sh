#!/bin/sh
# Debian from its packages, as an archive that is made once: prints its path.
#   hil/base.sh DIRECTORY
set -eu
suite=${SUITE:-bookworm}
packages=linux-image-amd64,systemd,systemd-sysv,udev,kmod,v4l-utils,iproute2,dbus,dmsetup,e2fsprogs
base="$1/base-$suite-$(echo "$packages" | sha256sum | cut -c1-8).tar"
if [ ! -f "$base" ]; then
    echo "== Debian $suite" >&2
    mkdir -p "$1"
    mmdebstrap --quiet --format=tar --variant=minbase --include="$packages" "$suite" "$base.part" >&2
    mv "$base.part" "$base"
fi
echo "$base"
