#!/usr/bin/env bash
# Installs the public Kinetix package into an environment of its own, bench/.peers/kinetix (git ignores it), so that
# `python -m bench.public_package` can play its levels there. It pins an older jax, and its engine is called jax2d.
# Usage: bash bench/peers/setup_kinetix.sh
set -euo pipefail
cd "$(dirname "$0")/../.."

peer=bench/.peers/kinetix
uv=$(command -v .venv/bin/uv || command -v uv) || {
  echo "setup: uv not found; run 'make install' first" >&2
  exit 1
}
"$uv" venv --quiet --clear --python "${PYTHON:-python3}" "$peer"
"$uv" pip install --quiet --python "$peer/bin/python" --requirement bench/peers/kinetix.txt
"$peer/bin/python" bench/peers/kinetix_play.py --check
