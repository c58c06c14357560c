"""Stands in for a training run where a launcher is tested: quick, and needs nothing but Python.

`python stub_run.py ROOT NAME`, in ROOT. ROOT/stub/NAME.json holds {"config": what config.json is, "acts":
what the first attempt does, the second, and so on; the last one for all that follow}. Acts: "end", "kill",
"exit:N" (prints a line first), "wait" (until SIGTERM), "lie" (status 0 without being complete), "slow" (the
end, after a while). ROOT/stub/NAME.attempts and .ends have a line for each.
"""

import fcntl
import hashlib
import json
import os
import signal
import sys
import time

stopped = []


def append(path, line):
    with open(path, "a") as file:
        file.write(line + "\n")


def complete(name, config):
    folder = f"{name}/checkpoints/000000500"
    os.makedirs(folder + ".partial", exist_ok=True)
    with open(f"{folder}.partial/params.msgpack", "wb") as file:
        file.write(b"1234")
    entry = {"bytes": 4, "sha256": hashlib.sha256(b"1234").hexdigest()}
    about = {
        "format": 4,
        "frame_shape": [42, 42, 1],
        "num_actions": 3,
        "env_steps": 500,
        "updates": 1,
        "files": {"params.msgpack": entry},
    }
    text = json.dumps({**about, "config": config}).encode()
    with open(f"{folder}.partial/manifest.json", "wb") as file:
        file.write(text)
    with open(f"{folder}.partial/manifest.sha256", "w") as file:
        file.write(f"{hashlib.sha256(text).hexdigest()}  manifest.json\n")
    with open(f"{name}/metrics.jsonl", "w") as file:
        row = {"kind": "eval", "env_steps": 500, "updates": 1, "wall_s": 5.0, "eval/return_mean": 0.5}
        file.write(json.dumps(row) + "\n")
    os.rename(folder + ".partial", folder)


def main(root, name):
    signal.signal(signal.SIGTERM, lambda number, frame: stopped.append(number))
    stub = f"stub/{name}"
    with open(f"{stub}.json") as file:
        about = json.load(file)
    append(f"{stub}.attempts", f"{os.getcwd() == root} {time.monotonic()}")
    with open(f"{stub}.attempts") as file:
        attempt = len(file.readlines())
    act = about["acts"][min(attempt, len(about["acts"])) - 1]
    os.makedirs(name, exist_ok=True)
    lock = os.open(f"{name}/lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with open(f"{name}/config.json", "w") as file:
        json.dump(about["config"], file)
    if act == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if act.startswith("exit:"):
        print(f"error: ended on purpose {attempt}")
        return int(act[5:])
    deadline = time.monotonic() + {"wait": 60.0, "slow": 0.3}.get(act, 0.0)
    while time.monotonic() < deadline and not stopped:
        time.sleep(0.01)
    if stopped:
        return 128 + stopped[0]
    if act != "lie":
        complete(name, about["config"])
        append(f"{stub}.ends", "end")
        print(f"500 env steps, 1 updates; everything is in {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2]))
