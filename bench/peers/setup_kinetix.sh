#!/usr/bin/env bash
# Installs the public Kinetix package into an environment of its own, bench/.peers/kinetix (git ignores it), so that
# `python -m bench.public_package` can play its levels there. It pins an older jax, and its engine is called jax2d.
# Usage: bash bench/peers/setup_kinetix.sh
set -euo pipefail
cd "$(dirname "$0")/../.."

source bench/peers/install.sh
install_peer kinetix kinetix_play.py
