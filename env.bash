# source env.bash
# A shell for this checkout after `make build`: `modcal`, `python` and the nodes work in it. A node is a command of its name,
# `calibrator --help`, since ROS from wheels has no `ros2 run`. Where ROS itself comes from apt, this file is not needed:
# source /opt/ros/jazzy/setup.bash, build with colcon, and source ros2_ws/install/setup.bash as with any workspace.

_modcal_root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
if [ -f "$_modcal_root/ros2_ws/install/setup.bash" ]; then
    # Another ROS that is sourced would be loaded in place of the one in .venv.
    unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
    # colcon's set-up adds the workspace; the packages that came as wheels are found only through this line.
    export AMENT_PREFIX_PATH=$_modcal_root/.venv
    source "$_modcal_root/ros2_ws/install/setup.bash"
    # The nodes last, so that names as common as `recorder` hide nothing.
    export PATH=$_modcal_root/.venv/bin:$PATH:$_modcal_root/ros2_ws/install/modcal_nodes/lib/modcal_nodes
    unset _modcal_root
else
    echo "env.bash: $_modcal_root/ros2_ws/install is not built: run make build first" >&2
    unset _modcal_root
    return 1
fi
