# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
# Sourced by every script: creates or updates the local environment .venv, and sets $PYTHON.
# Requires Python 3.11 to 3.14 and a package index; a system ROS is neither required nor used.
# $ROOT is the folder of the checkout: the scripts resolve a symlink to themselves before.

set -euo pipefail

ROOT="$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
PYTHON="$VENV/bin/python"
LOG="$ROOT/.venv.log"

say() { printf '%s\n' "$*" >&2; }
fail() {
  say "error: $1"
  say "remedy: $2"
  exit 1
}

usable() {
  "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' >/dev/null 2>&1
}

# Print the origin of .venv for Python $1: location, interpreter, version. A change recreates .venv.
origin_of() {
  printf '%s ' "$ROOT"
  "$1" -c 'import sys; from os.path import realpath as r; print(r(sys.base_prefix), *sys.version_info[:2])' 2>/dev/null
}

choose_python() {
  local candidate found=''
  if [ -n "${T3MPC_PYTHON:-}" ]; then
    if usable "$T3MPC_PYTHON"; then
      printf '%s\n' "$T3MPC_PYTHON"
      return
    fi
    fail "T3MPC_PYTHON=$T3MPC_PYTHON is not a Python from 3.11 to 3.14 ($(version_of "$T3MPC_PYTHON"))" \
      "set it to another Python, T3MPC_PYTHON=/usr/bin/python3.12 for example, or unset it"
  fi
  # The Python of an existing .venv remains in use without T3MPC_PYTHON.
  if [ -x "$PYTHON" ] && [ "$(origin_of "$PYTHON")" = "$(cat "$VENV/origin" 2>/dev/null)" ]; then
    printf '%s\n' "$PYTHON"
    return
  fi
  for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
    # Skip the Python of .venv itself: it may be deleted below.
    candidate="$(PATH="${PATH//"$VENV/bin:"/}" command -v "$candidate")" || continue
    if usable "$candidate"; then
      printf '%s\n' "$candidate"
      return
    fi
    found="${found:+$found, }$candidate ($(version_of "$candidate"))"
  done
  fail "no Python from 3.11 to 3.14 was found on PATH; found: ${found:-none at all}" \
    "install python3.11 or newer with its venv module, or name one: T3MPC_PYTHON=/usr/bin/python3.12 $0"
}

version_of() {
  if command -v "$1" >/dev/null; then "$1" --version 2>&1 | tail -n 1 || true; else echo 'not found'; fi
}

# Print the hash of everything that determines the content of the environment.
wanted_stamp() {
  {
    origin_of "$BASE_PYTHON"
    cat "$ROOT"/{requirements*.txt,setup.py,setup.cfg,package.xml,t3mpc_ros/__init__.py} \
      "$ROOT"/{config/*.*,launch/*.launch.py}
  } | sha256sum | cut -d' ' -f1
}

is_current() { [ "$(cat "$VENV/stamp" 2>/dev/null)" = "$(wanted_stamp)" ]; }

# Run a command of the set-up with its output in the log, and show that it takes time.
CHILD=''
run() {
  local code=0 tenths=0
  # A session of its own: a signal to the script ends everything that the command has started.
  setsid "$@" >>"$LOG" 2>&1 9>&- &
  CHILD=$!
  while kill -0 "$CHILD" 2>/dev/null; do
    sleep 0.2
    tenths=$((tenths + 2))
    if ((tenths % 100 == 0)); then say "    $((tenths / 10)) s"; fi
  done
  wait "$CHILD" || code=$?
  CHILD=''
  return "$code"
}

stop_set_up() {
  if [ -n "$CHILD" ]; then
    kill -TERM -- "-$CHILD" 2>/dev/null || true
    sleep 0.5
    kill -KILL -- "-$CHILD" 2>/dev/null || true
    wait "$CHILD" 2>/dev/null || true
  fi
  say 'stopped; run the script again to complete the set-up'
  exit "$1"
}

make_environment() {
  local origin
  rm -f "$VENV/stamp"
  : >"$LOG"
  origin="$(origin_of "$BASE_PYTHON")"
  if [ "$(cat "$VENV/origin" 2>/dev/null)" = "$origin" ]; then
    say "updating the local environment .venv (log: $LOG)"
  else
    say "creating the local environment .venv (once, about a minute; log: $LOG)"
    run "$BASE_PYTHON" -m venv --clear "$VENV" ||
      fail "the environment could not be created with $BASE_PYTHON: $(tail -n 1 "$LOG")" \
        "install Python's venv module (Debian and Ubuntu: apt install python3-venv), then run $0 again"
    printf '%s\n' "$origin" >"$VENV/origin"
  fi
  say "  installing ROS 2 Jazzy and the libraries from the package index"
  if ! run "$PYTHON" -m pip install --disable-pip-version-check \
    -r "$ROOT/requirements.txt" -r "$ROOT/requirements-dev.txt"; then
    say "$(grep -iE 'error|could not|no matching' "$LOG" | tail -n 3)"
    fail "the libraries could not be installed with $("$PYTHON" --version) on $(uname -sm)" \
      "check the network and the package index (\"$PYTHON -m pip config list\"; proxies: HTTPS_PROXY), then run $0 again; the wheels of ROS 2 exist for Linux on x86_64"
  fi
  say "  installing t3mpc_ros"
  # The files of an earlier pip install would hide new executables.
  run "$PYTHON" -m pip uninstall --disable-pip-version-check -q -y t3mpc_ros || true
  # develop installs the executables into lib/t3mpc_ros, the folder that ros2 run searches; those
  # of an earlier version are removed.
  rm -rf "$VENV/lib/t3mpc_ros"
  run env -C "$ROOT" "$PYTHON" -W ignore setup.py -q develop --no-deps \
    install_data --install-dir "$VENV" ||
    fail "the package could not be installed: $(tail -n 1 "$LOG")" "see $LOG"
  say "  compiling the kernels (about a minute)"
  run env -C "$ROOT" "$PYTHON" -m t3mpc_ros.cli.main compile ||
    fail "the kernels could not be compiled: $(tail -n 1 "$LOG")" "see $LOG"
  wanted_stamp >"$VENV/stamp"
}

# Remove a sourced ROS 2 or workspace from the environment: its modules, its libraries and its
# middleware (only Fast DDS is installed here).
unset_other_ros() {
  local folder kept='' folders
  unset PYTHONPATH PYTHONHOME RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE
  IFS=: read -r -a folders <<<"${LD_LIBRARY_PATH:-}"
  for folder in "${folders[@]}"; do
    if [ -n "$folder" ] && [ ! -e "$folder/librcl.so" ] && [[ "$folder" != */ros_*.libs ]]; then
      kept="${kept:+$kept:}$folder"
    fi
  done
  if [ -n "$kept" ]; then export LD_LIBRARY_PATH="$kept"; else unset LD_LIBRARY_PATH; fi
  export AMENT_PREFIX_PATH="$VENV"
}

unset_other_ros
BASE_PYTHON="$(choose_python)"
if ! is_current; then
  [ -w "$ROOT" ] || fail "$ROOT is not writable; .venv is created there" \
    "copy the folder to a writable location and run $0 there"
  trap 'stop_set_up 130' INT
  trap 'stop_set_up 143' TERM
  trap 'stop_set_up 129' HUP
  # One script at a time creates the environment; the others wait.
  exec 9>"$ROOT/.venv.lock"
  flock --nonblock 9 || {
    say "waiting for another script that creates the local environment"
    until flock --nonblock 9; do sleep 0.2; done
  }
  is_current || make_environment
  exec 9>&-
  trap - INT TERM HUP
fi

export PATH="$VENV/bin:$PATH"
