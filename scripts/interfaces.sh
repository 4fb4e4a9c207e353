#!/usr/bin/env bash
# Builds modcal_interfaces into ros2_ws/install, from wheels of ROS, when something that the build reads has changed. The
# generators stand in an environment of their own, .venv-interfaces, for they need another empy than colcon's and are
# needed by nothing else. `interfaces.sh --check` only says whether compiler and cmake are there.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

die() {
    printf 'modcal interfaces: %s\n' "$*" >&2
    exit 1
}

lock=requirements-interfaces.txt
venv=$PWD/.venv-interfaces
prefix=$PWD/ros2_ws/install/modcal_interfaces

for tool in cmake make c++ cc; do
    command -v $tool >/dev/null || die "$tool: not found: sudo apt-get install -y cmake make g++ python3-dev (make demo needs none)"
done
[ "${1:-}" != --check ] || exit 0

python=$(.venv/bin/python -c 'import sys; print(sys._base_executable)')
inputs=$({
    echo "$PWD" && "$python" --version && sha256sum $lock "${BASH_SOURCE[0]}"
    find ros2_ws/src/modcal_interfaces -type f -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
})
# Where Python in .venv finds the package, and ROS its libraries, without anything being sourced.
link() {
    ln -sfn "$prefix"/lib/*.so .venv/lib/
    ln -sfn "$prefix"/lib/python3*/site-packages/modcal_interfaces .venv/lib/python3*/site-packages/
}

if [ "$inputs" = "$(cat "$prefix/built-from" 2>/dev/null)" ]; then
    link
    exit 0
fi

headers=$("$python" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')
[ -f "$headers/Python.h" ] || die "$headers/Python.h: not found: sudo apt-get install -y python3-dev"

# Another Python than before has other wheels.
if ! cmp -s <("$python" --version && cat $lock) "$venv/made-from"; then
    echo "modcal interfaces: installing $(grep -c == $lock) pinned packages in .venv-interfaces"
    rm -rf "$venv"
    "$python" -m venv --without-pip "$venv"
    pip=".venv/bin/python -m pip --python $venv/bin/python install -qq --no-deps --no-compile --no-input --disable-pip-version-check"
    # What comes as source is built with the pinned setuptools, not with the newest of the day.
    awk '/^setuptools==/ {on = 1} on {print} on && !/\\$/ {exit}' $lock >"$venv/first.txt"
    $pip -r "$venv/first.txt" && $pip --use-pep517 --no-build-isolation -r $lock || die "$lock: pip failed: see the lines above"
    # The wheels' cmake files name the Python of the machine that built them.
    numpy=$("$venv/bin/python" -c 'import numpy; print(numpy.get_include())')
    grep -rlI --include='*.cmake' /opt/python/cp3 "$venv/share" | xargs -r sed -i -E \
        -e "s#/opt/python/cp[^;\"]*/numpy/_?core/include#$numpy#g" -e "s#/opt/python/cp[^;\"]*/include/python3[.0-9]*#$headers#g"
    { "$python" --version && cat $lock; } >"$venv/made-from"
fi

echo "modcal interfaces: building"
rm -rf ros2_ws/build/modcal_interfaces "$prefix"
options=(-DPython3_EXECUTABLE="$venv/bin/python" -DBUILD_TESTING=OFF
    -DCMAKE_UNITY_BUILD=ON -DCMAKE_UNITY_BUILD_BATCH_SIZE=50) # a tenth of the compiler's time
colcon=$PWD/.venv/bin/python
if ! output=$(cd ros2_ws && env -u PYTHONPATH -u LD_LIBRARY_PATH -u _ROS_WHEELS_BOOTSTRAP_COMPLETE PATH="$venv/bin:$PATH" \
    AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" VIRTUAL_ENV="$venv" \
    "$colcon" -m colcon build --base-paths src/modcal_interfaces --cmake-args "${options[@]}" 2>&1); then
    printf '%s\n' "$output" >&2
    die "the build failed: the lines above say where; ros2_ws/log has the rest"
fi
link
printf '%s\n' "$inputs" >"$prefix/built-from"
echo "modcal interfaces: in ros2_ws/install/modcal_interfaces"
