"""Runs the campaign on one GPU: a process an arm, two seeds in each, all at once.

    python experiments/results/pong_choices/run_on_gpu.py OUT SECONDS [STEPS] [ARM...]

Each is stopped by SIGTERM, which writes a checkpoint, once it has been evaluated after STEPS env steps (200,000),
or after so many seconds. `python -m experiments.figures` with `choices.json` makes the same runs on a CPU.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
out, seconds = Path(sys.argv[1]), float(sys.argv[2])
steps = int(sys.argv[3]) if len(sys.argv) > 3 else 200_000
names = sys.argv[4:]
env = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
env = {**env, "XLA_FLAGS": "--xla_gpu_autotune_level=0", **os.environ}


def returns(arm: str) -> dict[int, dict[int, float]]:
    """{seed: {env steps: mean return of an evaluation}}."""
    found: dict[int, dict[int, float]] = {}
    for path in sorted((out / "Pong" / arm).glob("seed*/metrics.jsonl")):
        lines = path.read_text().splitlines()
        rows = [json.loads(line) for line in lines if '"eval/return_mean"' in line]
        found[int(path.parent.name[4:])] = {row["env_steps"]: row["eval/return_mean"] for row in rows}
    return found


processes = {}
for arm in json.loads((HERE / "choices.json").read_text())["arms"]:
    if names and arm["name"] not in names:
        continue
    command = [sys.executable, "-m", "experiments.train", f"--preset={arm['preset']}", "--steps=500000"]
    command += ["--eval_every=50000", "--nodiagnostics", "--seeds=0,1", "--resume=auto", "--tune_runtime=off"]
    command += [f"--{flag}={value}" for flag, value in arm["flags"].items()]
    (out / "logs").mkdir(parents=True, exist_ok=True)
    log = open(out / "logs" / arm["name"], "a")
    command += [f"--out={out / 'Pong' / arm['name']}"]
    processes[arm["name"]] = subprocess.Popen(command, env=env, stdout=log, stderr=subprocess.STDOUT)
began, stopped = time.time(), set()
while any(p.poll() is None for p in processes.values()):
    time.sleep(2)
    for arm, process in processes.items():
        seen = [max(points, default=0) for points in returns(arm).values()]
        if (
            process.poll() is None
            and arm not in stopped
            and ((seen and min(seen) >= steps) or time.time() - began > seconds)
        ):
            process.send_signal(signal.SIGTERM)
            stopped.add(arm)
    if time.time() - began > seconds + 60:
        for process in processes.values():
            process.kill()
for arm, process in processes.items():
    for seed, points in returns(arm).items():
        print(arm, seed, process.returncode, json.dumps(points))
