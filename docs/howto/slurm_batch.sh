#!/usr/bin/env bash
#SBATCH --job-name=imr_torch
#SBATCH --ntasks=8
#SBATCH --cpus-per-task=1
#SBATCH --time=01:00:00
# Characterises every file of a folder:  sbatch slurm_batch.sh day1 day1_results
set -euo pipefail
shots=$1 results=$2
mkdir -p "$results"
address=$results/.scheduler.json
rm -f "$address"

dask scheduler --port 0 --no-dashboard --scheduler-file "$address" &
scheduler=$!
srun dask worker --nthreads 1 --no-dashboard --scheduler-file "$address" &
trap 'kill %1 %2 2>/dev/null; wait' EXIT

until [ -s "$address" ]; do kill -0 "$scheduler"; sleep 1; done
python=$(command -v python3)
cluster=$("$python" -c 'import json, sys; print(json.load(open(sys.argv[1]))["address"])' "$address")
imr-torch batch "$shots" --out "$results" --cluster "$cluster"
