#!/usr/bin/env bash
# The tests. Arguments go to pytest; without any, the slow ones are left out.
set -euo pipefail
EXTRAS="dev,ray,viz,rerun,video"
. "$(dirname "${BASH_SOURCE[0]}")/install.sh"
cd "$ROOT"
if [ $# -eq 0 ]; then
  set -- -m "not slow"
fi
exec "$PYTHON" -m pytest "$@"
