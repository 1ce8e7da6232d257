#!/bin/sh
# A fit in tiles on a SLURM cluster: one job cuts, an array of jobs fits, one joins and exports.
#   examples/cluster/slurm.sh work/harbour/scene.json --tile 512
# Memory and time are for tiles of 512 m with three to six images (see docs/batch.md).
set -eu
scene=$1
shift
here=$(cd "$(dirname "$0")" && pwd)
job="sbatch --parsable --mem=${MEMORY:-4G} --cpus-per-task=${CPUS:-2} --time=${TIME:-01:00:00}"

$job --wait --job-name=split --wrap "'$here/tiles.sh' split '$scene' $*"
count=$("$here/tiles.sh" count "$scene")
fits=$($job --job-name=tiles --array="0-$((count - 1))" --requeue --wrap "'$here/tiles.sh' tile '$scene' $*")
$job --job-name=mosaic --dependency="afterok:$fits" \
    --wrap "'$here/tiles.sh' mosaic '$scene' $* && sattools export '$scene' > /dev/null"
