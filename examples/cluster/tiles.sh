#!/bin/sh
# One part of a fit in tiles, for a scheduler that starts many: a cluster's array job (SLURM) or indexed job (Kubernetes).
#   tiles.sh split  SCENE.json [options of `sattools fit`, --tile among them]
#   tiles.sh count  SCENE.json                       how many tiles there are to fit
#   tiles.sh tile   SCENE.json [the same options]    tile number SLURM_ARRAY_TASK_ID or JOB_COMPLETION_INDEX (0, 1, ...),
#                                                    counted from FIRST_TILE on (0 if that is not set)
#   tiles.sh mosaic SCENE.json [the same options]
# SCENE.json lies in the scene's folder, which all machines see under the same name. A part that is done is not done again,
# unless `split` is given --overwrite.
set -eu
case ${1:--h} in
    -h | --help)
        sed -n '2,/^set -eu/{s/^# \{0,1\}//;/^set -eu/!p;}' "$0" >&2
        test $# -gt 0 && exit 0
        exit 2
        ;;
esac
part=$1 scene=$2
shift 2
sattools=${SATTOOLS:-sattools}
threads=${SLURM_CPUS_PER_TASK:-${SATTOOLS_THREADS:-1}}
tiles=$(dirname "$scene")/fit/tiles

case $part in
    split | mosaic)
        resume=
        test "$part" = split && test -e "$tiles/tiles.json" && resume=--resume
        for option; do # what is asked for anew goes on from nothing
            test "$option" != --overwrite || resume=
        done
        exec "$sattools" --threads "$threads" fit "$@" $resume --part "$part" "$scene" > /dev/null
        ;;
    count)
        ls "$tiles"/r*c*/scene.json 2> /dev/null | wc -l
        ;;
    tile)
        number=${SLURM_ARRAY_TASK_ID:-${JOB_COMPLETION_INDEX:?no number of a tile}}
        number=$((number + ${FIRST_TILE:-0}))
        one=$(ls "$tiles"/r*c*/scene.json | sed -n "$((number + 1))p")
        test -n "$one" || { echo "tiles.sh: found no tile number $number below $tiles" >&2; exit 1; }
        test -e "$(dirname "$one")/fit/model.safetensors" && exit 0
        resume=
        test -e "$(dirname "$one")/fit/checkpoint.safetensors" && resume=--resume
        exec "$sattools" --threads "$threads" fit "$@" $resume "$one" > /dev/null
        ;;
    *)
        echo "tiles.sh: found $part, expected split, count, tile or mosaic" >&2
        exit 2
        ;;
esac
