#!/usr/bin/env bash
# Installs Box2D's Python package into an environment of its own, bench/.peers/box2d (git ignores it), so that
# `python -m jax2d.fidelity` can show it beside ours.
# Usage: bash bench/peers/setup_box2d.sh
set -euo pipefail
cd "$(dirname "$0")/../.."

source bench/peers/install.sh
install_peer box2d box2d_motions.py
