#!/usr/bin/env bash
# Reflectance of natural ground from one pass: four methods on a simulated scene with known truth, two to four minutes.
#
#     examples/hapke.sh [FOLDER]        (default: ./hapke)
#
# Lam: one colour per cell; RPV; Hpk: Hapke after a Lambertian start; Hpk0: Hapke from the start. All from the 7 most nadir
# views of 21; view 3, 36 degrees off, is predicted and scored. The table of several scenes: docs/reflectance.md.
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
for method in Lam RPV Hpk Hpk0; do
    maps=()
    case $method in
    Lam) options=(--brdf lambert) ;;
    RPV) options=(--brdf rpv) ;;
    Hpk) options=(--brdf hapke) ;;
    Hpk0) options=(--brdf hapke --pretrain 0) ;;
    esac
    [[ $method == Hpk* ]] && maps=(--map "w=${truth}_W.tif" --map "theta=${truth}_THETA.tif")
    echo "--- $method" >&2
    sattools fit "${options[@]}" --resolution 2 --overwrite <"$out/prior.json" |
        sattools export --view NATURAL_003 --overwrite |
        sattools compare --register none --views "${maps[@]}" --overwrite >"$out/$method.json"
done
