#!/bin/bash
# Trains on several nodes under Slurm, one process a GPU:
#
#     sbatch launch/slurm.sh --scene intersection --method rtc --seeds 16 --run /shared/runs/rtc
#
# Submit the same line again, and it goes on where it was. The folder of --run, which must be given, is one that all nodes see.
# Processes find each other by Slurm's variables. Without GPUs: --ntasks-per-node=1 and no --gpus-per-node.

#SBATCH --job-name=rtc_mjx
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=8
#SBATCH --gpu-bind=none
#SBATCH --time=12:00:00
#SBATCH --signal=TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append

# --gpu-bind=none: each process sees the GPUs of its node and takes the one of its number.
# --signal: five minutes before the end all processes are asked to stop; they save a checkpoint first.
set -euo pipefail

run=
for ((i = 1; i < $#; i++)); do
    if [[ ${!i} == --run ]]; then
        next=$((i + 1))
        run=${!next}
    fi
done
[[ -n $run ]] || { echo "say --run DIR, a folder that all nodes see" >&2; exit 2; }

# Decided once, here: all processes must agree. What is resumed has its settings in its folder.
again=()
[[ -f $run/config.json ]] && again=(--resume)

# A process that fails ends the others: they would end by themselves within --timeout.
# The CPUs of a task are said again: srun of Slurm 22.05 to 23.02 does not inherit them.
srun --kill-on-bad-exit=1 --cpus-per-task="${SLURM_CPUS_PER_TASK:-1}" \
    python -m rtc_mjx.train --distributed --timeout 300 "$@" ${again[@]+"${again[@]}"}
