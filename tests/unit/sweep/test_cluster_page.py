"""The SLURM job script of docs/cluster.md, executed by a shell with a stub in place of zwidth."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[3] / "docs" / "cluster.md"
# Replaces zwidth and prints its arguments.
STUB = f"#!{sys.executable}\nimport json, sys\nprint(json.dumps(sys.argv[1:]))\n"


def run_script(tmp_path):
    """Return the arguments that the script passes to zwidth."""
    (script,) = re.findall(r"```bash\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    program = tmp_path / "zwidth"
    program.write_text(STUB, encoding="utf-8")
    program.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "SCRATCH": "/scratch/of somebody",
        "SLURM_CPUS_PER_TASK": "16",
    }
    result = subprocess.run(["bash", "-eu", "-c", script], env=environment, capture_output=True, text=True, check=True)
    return json.loads(result.stdout)


def test_job_script_uses_the_allocated_processors(tmp_path):
    expected = ["run", "configs/dense.yaml", "--out", "/scratch/of somebody/dense", "--resume", "--workers", "16"]
    assert run_script(tmp_path) == expected
