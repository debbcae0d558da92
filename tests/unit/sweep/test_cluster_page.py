"""The job script of docs/cluster.md, run by a shell as SLURM runs it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[3] / "docs" / "cluster.md"
# Stands in for the program, and says what it was given.
STUB = f"#!{sys.executable}\nimport json, sys\nprint(json.dumps(sys.argv[1:]))\n"


def words_of(task, tmp_path):
    """What the script gives to the program in one task of the array."""
    (script,) = re.findall(r"```bash\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    program = tmp_path / "zwidth"
    program.write_text(STUB, encoding="utf-8")
    program.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "SCRATCH": "/scratch/of somebody",
        "SLURM_ARRAY_TASK_ID": str(task),
        # As where this task alone is submitted again.
        "SLURM_ARRAY_TASK_COUNT": "1",
    }
    done = subprocess.run(["bash", "-eu", "-c", script], env=environment, capture_output=True, text=True, check=True)
    return script, json.loads(done.stdout)


def test_each_task_of_the_array_is_a_shard_also_when_it_is_submitted_alone(tmp_path):
    for task in (1, 7, 16):
        script, words = words_of(task, tmp_path)
        (shards,) = re.findall(r"--array=1-(\d+)$", script, re.MULTILINE)
        assert words == [
            *("run", "configs/dense.yaml", "--out", "/scratch/of somebody/dense"),
            *("--resume", "--shard", f"{task}/{shards}"),
        ]
