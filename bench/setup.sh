#!/usr/bin/env bash
# Brings .venv-bench up to bench/requirements.txt, each peer by itself: one that cannot be installed is left out, and the
# table says so. Quick and silent when nothing has changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv-bench
stamp=$venv/requirements.txt
if cmp -s bench/requirements.txt $stamp; then
    exit 0
fi
[ -x $venv/bin/python ] || .venv/bin/python -m venv $venv
grep -v '^#' bench/requirements.txt | while read -r peer; do
    echo "modcal bench: installing $peer"
    # what is not there after five minutes is not waited for
    timeout 300 $venv/bin/python -m pip install -q --no-input --no-compile --disable-pip-version-check "$peer" \
        >/dev/null 2>&1 || echo "modcal bench: $peer cannot be installed here, and is left out"
done
cp bench/requirements.txt $stamp
