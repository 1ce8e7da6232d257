#!/bin/sh
# A fit in tiles on a SLURM cluster: one job cuts, arrays of jobs fit, one joins and exports.
#   examples/cluster/slurm.sh work/harbour/scene.json --tile 512
# Memory and time are for tiles of 512 m with three to six images (see docs/batch.md). An array has at most MAX_ARRAY jobs:
# less than the cluster's MaxArraySize (`scontrol show config`), 1001 unless somebody has set another. With --overwrite fit and
# export replace what is there.
set -eu
case ${1:--h} in
    -h | --help)
        sed -n '2,/^set -eu/{s/^# \{0,1\}//;/^set -eu/!p;}' "$0" >&2
        test $# -gt 0 && exit 0
        exit 2
        ;;
esac

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
overwrite=
for option; do
    test "$option" != --overwrite || overwrite=$option
done
export=$(quoted "${SATTOOLS:-sattools}" export $overwrite "$scene")
job="sbatch --parsable --mem=${MEMORY:-4G} --cpus-per-task=${CPUS:-2} --time=${TIME:-01:00:00}"

$job --wait --job-name=split --wrap "$part split $arguments"
count=$("$here/tiles.sh" count "$scene")
after=
first=0
while test "$first" -lt "$count"; do # an area of one tile has none: what joins fits it at once
    some=$((count - first))
    test "$some" -le "${MAX_ARRAY:-1000}" || some=${MAX_ARRAY:-1000}
    fits=$($job --job-name=tiles --array="0-$((some - 1))" --requeue --wrap "FIRST_TILE=$first $part tile $arguments")
    after=${after:---dependency=afterok}:${fits%%;*} # among several clusters its name follows the number
    first=$((first + some))
done
$job --job-name=mosaic $after --wrap "$part mosaic $arguments && $export > /dev/null"
