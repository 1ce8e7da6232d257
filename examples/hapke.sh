#!/usr/bin/env bash
# Reflectance of natural ground from one pass: four methods on a simulated scene with known truth, two to four minutes.
#
#     examples/hapke.sh [FOLDER]        (default: ./hapke)
#
# Lam: one colour per cell; RPV; Hpk: Hapke after a Lambertian start; Hpk0: Hapke from the start. All from the 7 most nadir
# views of 21; view 3, 36 degrees off, is predicted and scored. Tables, BRF plots and a page of all four: evaluation/. The
# table of several scenes: docs/reflectance.md.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
PATH=$here/.venv/bin:$PATH
out=${1:-hapke}
mkdir -p "$out"

echo "1/2  Simulating 21 views of five geological units, and matching them ..." >&2
sattools simulate --terrain natural --id NATURAL --size 384 --out "$out" --overwrite |
    sattools prior --overwrite >"$out/prior.json"
truth=$out/NATURAL/truth/NATURAL

echo "2/2  Fitting four reflectance models ..." >&2
fits=()
for method in Lam RPV Hpk Hpk0; do
    case $method in
    Lam) options=(--brdf lambert) ;;
    RPV) options=(--brdf rpv) ;;
    Hpk) options=(--brdf hapke) ;;
    Hpk0) options=(--brdf hapke --pretrain 0) ;;
    esac
    echo "--- $method" >&2
    rm -rf "${out:?}/$method"
    cp -r "$out/NATURAL" "$out/$method"
    sattools fit "${options[@]}" --resolution 2 "$out/$method/scene.json" |
        sattools export --view NATURAL_003 --undetermined prior >"$out/$method.json"
    fits+=(--fit "$method=$out/$method/scene.json")
done
maps=()
for name in w b c theta; do maps+=(--map "$name=${truth}_${name^^}.tif"); done
# four places on the diagonal, whose samples are the truth's own maps
jq -r '.sattools.grid | . as $g | "name,x,y", (range(1; 5) | "place \(.),\($g.left + 77 * .),\($g.top - 77 * .)")' \
    "$out/prior.json" >"$out/points.csv"
sattools compare "${fits[@]}" --register none --dsm "${truth}_DSM.tif" --views "${maps[@]}" --points "$out/points.csv" \
    --out "$out/evaluation" --overwrite >"$out/evaluation.json"
sattools report "$out/evaluation" --overwrite
