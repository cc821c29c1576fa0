#!/usr/bin/env bash
# Estimate the flow of a simulated street, and draw it: outputs/demo/flow.png. Arguments go to `cflow demo`.
set -euo pipefail
STAMP=demo EXTRAS=viz,hdf5
. "$(dirname "${BASH_SOURCE[0]}")/install.sh"
cd "$ROOT"
exec "$PYTHON" -m cflow_torch.cli.main demo "$@"
