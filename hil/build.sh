#!/usr/bin/env bash
# Builds the virtual payload computer: Debian from its packages, our package installed as a user would,
# a read-only root image and an empty data card. What is there already is not built again.
#   hil/build.sh WINDHOVER.deb WINDHOVER [DIRECTORY]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
deb=$(realpath "$1")
windhover=$(realpath "$2")
out=$(realpath -m "${3:-target/hil}")
mkdir -p "$out"

if [ "$(id -u)" != 0 ]; then
    echo "hil/build.sh: run as root (it makes device nodes and file owners for the image)" >&2
    exit 1
fi

base=$(sh "$here/base.sh" "$out")
root="$out/root"
rm -rf "$root"
mkdir "$root"
tar -xf "$base" -C "$root"

echo "== apt install ./$(basename "$deb")"
cp "$deb" "$root/tmp/windhover.deb"
chroot "$root" apt-get install -y --no-install-recommends -o Dpkg::Use-Pty=0 /tmp/windhover.deb >"$out/apt.log" 2>&1 ||
    { cat "$out/apt.log" >&2; exit 1; }
rm "$root/tmp/windhover.deb"

# The bench's own parts: camera driver, pulse, network, control line. Nothing here touches the package's
# files but its configuration and keys, which are the user's to write.
cp -a "$here/guest/." "$root/"
chmod 755 "$root/usr/local/sbin/"*
install -m 644 "$here/windhover.toml" "$root/etc/windhover/windhover.toml"
test -f "$out/keys/authority.pem" || "$windhover" keys authority --dir "$out/keys"
test -f "$out/keys/payload-bench.pem" || "$windhover" keys payload bench --dir "$out/keys"
test -f "$out/keys/station-bench.pem" || "$windhover" keys station bench --dir "$out/keys"
cp "$out/keys/authority.pem" "$out/keys/revoked.pem" "$out"/keys/payload-bench.* "$root/etc/windhover/keys/"
chroot "$root" sh -c 'chown windhover:windhover /etc/windhover/keys/* && chmod 600 /etc/windhover/keys/*.key'
echo payload >"$root/etc/hostname"
# The card is mounted by the package's own unit.
echo '/dev/vda / ext4 ro 0 1' >"$root/etc/fstab"
chroot "$root" systemctl --quiet enable windhover.service bench-camera.service bench-control.service \
    bench-log.service bench-network.service bench-pulse.service
chroot "$root" systemctl --quiet mask serial-getty@ttyS0.service serial-getty@ttyS1.service systemd-timesyncd.service \
    apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer systemd-random-seed.service e2scrub_reap.service \
    e2scrub_all.timer fstrim.timer getty@tty1.service systemd-update-utmp.service
chroot "$root" passwd --quiet -d root

cp "$root"/boot/vmlinuz-* "$out/vmlinuz"
cp "$root"/boot/initrd.img-* "$out/initrd"
echo "== image"
rm -f "$out/root.img"
size=$(($(du -sm "$root" | cut -f1) + 200))
mkfs.ext4 -q -L root -d "$root" "$out/root.img" "${size}M"
rm -rf "$root"
ls -la "$out"
