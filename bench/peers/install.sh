# Sourced by the setup scripts of peers, from the top of the checkout.
# install_peer NAME PROGRAM: an environment bench/.peers/NAME with what bench/peers/NAME.txt says; PROGRAM checks it.
install_peer() {
  local peer=bench/.peers/$1 uv
  uv=$(command -v .venv/bin/uv || command -v uv) || {
    echo "setup: uv not found; run 'make install' first" >&2
    exit 1
  }
  "$uv" venv --quiet --clear --python "${PYTHON:-python3}" "$peer"
  "$uv" pip install --quiet --python "$peer/bin/python" --requirement "bench/peers/$1.txt"
  "$peer/bin/python" "bench/peers/$2" --check
}
