#!/usr/bin/env bash
# Records the simulated cell: the nodes run as processes and talk over DDS, as they would with a real arm.
# The arm's bodies are displaced, and its elbow's gear errs 101 times a turn by 0.2 mrad; no file of the bag says so.
# Six of the stations are visited twice, so that the noise floor is known.
# Usage: examples/record_cell.sh FOLDER [STATIONS]     after `make build`
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=$(realpath -m "${1:?give the folder of the bag}")
stations=${2:-96}
set +u  # what colcon writes reads variables that may not be set
source env.bash
set -u
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-42}
nodes=ros2_ws/install/modcal_nodes/lib/modcal_nodes

"$nodes/recorder" --ros-args -p out:="$out" &
recorder=$!
"$nodes/simulated_cell" --ros-args -p urdf:=examples/robots/ur10.urdf -p stations:="$stations" -p start_delay_s:=3.0 \
    -p joint_rate_hz:=40.0 -p tracker_rate_hz:=20.0 -p dwell_s:=0.75 -p travel_s:=0.4 \
    -p gear_joint:=elbow_joint &
cell=$!
trap 'kill $cell $recorder 2>/dev/null || true' EXIT
sleep "$(python -c "print(12 + 1.15 * ($stations + 6))")"
kill $cell && wait $cell || true
kill $recorder && wait $recorder
trap - EXIT
