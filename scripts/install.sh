#!/usr/bin/env bash
# Make .venv in the checkout, and install the package with the versions of constraints.txt. A stamp for each list of
# extras avoids doing it twice. demo.sh and test.sh source this script: $EXTRAS are the extras, $STAMP names them. The path
# of the interpreter is then in $PYTHON.
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/.venv/bin/python"
WANTED="$(cat "$ROOT"/scripts/{constraints,evaluators}.txt "$ROOT/pyproject.toml" | cksum)"

if [ "$(cat "$ROOT/.venv/installed-$STAMP" 2>/dev/null || true)" != "$WANTED" ]; then
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
  echo "installing what $STAMP needs (once; a minute or more)"
  # --no-compile: Python compiles what it imports, which is a fraction of what torch brings.
  install=("$PYTHON" -m pip install --quiet --no-compile --constraint "$ROOT/scripts/constraints.txt")
  "${install[@]}" setuptools wheel
  # Where pip finds a CPU build of the pinned torch, it installs that one, which saves gigabytes. The package itself, and
  # dependencies without a wheel, are built with the setuptools of the line above.
  (cd "$ROOT" && "${install[@]}" --no-build-isolation --editable ".[$EXTRAS]")
  if [ "$STAMP" = test ]; then
    "${install[@]}" --no-deps --requirement "$ROOT/scripts/evaluators.txt"
  fi
  echo "$WANTED" >"$ROOT/.venv/installed-$STAMP"
  if [ "$STAMP" = test ]; then
    echo "$WANTED" >"$ROOT/.venv/installed-demo"  # its extras are installed, too
  fi
fi

# Where the environment forbids bytecode, the demo and each process of the tests would compile torch and kornia again. So
# they share their bytecode in the cache of pytest.
if [ -n "${PYTHONDONTWRITEBYTECODE:-}" ]; then
  export PYTHONDONTWRITEBYTECODE="" PYTHONPYCACHEPREFIX="$ROOT/.pytest_cache/bytecode"
fi
