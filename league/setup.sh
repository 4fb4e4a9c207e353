#!/usr/bin/env bash
# Brings the environments of the league up to their pins, .venv-league/NAME from league/requirements/NAME.txt. Quick and
# silent where nothing has changed. One that cannot be installed is named, and its methods are left out.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

for python in ${PYTHON:-python3.12 python3.11 python3}; do
    "$python" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null && break
done
for pins in league/requirements/*.txt; do
    venv=.venv-league/$(basename "$pins" .txt)
    cmp -s "$pins" "$venv/pins.txt" && continue
    echo "league: installing $(basename "$venv")"
    rm -rf "$venv"
    "$python" -m venv --without-pip "$venv"
    pip=("$python" -m pip --python "$venv/bin/python" --disable-pip-version-check)
    if "${pip[@]}" install -qq --no-deps --no-compile --no-input -r "$pins"; then
        cp "$pins" "$venv/pins.txt"
    else
        echo "league: $(basename "$venv") cannot be installed here, and its methods are left out" >&2
        rm -rf "$venv"
        [ "$(basename "$venv")" != common ] || exit 1
    fi
done
