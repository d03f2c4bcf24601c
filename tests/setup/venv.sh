#!/bin/sh
# A Python environment of the tests' own: venv.sh DIR REQUIREMENTS. Does nothing when up to date.
set -eu
venv="$1"
wanted="$2"
stamp="$venv/requirements.txt"
cmp -s "$wanted" "$stamp" 2>/dev/null && exit 0
echo "installing Python packages for tests into $venv"
rm -rf "$venv"
python3 -m venv "$venv"
"$venv/bin/pip" install -q --disable-pip-version-check -r "$wanted"
cp "$wanted" "$stamp"
