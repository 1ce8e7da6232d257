#!/bin/sh
# A fit in tiles on a SLURM cluster: one job cuts, an array of jobs fits, one joins and exports.
#   examples/cluster/slurm.sh work/harbour/scene.json --tile 512
# Memory and time are for tiles of 512 m with three to six images (see docs/batch.md).
set -eu

# words as a shell reads them, whatever blanks and quotes are in them: --wrap takes one text
quoted() {
    for word; do
        printf "'"
        printf %s "$word" | sed "s/'/'\\\\''/g"
        printf "' "
    done
}

here=$(cd "$(dirname "$0")" && pwd)
scene=$1
shift
part=$(quoted "$here/tiles.sh")
arguments=$(quoted "$scene" "$@")
export=$(quoted "${SATTOOLS:-sattools}" export "$scene")
job="sbatch --parsable --mem=${MEMORY:-4G} --cpus-per-task=${CPUS:-2} --time=${TIME:-01:00:00}"

$job --wait --job-name=split --wrap "$part split $arguments"
count=$("$here/tiles.sh" count "$scene")
after=
if test "$count" -gt 0; then # an area of one tile has none: what joins fits it at once
    fits=$($job --job-name=tiles --array="0-$((count - 1))" --requeue --wrap "$part tile $arguments")
    after=--dependency=afterok:$fits
fi
$job --job-name=mosaic $after --wrap "$part mosaic $arguments && $export > /dev/null"
