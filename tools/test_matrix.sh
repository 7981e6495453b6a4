#!/usr/bin/env bash
# The quick tests of the last commit with other Pythons, and with the oldest packages that pyproject.toml allows and that
# have a wheel, and the newest: tools/test_matrix.sh 3.12 3.13. A row each in runs/matrix/results.md, its packages beside
# it; what has passed at this commit is not run again. An environment takes up to 10 GB of disk; that of a row that has
# passed is removed.
set -euo pipefail
cd "$(dirname "$0")/.."
export UV_HTTP_TIMEOUT="${UV_HTTP_TIMEOUT:-300}" UV_PYTHON_DOWNLOADS=never
unset VIRTUAL_ENV
revision="$(git rev-parse --short HEAD)" uv="$PWD/.tools/bin/uv" results="$PWD/runs/matrix/results.md"
missing=""
mkdir -p runs/matrix

try() {  # python resolution
  rm -rf "runs/matrix/$1-$2"
  git clone --quiet . "runs/matrix/$1-$2"
  cd "runs/matrix/$1-$2"
  "$uv" venv --quiet --python "$1" .venv
  "$uv" pip install --quiet --python .venv --resolution "$2" --only-binary :all: --group dev -e ".[all,peers]" -e research
  .venv/bin/python tools/system_libs.py
  "$uv" pip freeze --python .venv >"../$1-$2.packages"
  OMP_NUM_THREADS=1 .venv/bin/python -m pytest tests -n 2 --dist worksteal --max-worker-restart 0 -m "not slow"
}

for python in "$@"; do
  "$uv" python find --quiet "$python" >/dev/null || { missing+=" $python"; continue; }
  for resolution in lowest-direct highest; do
    if grep -qs "| $revision | $python | $resolution | passed" "$results"; then continue; fi
    log="runs/matrix/$python-$resolution.log"
    set +e  # or the function would go on after an error
    (set -e; try "$python" "$resolution") >"$log" 2>&1
    outcome=$([[ $? == 0 ]] && echo passed || echo failed)
    set -e
    [[ $outcome == failed ]] || rm -rf "runs/matrix/$python-$resolution"
    echo "| $revision | $python | $resolution | $outcome | $(tail -n 1 "$log") |" | tee -a "$results"
  done
done
failed="$(grep -s "| $revision |" "$results" | tac | awk -F'|' '!seen[$3, $4]++' | grep "| failed |" || true)"  # the last of each
[[ -z $missing ]] || echo "test-matrix: NOT TRIED, since there is no Python$missing here" >&2
[[ -z $failed$missing ]]
