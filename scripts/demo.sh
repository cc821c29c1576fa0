#!/usr/bin/env bash
# Estimate the flow of a simulated street, and show it: outputs/demo/flow.html (3-D, for any browser) and flow.png.
# Arguments go to `cflow demo`.
set -euo pipefail
STAMP=demo EXTRAS=viz,html,hdf5
. "$(dirname "${BASH_SOURCE[0]}")/install.sh"
cd "$ROOT"
exec "$PYTHON" -m cflow_torch.cli.main demo "$@"
