#!/bin/bash
# A SLURM of one node on this machine (Debian's packages, root), a study of 40 jobs on an array of 40 tasks, and the node killed
# meanwhile: slurmd and all that it runs. SLURM must requeue what was lost, and all results must be there.
# Nothing outside a temporary folder is written but munge's own socket and key. PYTHON names the interpreter.
set -euo pipefail

here=$(cd "$(dirname "$0")" && pwd)
python=$(realpath -s "${PYTHON:-python3}")
work=$(mktemp -d)
export SLURM_CONF=$work/slurm.conf PYTHONPATH=$here/..:$here

command -v slurmctld >/dev/null && command -v slurmd >/dev/null && command -v munged >/dev/null || {
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends slurmctld slurmd slurm-client munge >/dev/null
}

host=$(hostname -s)
cat > "$SLURM_CONF" <<END
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmctldTimeout=10
SlurmdTimeout=10
ReturnToService=2
JobRequeue=1
SlurmdParameters=config_overrides
NodeName=$host NodeAddr=127.0.0.1 CPUs=8 RealMemory=1000 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
mkdir -p "$work/state" "$work/spool" /run/munge

clean() {
    scancel --user=root 2>/dev/null || true
    for name in slurmctld slurmd munged; do
        [ -f "$work/$name.pid" ] && kill "$(cat "$work/$name.pid")" 2>/dev/null || true
    done
    [ -n "${KEEP:-}" ] && echo "$work" || rm -rf "$work"
}
trap clean EXIT
trap "exit 143" TERM
trap "exit 130" INT

if ! munge -n >/dev/null 2>&1; then
    [ -f /etc/munge/munge.key ] || { dd if=/dev/urandom of=/etc/munge/munge.key bs=1024 count=1 status=none; }
    chown munge:munge /etc/munge/munge.key /run/munge
    chmod 400 /etc/munge/munge.key
    runuser -u munge -- munged --pid-file=/run/munge/munged.pid
    cp /run/munge/munged.pid "$work/munged.pid"
fi
slurmctld
slurmd
for _ in $(seq 60); do sinfo --noheader --format=%T 2>/dev/null | grep -q idle && break; sleep 1; done
sinfo

"$python" "$here/digests.py" "$work/out" slurm 40 3 &
study=$!
until [ "$(squeue --noheader --states=R 2>/dev/null | wc -l)" -ge 4 ]; do sleep 0.5; kill -0 $study; done
sleep 4
echo "killing the node with $(squeue --noheader --states=R | wc -l) tasks running"
steps=$(pgrep -f "slurmstepd: \[" || true)
kill -9 "$(cat "$work/slurmd.pid")"
for step in $steps; do
    children=$(pgrep -P "$step" || true)
    kill -9 "$step" $children 2>/dev/null || true
done
for _ in $(seq 60); do sinfo --noheader --format=%T | grep -q down && break; sleep 1; done
sinfo
slurmd
wait $study
