"""Stands in for a training run where a sweep is tested: quick, and needs nothing but Python.

`python stub_run.py ROOT NAME`, in ROOT. ROOT/stub/NAME.json holds {"config": what config.json is, "acts":
what the first attempt does, the second, and so on; the last one for all that follow}. Acts: "end" (leaves
what lies in ROOT/stub/NAME.run), "kill", "exit:N" (prints a line first), "wait" (until SIGTERM), "lie"
(status 0 without being complete). ROOT/stub/NAME.attempts and .ends have a line for each.
"""

import fcntl
import json
import os
import shutil
import signal
import sys
import time

stopped = []


def append(path, line):
    with open(path, "a") as file:
        file.write(line + "\n")


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
    with open(f"{name}/config.json.partial", "w") as file:
        json.dump(about["config"], file)
    os.replace(f"{name}/config.json.partial", f"{name}/config.json")
    os.pwrite(lock, json.dumps({"pid": os.getpid(), "host": "here", "since": "now"}).encode(), 0)
    if act == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if act.startswith("exit:"):
        print(f"error: ended on purpose {attempt}")
        return int(act[5:])
    deadline = time.monotonic() + (60.0 if act == "wait" else 0.0)
    while time.monotonic() < deadline and not stopped:
        time.sleep(0.01)
    if stopped:
        return 128 + stopped[0]
    if act != "lie":
        shutil.copytree(f"{stub}.run", name, dirs_exist_ok=True)
        append(f"{stub}.ends", "end")
        print(f"500 env steps, 1 updates; everything is in {name}")
    return 0


if __name__ == "__main__":
    status = main(sys.argv[1], sys.argv[2])
    os.unlink(f"{sys.argv[2]}/lock")
    sys.exit(status)
