# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
# Sourced by every script: makes or renews the local environment .venv, then offers $PYTHON.
# Nothing but Python 3.11+ and a reachable package index is needed; no system ROS.

set -euo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
PYTHON="$VENV/bin/python"

say() { printf '%s\n' "$*" >&2; }
fail() {
  say "error: $1"
  say "remedy: $2"
  exit 1
}

find_python() {
  local candidate
  for candidate in ${T3MPC_PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null 2>&1 &&
      "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  fail "no Python 3.11 or newer was found (python3 is $(python3 --version 2>&1 || echo missing))" \
    "install python3.11 or newer with its venv module, or name one: T3MPC_PYTHON=/usr/bin/python3.12 $0"
}

# What the environment is made from: when any of it changes, the environment is stale.
wanted_stamp() {
  (cd "$ROOT" && cat requirements.txt requirements-dev.txt setup.py setup.cfg package.xml \
    t3mpc_ros/__init__.py config/* launch/* && echo "$ROOT" && "$1" --version) | sha256sum | cut -d' ' -f1
}

make_environment() {
  local base="$1" log="$VENV.log"
  say "making the local environment .venv (once, about a minute; log: ${log#"$ROOT"/})"
  if ! "$base" -m venv "$VENV" >"$log" 2>&1; then
    fail "the environment could not be made: $(tail -n 1 "$log")" \
      "install Python's venv module (Debian and Ubuntu: apt install python3-venv)"
  fi
  say "  installing ROS 2 Jazzy and the libraries from the package index"
  if ! "$PYTHON" -m pip install --disable-pip-version-check \
    -r "$ROOT/requirements.txt" -r "$ROOT/requirements-dev.txt" >>"$log" 2>&1; then
    rm -f "$VENV/stamp"
    say "$(grep -iE 'error|could not|no matching' "$log" | tail -n 3)"
    fail "the libraries could not be installed" \
      "check the network and the package index (pip config list; proxies: HTTPS_PROXY), then run this again"
  fi
  say "  installing t3mpc_ros itself, as colcon would"
  # develop puts the executables into lib/t3mpc_ros, where \`ros2 run\` looks for them.
  if ! (cd "$ROOT" && AMENT_PREFIX_PATH="$VENV" "$PYTHON" -W ignore setup.py -q develop --no-deps \
    install_data --install-dir "$VENV") >>"$log" 2>&1; then
    fail "the package could not be installed: $(tail -n 1 "$log")" "see ${log#"$ROOT"/}"
  fi
  say "  compiling the kernels"
  if ! (cd "$ROOT" && "$PYTHON" -m t3mpc_ros.lab.program warm) >>"$log" 2>&1; then
    fail "the kernels could not be compiled: $(tail -n 1 "$log")" "see ${log#"$ROOT"/}"
  fi
}

BASE_PYTHON="$(find_python)"
(
  # One script at a time may set up; the others wait for it.
  flock 9
  STAMP="$(wanted_stamp "$BASE_PYTHON")"
  if [ "$(cat "$VENV/stamp" 2>/dev/null)" != "$STAMP" ]; then
    make_environment "$BASE_PYTHON"
    echo "$STAMP" >"$VENV/stamp"
  fi
) 9>"$ROOT/.venv.lock"

# A child of this environment must not inherit another one's idea of where ROS is.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH="$VENV${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
export PATH="$VENV/bin:$PATH"
