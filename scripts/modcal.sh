#!/bin/sh
# Stands in .venv/bin/modcal. Runs the command of this checkout, whatever else is sourced in the shell: another ROS on
# PYTHONPATH or LD_LIBRARY_PATH would otherwise be loaded in place of the one in .venv.
venv=$(readlink -f -- "$0")
venv=${venv%/*/*}
install=${venv%/*}/ros2_ws/install
unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
if [ ! -x "$install/modcal_nodes/lib/modcal_nodes/modcal" ]; then
    echo "modcal: $install is not built: run make build" >&2
    exit 1
fi
AMENT_PREFIX_PATH=$install/modcal_nodes:$install/modcal_msgs_py:$install/modcal_core:$venv
export AMENT_PREFIX_PATH
# Where ROS's wheels keep their libraries. They would set this themselves by starting Python a second time.
LD_LIBRARY_PATH=$venv/lib
for libraries in "$venv"/lib/python3*/site-packages/ros_*.libs; do
    LD_LIBRARY_PATH=$LD_LIBRARY_PATH:$libraries
done
_ROS_WHEELS_BOOTSTRAP_COMPLETE=1
export LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Not by the installed script, which looks its entry point up among all packages first.
exec "$venv/bin/python" -c "from modcal_nodes.cli.main import main; main()" "$@"
