#!/usr/bin/env bash
# Builds dist/modcal-*.whl from a copy of what git knows and of what is new, so that nothing stays behind in the checkout
# and nothing that was built before gets in. Usage: scripts/wheel.sh [FOLDER].
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

out=$(realpath -m "${1:-dist}")
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT
packages=(ros2_ws/src/modcal_core ros2_ws/src/modcal_msgs_py ros2_ws/src/modcal_nodes)
tar --exclude=__pycache__ --exclude='*.egg-info' --exclude=build -cf - pyproject.toml README.md LICENSE examples bags "${packages[@]}" | tar -xf - -C "$copy"
rm -rf "$out"/modcal-*.whl
if ! said=$(.venv/bin/python -m pip wheel --quiet --no-deps --no-build-isolation --no-index --disable-pip-version-check --wheel-dir "$out" "$copy" 2>&1); then
    printf '%s\n' "$said" >&2
    echo "modcal wheel: pip failed: the lines above say where" >&2
    exit 1
fi
echo "modcal wheel: $(ls "$out"/modcal-*.whl)"
