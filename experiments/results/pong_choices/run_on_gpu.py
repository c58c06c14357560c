"""Runs some of the campaign on one GPU: a process a run, a few at a time.

    python experiments/results/pong_choices/run_on_gpu.py OUT SECONDS AT_ONCE ARM:SEED...

What has not ended after so many seconds is stopped by SIGTERM and keeps its rows. On one H200 with 16 cores
four runs at a time make 7,800 env steps a second together, eight 5,500 (the emulators' threads wait for
cores), and thirteen pairs of seeds (`--seeds=0,1`) 1,250. `python -m experiments.figures` with `choices.json`
makes the same runs on a CPU.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
out, seconds, at_once, wanted = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
arms = {arm["name"]: arm for arm in json.loads((HERE / "choices.json").read_text())["arms"]}
env = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
env = {**env, **os.environ}


def start(name: str) -> subprocess.Popen:
    """Starts a run, ARM:SEED."""
    arm, seed = name.split(":")
    command = [sys.executable, "-m", "experiments.train", f"--preset={arms[arm]['preset']}", f"--seed={seed}"]
    command += ["--steps=200000", "--eval_every=50000", "--checkpoint_every=200000", "--nodiagnostics"]
    command += [f"--{flag}={value}" for flag, value in arms[arm]["flags"].items()]
    command += [f"--out={out / 'Pong' / arm / f'seed{seed}'}", "--tune_runtime=off"]
    (out / "logs").mkdir(parents=True, exist_ok=True)
    log = open(out / "logs" / name.replace(":", "-"), "w")
    return subprocess.Popen(command, env=env, stdout=log, stderr=subprocess.STDOUT)


processes: dict[str, subprocess.Popen] = {}
deadline = time.time() + seconds
while time.time() < deadline:
    running = [process for process in processes.values() if process.poll() is None]
    waiting = [name for name in wanted if name not in processes]
    if not running and not waiting:
        break
    for name in waiting[: at_once - len(running)]:
        processes[name] = start(name)
    time.sleep(0.5)
for process in processes.values():
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
for name, process in processes.items():
    try:
        process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
    arm, seed = name.split(":")
    path = out / "Pong" / arm / f"seed{seed}" / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    returns = {row["env_steps"]: row["eval/return_mean"] for row in rows if row["kind"] == "eval"}
    print(name, process.returncode, rows[-1]["env_steps"] if rows else None, json.dumps(returns))
