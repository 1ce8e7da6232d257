#!/usr/bin/env bash
# A tile of the Data Fusion Contest 2019 (17 WorldView-3 crops, raw RPCs), scored against lidar.
#
#     SATTOOLS_DATA=... examples/jax_068.sh [FOLDER]        (default: ./work)
#
# SATTOOLS_DATA is the folder that holds dfc2019/ (Track3-RGB-crops, rpc_raw, Track3-Truth).
# Expected on the west half of the lidar tile: MAE 0.97 m, median 0.18 m, completeness 99.99 % (see "Figures" in
# README.md).
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
PATH=$here/.venv/bin:$PATH
out=${1:-work}
data=${SATTOOLS_DATA:?set SATTOOLS_DATA to the folder that holds dfc2019/}/dfc2019

sattools prep "$data"/Track3-RGB-crops/JAX_068/*.tif --metadata "$data/rpc_raw/JAX_068" --id JAX_068 \
    --out "$out" --overwrite |
    sattools fit --overwrite |
    sattools export --overwrite |
    sattools compare --protocol dfc2019 --truth "$data/Track3-Truth" --overwrite
