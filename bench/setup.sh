#!/usr/bin/env bash
# Brings .venv-bench up to bench/requirements.txt, an environment for every peer: one that cannot be installed is left out,
# and the table says so. Quick and silent when nothing has changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

folder=.venv-bench
stamp=$folder/requirements.txt
if cmp -s bench/requirements.txt $stamp; then
    exit 0
fi
rm -rf $folder
grep -v '^#' bench/requirements.txt | while read -r -a wanted; do
    venv=$folder/${wanted[0]%%==*}
    echo "modcal bench: installing ${wanted[0]}"
    .venv/bin/python -m venv --without-pip "$venv"
    # what is not there after five minutes is not waited for
    if ! timeout 300 .venv/bin/python -m pip --python "$venv/bin/python" install -q --no-input --no-compile \
        --disable-pip-version-check "${wanted[@]}" >/dev/null 2>&1; then
        echo "modcal bench: ${wanted[0]} cannot be installed here, and is left out"
        rm -rf "$venv"
    fi
done
cp bench/requirements.txt $stamp
