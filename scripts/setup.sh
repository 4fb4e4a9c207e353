#!/usr/bin/env bash
# Brings .venv up to the lock: creates it, installs the pinned requirements, makes the workspace importable from it.
# Usage: scripts/setup.sh [--test]. Quick and silent when nothing has changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
case "${1:-}" in
    "") locks=(requirements.txt) modules="rclpy mujoco rosbags scipy" ;;
    --test) locks=(requirements.txt requirements-test.txt) modules="rclpy mujoco rosbags scipy pinocchio" ;;
    *) echo "usage: scripts/setup.sh [--test]" >&2 && exit 2 ;;
esac

die() {
    printf 'modcal setup: %s\n' "$*" >&2
    exit 1
}

# A name on PATH proves nothing (a version manager leaves shims that fail), so the interpreter is run.
usable() {
    "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null
}

version() {
    "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])'
}

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.12 python3.11 python3}; do
        if usable "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    die "${PYTHON:-python3}: not a working Python 3.11 or 3.12 with venv:" \
        "sudo apt-get install -y python3 python3-venv, or name another with PYTHON="
}

# A .venv that is half made, or made by another Python than the one asked for, is made anew.
if [ -e $venv ] && ! { usable $venv/bin/python && [ -x $venv/bin/pip ]; }; then
    rm -rf $venv
elif [ -e $venv ] && [ -n "${PYTHON:-}" ]; then
    python=$(find_python)
    [ "$(version $venv/bin/python)" = "$(version "$python")" ] || rm -rf $venv
fi
if [ ! -e $venv ]; then
    python=$(find_python)
    echo "modcal setup: creating $venv with Python $(version "$python")"
    "$python" -m venv $venv
fi

# The stamps are copies of the installed locks: contents decide, since a checkout does not keep times.
if ! cmp -s <(cat "${locks[@]}") <(cd $venv && cat "${locks[@]}" 2>/dev/null); then
    echo "modcal setup: installing $(cat "${locks[@]}" | grep -c '==') pinned packages"
    pip="$venv/bin/python -m pip install -qq --no-deps --no-compile --no-input --disable-pip-version-check"
    # Two packages come as source: they are built with the pinned setuptools, not with the newest of the day.
    awk '/^setuptools==/ {on = 1} on {print} on && !/\\$/ {exit}' requirements.txt >$venv/first.txt # with its hashes
    $pip -r $venv/first.txt &&
        $pip --use-pep517 --no-build-isolation "${locks[@]/#/-r}" || die "${locks[*]}: pip failed: see the lines above"
    for module in $modules; do
        $venv/bin/python -c "import $module" || die "$module: a system library is missing:" \
            "sudo apt-get install -y libgomp1 libstdc++6 zlib1g"
    done
    # At once and on all cores, and also where Python is told to keep no bytecode: every start would compile NumPy anew.
    $venv/bin/python -m compileall -qq -j 0 $venv/lib || true # what is of another Python's time stays as it is
    cp "${locks[@]}" $venv/
fi

# Python in .venv sees the sources without anything being sourced; the build folders give the packages' metadata.
for package in modcal_core modcal_msgs_py modcal_nodes; do
    echo "../../../../ros2_ws/src/$package"
    echo "../../../../ros2_ws/build/$package"
done >"$(echo $venv/lib/python3*/site-packages)/modcal_workspace.pth"
install -m 755 scripts/modcal.sh $venv/bin/modcal
