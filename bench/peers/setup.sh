#!/usr/bin/env bash
# Installs the published jax2d into an environment of its own, bench/.peers/jax2d (git ignores it), so that
# `kinetix-dist bench engine speed --peers` can run it beside ours. Both packages are called jax2d: never mix them.
# Usage: bash bench/peers/setup.sh [cpu|cuda12|cuda13]        the extra of jax; default cpu
set -euo pipefail
cd "$(dirname "$0")/../.."

extra=${1:-cpu}
peer=bench/.peers/jax2d
uv=$(command -v .venv/bin/uv || command -v uv) || {
  echo "setup: uv not found; run 'make install' first" >&2
  exit 1
}
case "$extra" in
  cpu) jax=() ;;
  cuda12 | cuda13) jax=("jax[$extra]") ;;
  *)
    echo "setup: '$extra' is not one of cpu, cuda12, cuda13" >&2
    exit 2
    ;;
esac

"$uv" venv --quiet --clear --python "${PYTHON:-python3}" "$peer"
"$uv" pip install --quiet --python "$peer/bin/python" --requirement bench/peers/jax2d_published.txt "${jax[@]}"
"$peer/bin/python" bench/peers/jax2d_published.py --check
