#!/usr/bin/env bash
# Model x loss x shadow regularisation on JAX_068: the HDR satellite NeRF's three tables, with seconds and difference maps.
#
#     SATTOOLS_DATA=... examples/hdr_ablation.sh [FOLDER]        (default: ./work; about ten minutes per start)
#
# SATTOOLS_DATA is the folder that holds dfc2019/. Only 8-bit RGB crops are at hand there, not the paper's 16-bit images.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
PATH=$here/.venv/bin:$PATH
out=${1:-work}
data=${SATTOOLS_DATA:?set SATTOOLS_DATA to the folder that holds dfc2019/}/dfc2019

sattools prep "$data"/Track3-RGB-crops/JAX_068/*.tif --metadata "$data/rpc_raw/JAX_068" --id JAX_068 \
    --out "$out" --overwrite |
    sattools prior --overwrite >/dev/null

for start in prior flat; do
    python "$here/benchmarks/hdr_ablation.py" "$out/JAX_068/scene.json" "$data/Track3-Truth" \
        --start "$start" --out "$out/hdr_ablation_$start"
done
