#!/usr/bin/env bash
# Make .venv in the checkout and install the package into it, from pinned versions. Does nothing if that was done.
# Sourced by demo.sh and test.sh, which say in $EXTRAS what they need; leaves the interpreter's path in $PYTHON.
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/.venv/bin/python"
STAMP="$ROOT/.venv/installed-$EXTRAS"
WANTED="$(cat "$ROOT/scripts/constraints.txt" "$ROOT/pyproject.toml" | cksum)"

if [ ! -f "$STAMP" ] || [ "$(cat "$STAMP")" != "$WANTED" ]; then
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
  echo "installing (once; a few minutes)"
  "$PYTHON" -m pip install --quiet --constraint "$ROOT/scripts/constraints.txt" setuptools wheel
  "$PYTHON" -m pip install --quiet --constraint "$ROOT/scripts/constraints.txt" --no-build-isolation --editable "$ROOT[$EXTRAS]"
  echo "$WANTED" >"$STAMP"
fi
