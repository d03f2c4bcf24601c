#!/bin/sh
# A Python environment of the tests' own: venv.sh DIR REQUIREMENTS [each]. Does nothing when up to date. With `each` it takes
# what it can get: a package that cannot be had is said, and tried again the next time.
set -eu
venv="$1"
wanted="$2"
stamp="$venv/requirements.txt"
cmp -s "$wanted" "$stamp" 2>/dev/null && exit 0
echo "installing Python packages for tests into $venv"
rm -rf "$venv"
python3 -m venv "$venv"
pip() { "$venv/bin/pip" install -q --disable-pip-version-check "$@"; }
if [ "${3:-}" = each ] && ! pip -r "$wanted"; then
    complete=yes
    while read -r package; do
        pip "$package" || { sh .ci/skip "$package" "pip cannot install it here"; complete=no; }
    done < "$wanted"
    [ "$complete" = yes ] || exit 0
elif [ "${3:-}" != each ]; then
    pip -r "$wanted"
fi
cp "$wanted" "$stamp"
