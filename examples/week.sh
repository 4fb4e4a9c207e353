#!/usr/bin/env bash
# A week in the life of a cell, in MuJoCo: measured on Monday, checked on Tuesday, its tool bumped on Wednesday, repaired on
# Thursday, and proved on Friday. The arm's bodies are displaced by about 1 mm and 1 mrad, and its elbow has a gear error.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${1:-week}
robot=examples/robots/ur10.urdf
cell=(-p seed=7 -p gear_joint=elbow_joint -p gear_amplitude_rad=2e-4)
bump=(-p "tool_bump_m=[3e-4, -2e-4, 2e-4]")
rm -rf "$out"
mkdir -p "$out/robot"
monday=$out/robot/2026-03-02_monday
wednesday=$out/robot/2026-03-04_wednesday

echo "== Monday: measure until 0.1 mm is proven"
.venv/bin/modcal measure "$robot" --simulated --goal-mm 0.1 "${cell[@]}" --out "$monday"

echo && echo "== Tuesday: ten stations, nothing has happened"
.venv/bin/modcal simulate "$robot" "${cell[@]}" -p visit=2 -p stations=10 --returns 0 --out "$out/tuesday_bag"
.venv/bin/modcal check "$monday" "$out/tuesday_bag" --out "$out/robot/2026-03-03_tuesday"

echo && echo "== Wednesday: something bumps into the tool; ten stations"
.venv/bin/modcal simulate "$robot" "${cell[@]}" "${bump[@]}" -p visit=3 -p stations=10 --returns 0 --out "$out/wednesday_bag"
.venv/bin/modcal check "$monday" "$out/wednesday_bag" --tolerance-mm 0.2 --out "$wednesday"

echo && echo "== Thursday: the repaired model is used; ten stations find nothing more"
.venv/bin/modcal simulate "$robot" "${cell[@]}" "${bump[@]}" -p visit=4 -p stations=10 --returns 0 --out "$out/thursday_bag"
.venv/bin/modcal check "$wednesday" "$out/thursday_bag" --out "$out/robot/2026-03-05_thursday"

echo && echo "== Friday: forty stations, by Monday's model and by the repaired one"
.venv/bin/modcal simulate "$robot" "${cell[@]}" "${bump[@]}" -p visit=5 -p stations=40 --out "$out/friday_bag"
.venv/bin/modcal evaluate "$monday" "$out/friday_bag" --out "$out/friday_old" | sed -n "2p;5p"
.venv/bin/modcal evaluate "$wednesday" "$out/friday_bag" --tolerance-mm 0.2 --out "$out/friday" | sed -n "2p;5p;/^PASS/p"

echo && echo "== The week, as a history"
.venv/bin/modcal history "$out/robot"
