#!/usr/bin/env bash
# Make .venv in the checkout and install the package into it, from the files whose versions and hashes scripts/locked
# names. Does nothing if that was done. Sourced by demo.sh and test.sh, which say in $LOCK which list they need; leaves the
# interpreter's path in $PYTHON. Each list that is installed leaves a stamp, so that a script that needs less than another
# one before it starts at once.
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/.venv/bin/python"
LOCKED="$ROOT/scripts/locked"
WANTED="$(cat "$LOCKED"/*.txt "$ROOT/pyproject.toml" | cksum)"

if [ "$(cat "$ROOT/.venv/installed-$LOCK" 2>/dev/null || true)" != "$WANTED" ]; then
  if [ ! -x "$PYTHON" ]; then
    BASE=""
    for candidate in python3.11 python3.12 python3.13 python3.10 python3; do
      if "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
        BASE="$candidate"
        break
      fi
    done
    if [ -z "$BASE" ]; then
      echo "error: no Python 3.10 ... 3.13 found on PATH: install one and try again" >&2
      exit 2
    fi
    echo "making $ROOT/.venv with $("$BASE" --version)"
    "$BASE" -m venv "$ROOT/.venv"
  fi
  echo "installing what $LOCK needs (once; a minute or more)"
  # No file that is not listed: dependencies are not looked up, and what has no wheel is built with what is installed.
  # --no-compile: Python compiles what it imports, which is a fraction of what torch brings.
  install=("$PYTHON" -m pip install --quiet --no-compile --no-deps --no-build-isolation)
  "${install[@]}" --require-hashes --requirement "$LOCKED/build.txt"
  # A CPU build of torch where pip is told of one (PyPI has none for Linux): it spares gigabytes.
  "${install[@]}" --require-hashes --requirement "$LOCKED/cpu.txt" 2>/dev/null || true
  "${install[@]}" --require-hashes --requirement "$LOCKED/$LOCK.txt"
  "${install[@]}" --editable "$ROOT"
  if "$PYTHON" -c 'import importlib.metadata as m, sys; sys.exit(sys.platform != "linux" or "+cpu" in m.version("torch"))'; then
    "${install[@]}" --require-hashes --requirement "$LOCKED/cuda.txt"
  fi
  "$PYTHON" -m pip check >"$ROOT/.venv/pip-check" || { cat "$ROOT/.venv/pip-check" >&2; exit 1; }
  echo "$WANTED" >"$ROOT/.venv/installed-$LOCK"
  if [ "$LOCK" = test ]; then
    echo "$WANTED" >"$ROOT/.venv/installed-demo"  # part of it
  fi
fi
