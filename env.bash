# source env.bash
# A shell for this checkout after `make build`: `modcal`, `python` and the nodes in
# ros2_ws/install/modcal_nodes/lib/modcal_nodes work in it. Where ROS itself comes from apt, this file is not needed:
# source /opt/ros/jazzy/setup.bash, build with colcon, and source ros2_ws/install/setup.bash as with any workspace.

_modcal_root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
if [ -f "$_modcal_root/ros2_ws/install/setup.bash" ]; then
    # Another ROS that is sourced would be loaded in place of the one in .venv.
    unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
    # colcon's set-up adds the workspace; the packages that came as wheels are found only through this line.
    export AMENT_PREFIX_PATH=$_modcal_root/.venv
    export PATH=$_modcal_root/.venv/bin:$PATH
    source "$_modcal_root/ros2_ws/install/setup.bash"
    unset _modcal_root
else
    echo "env.bash: $_modcal_root/ros2_ws/install is not built: run make build first" >&2
    unset _modcal_root
    return 1
fi
