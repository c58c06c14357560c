"""Runs some of a campaign on one GPU: a process a run, a few at a time.

    python experiments/results/run_on_gpu.py FIGURE.json ARM:SEED... --out=OUT --steps=N --eval_every=N \
        --seconds=S --at_once=4

What has not ended after so many seconds, or when the script gets SIGTERM, is stopped by SIGTERM and keeps its
rows. On one H200 with 16 cores four runs at a time make 7,800 env steps a second together, eight 5,500 (the
emulators' threads wait for cores), and thirteen pairs of seeds (`--seeds=0,1`) 1,250. On one H100 three made
3,800, evaluations included and with all products in float32. `python -m experiments.figures` with the same
file makes the same runs on a CPU.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("figure", type=Path)
parser.add_argument("runs", nargs="+")
parser.add_argument("--out", type=Path, required=True)
parser.add_argument("--steps", type=int, required=True)
parser.add_argument("--eval_every", type=int, required=True)
parser.add_argument("--seconds", type=float, required=True)
parser.add_argument("--at_once", type=int, default=4)
args = parser.parse_args()
arms = {arm["name"]: arm for arm in json.loads(args.figure.read_text())["arms"]}
env = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
env = {**env, **os.environ}


def directory(name: str) -> Path:
    """Where the run ARM:SEED lies."""
    arm, seed = name.split(":")
    return args.out / "Pong" / arm / f"seed{seed}"


def start(name: str) -> subprocess.Popen:
    """Starts a run, ARM:SEED."""
    arm, seed = name.split(":")
    command = [sys.executable, "-m", "experiments.train", f"--preset={arms[arm]['preset']}", f"--seed={seed}"]
    steps = args.steps
    command += [f"--steps={steps}", f"--eval_every={args.eval_every}", f"--checkpoint_every={steps}"]
    command += [f"--{flag}={value}" for flag, value in arms[arm]["flags"].items()]
    command += [f"--out={directory(name)}", "--nodiagnostics", "--tune_runtime=off"]
    (args.out / "logs").mkdir(parents=True, exist_ok=True)
    log = open(args.out / "logs" / name.replace(":", "-"), "w")
    return subprocess.Popen(command, env=env, stdout=log, stderr=subprocess.STDOUT)


def stop(*_):
    """Ends the wait below."""
    global deadline
    deadline = 0.0


processes: dict[str, subprocess.Popen] = {}
deadline = time.time() + args.seconds
signal.signal(signal.SIGTERM, stop)
while time.time() < deadline:
    running = [process for process in processes.values() if process.poll() is None]
    waiting = [name for name in args.runs if name not in processes]
    if not running and not waiting:
        break
    for name in waiting[: args.at_once - len(running)]:
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
    path = directory(name) / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    returns = {row["env_steps"]: row["eval/return_mean"] for row in rows if row["kind"] == "eval"}
    print(name, process.returncode, rows[-1]["env_steps"] if rows else None, json.dumps(returns), flush=True)
