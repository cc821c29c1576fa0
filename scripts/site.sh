#!/usr/bin/env bash
# Build the site in outputs/site, and check every link: open outputs/site/index.html. Arguments go to `mkdocs build`.
set -euo pipefail
STAMP=site EXTRAS=docs
. "$(dirname "${BASH_SOURCE[0]}")/install.sh"
cd "$ROOT"
source=outputs/site_source
rm -rf "$source"
mkdir -p "$source/reference"
cp -R README.md CHANGELOG.md CONTRIBUTING.md SECURITY.md CITATION.cff LICENSE docs notebooks "$source"
"$PYTHON" -m cflow_torch.cli.main settings >"$source/reference/settings.md"
exec "$PYTHON" -m mkdocs build --strict "$@"
