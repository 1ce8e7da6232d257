#!/usr/bin/env bash
# Areas of the Data Fusion Contest 2019 in two configurations: one table, error against seconds, one page.
#
#     SATTOOLS_DATA=... examples/dfc2019_batch.sh [FOLDER [AREA...]]        (default: ./batch, JAX_004 JAX_068 JAX_214 JAX_260)
#
# SATTOOLS_DATA is the folder that holds dfc2019/ (Track3-RGB-*, Track3-Truth, or Sat-NeRF's Track3-RGB-crops and rpc_raw).
# An area that is not there is named in the table and on stderr, and the exit code is 3. Start it again after an
# interruption: what is finished is not done again. Set SCHEDULER=tcp://HOST:PORT for a Dask cluster.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
PATH=$here/.venv/bin:$PATH
out=${1:-batch}
shift || true
areas=("$@")
[ ${#areas[@]} -gt 0 ] || areas=(JAX_004 JAX_068 JAX_214 JAX_260)
data=${SATTOOLS_DATA:?set SATTOOLS_DATA to the folder that holds dfc2019/}/dfc2019

mkdir -p "$out"
printf '[fit]\n' >"$out/usual.toml" # the defaults: 5 passes
printf '[fit]\nepochs = [16]\n' >"$out/long.toml"

named=()
for area in "${areas[@]}"; do named+=(--aoi "$area"); done
status=0
sattools batch --dfc2019 "$data" "${named[@]}" \
    --config "$out/usual.toml" --config "$out/long.toml" --out "$out" \
    ${SCHEDULER:+--scheduler "$SCHEDULER"} >"$out/scenes.jsonl" || status=$?
[ "$status" = 0 ] || [ "$status" = 3 ] || exit "$status"
sattools report "$out" --overwrite
exit "$status"
