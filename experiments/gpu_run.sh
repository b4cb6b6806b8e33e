#!/usr/bin/env bash
# Train on a GPU machine that is at hand for minutes and has no network, but Python and JAX for CUDA.
#
#   experiments/gpu_run.sh pack FOLDER [--python 3.12] [-- TRAINING OPTIONS]
#       here: this project as a wheel, and what such a machine has not, for x86-64; with training options
#       also the kernels that MuJoCo Warp would otherwise compile there for a minute
#   FOLDER/gpu_run.sh run OUT [--minutes 9] [--mib 16] [--from LEARNED.npz] [--profile] -- TRAINING OPTIONS
#       there: install that apart, train until a minute before the end, and write to OUT the log and
#       learned.npz, from which the next call goes on; no file there is above 16 MiB. With --profile
#       also stages.json, the time of two iterations by stage, and their trace if it is small enough
#
# For example: gpu_run.sh run out --minutes 9 -- --terrain mixed --experiment robust --engine warp
set -euo pipefail

here=$(cd "$(dirname "$0")" && pwd)
WITH_JAX="jax jaxlib ml_dtypes numpy opt_einsum scipy" # that machine has these

fail() { echo "error: $*" >&2; exit 2; }

pack() {
  local folder=${1:?pack needs a folder} python=3.12 root
  shift
  [ "${1:-}" = "--python" ] && { python=${2:?--python needs a version}; shift 2; }
  root=$(cd "$here/.." && pwd)
  local tested="$root/constraints/py${python/./}.txt"
  [ -f "$tested" ] || fail "Python $python is not tested; 3.11 and 3.12 are"
  [ -z "$(find "$folder" -maxdepth 1 -name '*.whl' 2>/dev/null)" ] ||
    fail "$folder holds wheels; name a new folder"
  local own="$root/.venv/bin/python" pip=("$root/.venv/bin/python" -m pip --disable-pip-version-check)
  [ -x "$own" ] || fail "no $root/.venv; make it with: make setup"
  [ "${1:-}" != "--" ] || "$own" -c "import warp" 2>/dev/null ||
    fail "kernels are compiled by MuJoCo Warp, which is not here: pip install 'cref-jax[warp]'"
  mkdir -p "$folder"
  "${pip[@]}" wheel --quiet --no-deps --wheel-dir "$folder" "$root"
  "${pip[@]}" download --quiet --only-binary=:all: --python-version "$python" --implementation cp \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 \
    --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 --dest "$folder" \
    --constraint "$tested" "$(echo "$folder"/cref_jax-*.whl)[warp]"
  for name in $WITH_JAX; do rm -f "$folder/$name"-*.whl; done
  cp "$here/gpu_run.sh" "$folder/"
  if [ "${1:-}" = "--" ]; then
    shift
    WARP_CACHE_PATH="$folder/cache/warp" "$own" "$here/warp_kernels.py" "$@"
  fi
  du -sh "$folder"
}

run() {
  local out=${1:?run needs a folder to write to} minutes=9 mib=16 from="" begun start=() profile=() status=0
  begun=$(date +%s); shift
  while [ $# -gt 0 ] && [ "$1" != "--" ]; do
    case $1 in
      --profile) profile=(--profile --run.chunk 2); shift; continue ;;
      --minutes) minutes=$2 ;; --mib) mib=$2 ;; --from) from=$2 ;;
      *) fail "unknown option $1; known: --minutes, --mib, --from, --profile, and -- before those of train" ;;
    esac
    shift 2
  done
  shift || true
  [ "$minutes" -ge 2 ] || fail "--minutes must be at least 2, not $minutes"
  mkdir -p "$out"
  local site=$here/site work=$here/run
  [ -d "$site" ] || python3 -m pip install --quiet --no-index --no-deps --no-compile \
    --disable-pip-version-check --target "$site" "$here"/*.whl
  export PYTHONPATH=$site XDG_CACHE_HOME=$here/cache WARP_CACHE_PATH=$here/cache/warp
  export MUJOCO_GL=${MUJOCO_GL:-disable} PYTHONUNBUFFERED=1
  python3 -c "import jax; print(jax.__version__, jax.devices())"
  [ -n "$from" ] && start=(--init "$from")
  [ -d "$work/checkpoints" ] && start=(--resume)
  python3 -m cref_jax.train "$@" "${start[@]}" "${profile[@]}" --run-dir "$work" --no-evaluate --no-tensorboard \
    > "$out/train.log" 2>&1 &
  local training=$! last=$((begun + 60 * minutes - 60))
  while kill -0 $training 2>/dev/null && [ "$(date +%s)" -lt $last ]; do sleep 1; done
  kill -TERM $training 2>/dev/null || true
  wait $training || status=$?
  tail -n 3 "$out/train.log"
  [ "$status" -eq 0 ] || fail "training ended with $status; see $out/train.log"
  cp "$work/log.jsonl" "$work/config.json" "$work/origin.jsonl" "$out/"
  JAX_PLATFORMS=cpu python3 -m cref_jax.export --run "$work" --learner "$out/learned.npz"
  [ ${#profile[@]} -eq 0 ] || cp "$work/stages.json" "$out/" || echo "no profile; see $out/train.log"
  [ ! -f "$work/trace.json.gz" ] || [ -n "$(find "$work/trace.json.gz" -size +"$mib"M)" ] ||
    cp "$work/trace.json.gz" "$out/"
  find "$out" -type f -size +"$mib"M -print -exec gzip -9 {} + | sed 's/^/above the limit, packed: /'
  echo "$(($(date +%s) - begun)) of $((60 * minutes)) s"
}

case ${1:-} in
  pack | run) "$@" ;;
  *) sed -n '2,13s/^# \{0,1\}//p' "$0"; exit 2 ;;
esac
