#!/usr/bin/env bash
# Installs Box2D's Python package into an environment of its own, bench/.peers/box2d (git ignores it), so that
# `python -m jax2d.fidelity` can show it beside ours.
# Usage: bash bench/peers/setup_box2d.sh
set -euo pipefail
cd "$(dirname "$0")/../.."

peer=bench/.peers/box2d
uv=$(command -v .venv/bin/uv || command -v uv) || {
  echo "setup: uv not found; run 'make install' first" >&2
  exit 1
}
"$uv" venv --quiet --clear --python "${PYTHON:-python3}" "$peer"
"$uv" pip install --quiet --python "$peer/bin/python" --requirement bench/peers/box2d.txt
"$peer/bin/python" bench/peers/box2d_motions.py --check
