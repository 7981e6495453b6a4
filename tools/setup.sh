#!/usr/bin/env bash
# Make .venv as uv.lock says, with the Python at hand. Needs Python >= 3.11 with pip; no root, no venv module.
# --slim: what mapping needs, without PyTorch, CUDA, Open3D's notebooks and developers' tools.
set -euo pipefail
cd "$(dirname "$0")/.."

python="$(command -v "${PYTHON:-python3}")" || { echo "setup: no ${PYTHON:-python3} on the PATH" >&2; exit 1; }
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
  echo "setup: $("$python" --version) is too old; install Python 3.11 or newer, or name one: make setup PYTHON=python3.12" >&2
  exit 1
fi
# The interpreter itself: a shim of a version manager, or an active environment, would have .venv made again every time.
python="$("$python" -c 'import sys; print(sys._base_executable)')"

# uv from the package index. --target works without the venv module and on externally managed Pythons.
uv=.tools/bin/uv
if ! "$uv" --version >/dev/null 2>&1; then
  rm -rf .tools
  "$python" -m pip install --quiet --disable-pip-version-check --target .tools 'uv>=0.8'
fi

# Wheels of several hundred MB over a slow line: be patient. Never a downloaded Python: the one at hand is the one tested.
export UV_HTTP_TIMEOUT="${UV_HTTP_TIMEOUT:-300}" UV_PYTHON_DOWNLOADS=never UV_PROJECT_ENVIRONMENT=.venv
unset VIRTUAL_ENV
cache="${UV_CACHE_DIR:-${XDG_CACHE_HOME:-${HOME:-/nonexistent}/.cache}/uv}"
if ! mkdir -p "$cache" 2>/dev/null || [[ ! -w $cache ]]; then
  export UV_CACHE_DIR="$PWD/.tools/cache"  # a home that cannot be written to
fi
if [[ ${1:-} == --slim ]]; then
  "$uv" venv --quiet --clear --python "$python" .venv
  "$uv" export --quiet --frozen --no-dev --no-hashes --no-emit-project --extra foxglove --extra realsense \
    --prune torch --prune ipywidgets --prune nbformat --output-file .tools/slim.txt >/dev/null
  # The wheel of Open3D for x86-64 has CUDA in it; its builds without have a name of their own.
  if [[ $(uname -m) == x86_64 ]]; then sed -i 's/^open3d==/open3d-cpu==/' .tools/slim.txt; fi
  "$uv" pip install --python .venv --no-deps -r .tools/slim.txt -e .
  touch .venv/.slim
else
  if [[ -e .venv/.slim ]]; then rm -rf .venv; fi
  "$uv" sync --frozen --all-extras --python "$python"
fi

.venv/bin/python tools/system_libs.py
