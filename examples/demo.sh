#!/usr/bin/env bash
# The main job on a recording that comes with the repository: from a bag to a corrected model, and the proof.
# The bag was recorded with examples/record_cell.sh from a MuJoCo arm whose bodies are displaced by about 1 mm and 1 mrad
# and whose elbow has an unmodelled gear error.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${1:-demo}
.venv/bin/modcal info bags/ur10_cell
echo
.venv/bin/modcal calibrate bags/ur10_cell --out "$out"
