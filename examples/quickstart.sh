#!/usr/bin/env bash
# A simulated city, from its images with wrong cameras to a surface model scored against the truth: two minutes on two cores.
#
#     examples/quickstart.sh [FOLDER]        (default: ./demo)
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
PATH=$here/.venv/bin:$PATH
out=${1:-demo}
mkdir -p "$out"

echo "1/2  Simulating 12 satellite images of a city, their RPC cameras up to 2 pixels off ..." >&2
sattools simulate --id CITY --bias-px 2 --out "$out/simulated" --overwrite >"$out/simulated.json"
truth=$out/simulated/CITY/truth

echo "2/2  Cameras, surface, maps, score ..." >&2
sattools prep "$out"/simulated/CITY/images/*.tif --metadata "$out/simulated/CITY/metadata" \
    --id CITY --out "$out/scenes" --overwrite |
    sattools fit --overwrite |
    sattools export --overwrite |
    tee "$out/scene.json" |
    sattools compare --dsm "$truth/CITY_DSM.tif" --classes "$truth/CITY_CLS.tif" --overwrite \
        >"$out/errors.json" 2> >(tee "$out/errors.txt" >&2)

cp "$out/scenes/CITY/export/dsm.tif" "$out/scenes/CITY/export/dsm.png" "$out/"
echo "Surface model: $out/dsm.tif   picture: $out/dsm.png   errors: $out/errors.txt, $out/errors.json" >&2
