#!/usr/bin/env bash
# Builds the Python packages with the colcon of .venv, from scratch, when anything that the build reads has changed.
# Modules are linked, not copied, so changing one needs no build; adding an executable, a config or a launch file does.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../ros2_ws"

python=$(realpath -s ../.venv/bin/python)
stamp=install/built-from
inputs=$({
    echo "$python" && "$python" --version
    find src/modcal_{core,msgs_py,nodes} -type f \( -name package.xml -o -name 'setup.*' -o -path '*/resource/*' \
        -o -path '*/bin/*' -o -path 'src/*/config/*' -o -path 'src/*/launch/*' -o -path 'src/*/robots/*' \) -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
})
if [ "$inputs" = "$(cat $stamp 2>/dev/null)" ]; then
    exit 0
fi

rm -rf {build,install}/modcal_{core,msgs_py,nodes} log # what interfaces.sh has built stays
# Packages that are found through AMENT_PREFIX_PATH stand in the environment itself.
if ! output=$(AMENT_PREFIX_PATH=$(realpath -s ../.venv) "$python" -m colcon build --symlink-install \
    --base-paths src/modcal_{core,msgs_py,nodes} 2>&1); then
    printf '%s\n' "$output" >&2
    echo "modcal build: colcon failed: the lines above say where; ros2_ws/log has the rest" >&2
    exit 1
fi
printf '%s\n' "$inputs" >$stamp
echo "modcal build: 3 packages in ros2_ws/install"
