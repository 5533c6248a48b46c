#!/usr/bin/env bash
# Everything that an installation needs, in one directory for machines without a network. Run it on a machine with one,
# of the same Python, operating system and processor:
#   bash cluster/bundle.sh DIRECTORY [EXTRA]        EXTRA: cuda12 or cuda13
# Over there:
#   bash DIRECTORY/install.sh VENV
set -euo pipefail
cd "$(dirname "$0")/.."
directory=${1:?give the directory to make}
extra=${2:-}
python=${PYTHON:-.venv/bin/python}
mkdir -p "$directory/wheels"

download() { "$python" -m pip download --only-binary :all: --dest "$directory/wheels" "$@"; }
download --require-hashes --requirement requirements.lock
cp requirements.lock "$directory/requirements.lock"
"$python" -m pip wheel --no-deps --no-build-isolation --wheel-dir "$directory/wheels" .
if [ -n "$extra" ]; then
  # The lock is for CPUs. What CUDA adds is taken at the versions of the lock, and named in a list of its own.
  grep -E '^[a-z0-9._-]+==' requirements.lock | sed 's/ *\\$//' >"$directory/constraints.txt"
  download --constraint "$directory/constraints.txt" "jax[$extra]"
fi
echo "$extra" >"$directory/extra"

cat >"$directory/install.sh" <<'INSTALL'
#!/usr/bin/env bash
# Makes VENV from this directory alone: no index is asked.   bash install.sh VENV
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
venv=${1:?give the directory of the virtual environment}
"${PYTHON:-python3}" -m venv --clear "$venv"
export PIP_NO_INDEX=1 PIP_FIND_LINKS="$here/wheels" PIP_DISABLE_PIP_VERSION_CHECK=1
unset PIP_INDEX_URL PIP_EXTRA_INDEX_URL
"$venv/bin/python" -m pip install --quiet --require-hashes --requirement "$here/requirements.lock"
"$venv/bin/python" -m pip install --quiet --no-deps "$here"/wheels/kinetix_dist-*.whl
extra=$(cat "$here/extra")
if [ -n "$extra" ]; then "$venv/bin/python" -m pip install --quiet "jax[$extra]"; fi
echo "installed into $venv; try: $venv/bin/kinetix-dist doctor"
INSTALL
(cd "$directory" && find . -name '*.whl' -exec sha256sum {} + | sort -k 2 >SHA256SUMS)
echo "bundle: $(find "$directory/wheels" -name '*.whl' | wc -l) wheels, $(du -sh "$directory" | cut -f1) in $directory"
