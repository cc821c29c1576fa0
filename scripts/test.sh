#!/usr/bin/env bash
# Run the tests. Arguments go to pytest. Without arguments, the tests that are not slow run in several processes.
set -euo pipefail
STAMP=test EXTRAS=dev,ray,rerun,video
. "$(dirname "${BASH_SOURCE[0]}")/install.sh"
cd "$ROOT"
if [ $# -eq 0 ]; then
  # Files in the order of their names: by their number of tests, the notebooks would come last and keep one core waiting.
  set -- -m "not slow" --dist loadfile --no-loadscope-reorder -n "$("$PYTHON" -c 'import os; print(min(4, os.cpu_count() or 1))')"
fi
exec "$PYTHON" -m pytest "$@"
