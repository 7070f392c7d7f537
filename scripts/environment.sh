# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
# Sourced by every script: creates or updates the local environment .venv, and sets $PYTHON.
# PARTS are the parts of it that the script needs: run, check for lint, types and tests, docs.
# Requires Python 3.11 to 3.14 and a package index; a system ROS is neither required nor used.
# $ROOT is the folder of the checkout: the scripts resolve a symlink to themselves before.

set -euo pipefail

ROOT="$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
PYTHON="$VENV/bin/python"
LOG="$ROOT/.venv.log"
PARTS=("${PARTS[@]:-run}")
declare -A REQUIREMENTS=([run]=requirements.txt [check]=requirements-dev.txt [docs]=requirements-docs.txt)
CHILDREN=()

say() { printf '%s\n' "$*" >&2; }
fail() {
  stop_children
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

# Print the name of a part and the hash of everything that determines its content.
wanted_stamp() {
  local hash
  hash="$({
    origin_of "$BASE_PYTHON"
    case "$1" in
    run) cat "$ROOT"/{requirements.txt,setup.py,setup.cfg,package.xml,resource/executable,t3mpc_ros/version.py} \
      "$ROOT"/{config/*.*,launch/*.launch.py} "$ROOT"/scripts/{environment.sh,finish_install.py} ;;
    check | docs) cat "$ROOT"/requirements-*.txt ;;
    esac
  } | sha256sum)"
  printf '%s\n' "$1 ${hash%% *}"
}

is_current() {
  local part
  for part in "${PARTS[@]}"; do
    grep -qxF "$(wanted_stamp "$part")" "$VENV/stamp" 2>/dev/null || return 1
  done
}

# Start a command of the set-up with its output in the log; its process is $!.
start() {
  # A session of its own: a signal to the script ends everything that the command has started.
  setsid "$@" >>"$LOG" 2>&1 9>&- &
  CHILDREN+=("$!")
}

# Wait for the command with process $1 and show that it takes time; then the time since second $2.
finish() {
  local code=0 tenths=0
  while kill -0 "$1" 2>/dev/null; do
    sleep 0.2
    tenths=$((tenths + 2))
    if ((tenths % 100 == 0)); then say "    $((tenths / 10)) s"; fi
  done
  wait "$1" || code=$?
  if [ "$code" = 0 ]; then say "    done in $((SECONDS - $2)) s"; fi
  return "$code"
}

# Run a command of the set-up; $1 says what it does.
run() {
  local since=$SECONDS
  say "  $1"
  start "${@:2}"
  finish "$!" "$since"
}

stop_children() {
  local child running=()
  for child in "${CHILDREN[@]}"; do
    if kill -TERM -- "-$child" 2>/dev/null; then running+=("$child"); fi
  done
  [ ${#running[@]} = 0 ] || sleep 0.5
  for child in "${running[@]}"; do
    kill -KILL -- "-$child" 2>/dev/null || true
    wait "$child" 2>/dev/null || true
  done
}

stop_set_up() {
  stop_children
  say 'stopped; run the script again to complete the set-up'
  exit "$1"
}

# Set UV to the installer uv, from PATH or else from the index: with it the set-up takes a fraction
# of the time. It remains empty where there is none.
find_uv() {
  if UV="$(command -v uv)"; then return; fi
  UV="$VENV/uv/bin/uv"
  run 'fetching the installer uv' "$BASE_PYTHON" -m pip install --disable-pip-version-check \
    --no-compile -q --target "$VENV/uv" uv || UV=''
}

# Pass the settings of pip to uv, which does not read them.
configure_uv() {
  local key value
  while IFS='=' read -r key value; do
    value="${value:1:-1}"
    value="${value//\\n/ }"
    case "$key" in
    *.index-url) export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$value}" ;;
    *.extra-index-url) export UV_INDEX="${UV_INDEX:-$value}" UV_INDEX_STRATEGY=unsafe-best-match ;;
    *.find-links) [ ! -d "$value" ] || export UV_FIND_LINKS="${UV_FIND_LINKS:-$value}" ;;
    *.no-index) export UV_NO_INDEX="${UV_NO_INDEX:-$value}" ;;
    *.trusted-host) export UV_INSECURE_HOST="${UV_INSECURE_HOST:-$value}" ;;
    *.cert) export SSL_CERT_FILE="${SSL_CERT_FILE:-$value}" ;;
    *.proxy) export ALL_PROXY="${ALL_PROXY:-$value}" ;;
    esac
  done < <("$BASE_PYTHON" -m pip config list 2>/dev/null)
  # A cache that cannot be written, as in a read-only home folder, is an error to uv.
  [ -z "$UV" ] || writable_folder "$("$UV" cache dir 2>/dev/null)" ||
    export UV_CACHE_DIR="$VENV/uv/cache"
}

# Return whether a file can be made in folder $1, which is made if necessary.
writable_folder() { mkdir -p "$1" 2>/dev/null && [ -w "$1" ]; }

# Install $1, named by the other arguments in the language of pip.
install() {
  if [ -n "$UV" ]; then
    run "installing $1" "$UV" pip install --python "$PYTHON" "${@:2}" && return
    say '    uv has failed; trying pip'
  fi
  if ! "$PYTHON" -m pip --version >/dev/null 2>&1; then
    run 'unpacking pip' "$PYTHON" -m ensurepip ||
      fail "pip could not be installed with $BASE_PYTHON: $(tail -n 1 "$LOG")" \
        "install Python's venv module (Debian and Ubuntu: apt install python3-venv), then run $0 again"
  fi
  run "installing $1 with pip" "$PYTHON" -m pip install --disable-pip-version-check --no-compile "${@:2}"
}

make_environment() {
  local origin part files=() others='' compiler since
  SECONDS=0
  : >"$LOG"
  origin="$(origin_of "$BASE_PYTHON")"
  if [ "$(cat "$VENV/origin" 2>/dev/null)" = "$origin" ]; then
    say "updating the local environment .venv (log: $LOG)"
    others="$(cat "$VENV/stamp" 2>/dev/null || true)"
    rm -f "$VENV/stamp"
  else
    say "creating the local environment .venv (once, about a minute; log: $LOG)"
    run 'making a virtual environment' "$BASE_PYTHON" -m venv --without-pip --clear "$VENV" ||
      fail "the environment could not be created with $BASE_PYTHON: $(tail -n 1 "$LOG")" \
        "install Python's venv module (Debian and Ubuntu: apt install python3-venv), then run $0 again"
    printf '%s\n' "$origin" >"$VENV/origin"
  fi
  for part in "${PARTS[@]}"; do files+=(-r "$ROOT/${REQUIREMENTS[$part]}"); done
  find_uv
  configure_uv
  if ! install "ROS 2 Jazzy and the libraries from the package index" "${files[@]}"; then
    say "$(grep -iE 'error|could not|no matching' "$LOG" | tail -n 3)"
    fail "the libraries could not be installed with $("$PYTHON" --version) on $(uname -sm)" \
      "check the network and the package index (\"$BASE_PYTHON -m pip config list\"; proxies: HTTPS_PROXY), then run $0 again; the wheels of ROS 2 exist for Linux on x86_64"
  fi
  # The kernels need the libraries only: they are compiled while the package is installed.
  since=$SECONDS
  start env -C "$ROOT" "$PYTHON" -m t3mpc_ros.cli.main compile
  compiler=$!
  { install 't3mpc_ros' --no-deps --no-build-isolation -e "$ROOT" &&
    run 'writing its executables to lib/t3mpc_ros, where ros2 run looks' \
      "$PYTHON" "$ROOT/scripts/finish_install.py"; } ||
    fail "the package could not be installed: $(tail -n 1 "$LOG")" "see $LOG"
  say '  compiling the kernels for this processor, since the libraries are there'
  finish "$compiler" "$since" ||
    fail "the kernels could not be compiled: $(tail -n 1 "$LOG")" "see $LOG"
  for part in "${PARTS[@]}"; do
    others="$(grep -v "^$part " <<<"$others" || true)"
    others+=$'\n'"$(wanted_stamp "$part")"
  done
  rm -rf "$VENV/uv"
  printf '%s\n' "$others" >"$VENV/stamp"
  say "the local environment is complete after $SECONDS s"
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

# Without a locale of UTF-8, or with one that is not installed, Python reads its path files as ASCII.
[ "$(locale charmap 2>/dev/null)" = UTF-8 ] || export LC_ALL=C.UTF-8
unset_other_ros
# Matplotlib has no files in a home folder that cannot be written, and says so at each start.
{ [ -d "${HOME:-}" ] && [ -w "$HOME" ]; } || export MPLCONFIGDIR="${MPLCONFIGDIR:-$VENV/matplotlib}"
# With it every start would compile the package again, and every run of pytest all tests.
unset PYTHONDONTWRITEBYTECODE
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
