#!/bin/sh
# Builds the WebGL viewer of the dashboard's View tab: toolkit/widgets/viewer/dist/. Needs npm and the npm registry.
set -eu
cd "$(dirname "$0")/../toolkit/widgets/viewer"
if ! command -v npm >/dev/null; then
    echo "npm is missing. On Debian and Ubuntu: apt-get install nodejs npm" >&2
    exit 1
fi
# Nothing of the packages is run but esbuild.
npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
npm run --silent build
