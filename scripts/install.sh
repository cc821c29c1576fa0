#!/usr/bin/env bash
# Make .venv in the checkout and install the package into it, from pinned versions. Does nothing if that was done.
# Sourced by demo.sh and test.sh, which say in $EXTRAS what they need; leaves the interpreter's path in $PYTHON. Each extra
# that is installed leaves a stamp, so that a script that needs less than another one before it starts at once.
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/.venv/bin/python"
WANTED="$(cat "$ROOT/scripts/constraints.txt" "$ROOT/pyproject.toml" | cksum)"
MISSING=""
for extra in ${EXTRAS//,/ }; do
  stamp="$ROOT/.venv/installed-$extra"
  if [ ! -f "$stamp" ] || [ "$(cat "$stamp")" != "$WANTED" ]; then
    MISSING="$MISSING $extra"
  fi
done

if [ -n "$MISSING" ]; then
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
  echo "installing$MISSING (once; a minute or more)"
  # --no-compile: Python compiles what it imports, which is a fraction of what torch brings.
  "$PYTHON" -m pip install --quiet --no-compile --constraint "$ROOT/scripts/constraints.txt" setuptools wheel
  "$PYTHON" -m pip install --quiet --no-compile --constraint "$ROOT/scripts/constraints.txt" --no-build-isolation --editable "$ROOT[$EXTRAS]"
  for extra in ${EXTRAS//,/ }; do
    echo "$WANTED" >"$ROOT/.venv/installed-$extra"
  done
fi
